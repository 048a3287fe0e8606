"""NDBCNet: a conductance cell, unrolled over sub-steps and time, with a linear readout."""

from __future__ import annotations

from collections.abc import Sequence

import torch as th
from torch import nn
from torch.nn import functional

from sb3_tbc.ndbc.cell import ConductanceCell
from sb3_tbc.ndbc.wiring import NDBCWiring


class NDBCNet(nn.Module):
    """Neuro-dynamic bionic control network (paper, section 4.3): sparse, continuous-time, with memory.

    :param n_inputs: number of inputs; each is a sensory neuron
    :param n_outputs: number of outputs ``y = sum_i alpha_i V_i + bias``
    :param wiring: who is wired to whom
    :param sub_steps: K, sub-steps per control step; three synaptic hops lie between sensory and motor neurons
    :param input_scale: fixed scales the inputs are divided by, ``(n_inputs,)``; by default 1
    :param readout: ``"all"`` sums over all neurons, as the paper's equation does, ``"motor"`` over the motor neurons
    :param seed: seed of the initial values
    :raises ValueError: if sizes do not fit together or an option is unknown
    """

    def __init__(
        self,
        n_inputs: int,
        n_outputs: int,
        wiring: NDBCWiring,
        sub_steps: int = 3,
        input_scale: Sequence[float] | None = None,
        readout: str = "all",
        seed: int = 0,
    ) -> None:
        super().__init__()
        if n_inputs != wiring.n_inputs:
            raise ValueError(f"n_inputs={n_inputs}, but the wiring has {wiring.n_inputs} sensory neurons")
        if sub_steps < 1:
            raise ValueError(f"sub_steps must be at least 1, got {sub_steps}")
        if readout not in ("all", "motor"):
            raise ValueError(f"readout must be 'all' or 'motor', got {readout!r}")
        scale = th.ones(n_inputs) if input_scale is None else th.as_tensor(input_scale, dtype=th.float32).clone()
        if scale.shape != (n_inputs,) or not bool((scale > 0).all()):
            raise ValueError(f"input_scale must be {n_inputs} positive numbers, got {input_scale}")
        generator = th.Generator().manual_seed(seed)
        self.n_inputs, self.n_outputs, self.sub_steps, self.wiring = n_inputs, n_outputs, sub_steps, wiring
        self.readout = readout
        self.input_gain: th.Tensor
        self.register_buffer("input_gain", 1.0 / scale)
        self.cell = ConductanceCell(wiring, generator)
        self._read_from = wiring.layer("motor").start if readout == "motor" else 0
        n_read = wiring.n_neurons - self._read_from
        self.readout_weight = nn.Parameter((2.0 * th.rand(n_outputs, n_read, generator=generator) - 1.0) * n_read**-0.5)
        self.readout_bias = nn.Parameter(th.zeros(n_outputs))
        self._centre(generator)

    @th.no_grad()
    def _centre(self, generator: th.Generator) -> None:
        """Start with outputs of mean zero over uniform inputs, so that a policy starts unbiased."""
        inputs = (2.0 * th.rand(256, self.n_inputs, generator=generator) - 1.0) / self.input_gain
        self.readout_bias.copy_(-self(inputs)[0].mean(dim=0))

    @property
    def state_dim(self) -> int:
        """Membrane potentials per sample: inter, command, motor."""
        return self.wiring.n_neurons

    def initial_state(self, batch: int) -> th.Tensor:
        """Potentials at the start of a window: zero, ``(batch, state_dim)``."""
        return self.readout_bias.new_zeros(batch, self.state_dim)

    def forward(
        self, inputs: th.Tensor, state: th.Tensor | None = None, mask: th.Tensor | None = None
    ) -> tuple[th.Tensor, th.Tensor]:
        """Outputs and the potentials they leave behind.

        :param inputs: ``(batch, n_inputs)`` for one step or ``(batch, time, n_inputs)`` for a sequence
        :param state: potentials to start from, ``(batch, state_dim)``; by default zero
        :param mask: 0 where the potentials are reset *before* the step, else 1; ``(batch,)`` or ``(batch, time)``
        :return: outputs ``(batch, n_outputs)`` or ``(batch, time, n_outputs)``, and the final potentials
        """
        potentials = self.initial_state(inputs.shape[0]) if state is None else state
        arrays = self.cell.arrays()
        inertia = arrays.capacitance * self.sub_steps
        drive = self.cell.drive(inputs * self.input_gain, arrays)
        drive = drive + functional.pad(inertia, (self.state_dim, 0))
        if inputs.dim() == 2:
            potentials = potentials if mask is None else potentials * mask.unsqueeze(-1)
            for _ in range(self.sub_steps):
                potentials = self.cell.step(potentials, drive, inertia, arrays)
            return self._read(potentials), potentials
        trace = []
        for t, drive_t in enumerate(drive.unbind(dim=1)):
            potentials = potentials if mask is None else potentials * mask[:, t].unsqueeze(-1)
            for _ in range(self.sub_steps):
                potentials = self.cell.step(potentials, drive_t, inertia, arrays)
            trace.append(potentials)
        return self._read(th.stack(trace, dim=1)), potentials

    def _read(self, potentials: th.Tensor) -> th.Tensor:
        return functional.linear(potentials[..., self._read_from :], self.readout_weight, self.readout_bias)
