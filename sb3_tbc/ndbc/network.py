"""NDBCNet: a cell on a wiring, unrolled over sub-steps and time, with a linear readout."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from numbers import Integral
from typing import TYPE_CHECKING

import numpy as np
import torch as th
from torch import nn
from torch.nn import functional

from sb3_tbc.aliases import Plain, PlainMapping
from sb3_tbc.arrays import FloatArray
from sb3_tbc.ndbc.cell import Cell, ConductanceCell
from sb3_tbc.ndbc.dissipative import Certificate, DissipativeCell
from sb3_tbc.ndbc.lean import LeanCell
from sb3_tbc.ndbc.sequence import Unrolled, unroll
from sb3_tbc.ndbc.stepping import LipschitzProxy, StepRule, advance_checked
from sb3_tbc.ndbc.wiring import NDBCWiring, check_seed

if TYPE_CHECKING:
    from matplotlib.axes import Axes

DYNAMICS = ("conductance", "dissipative")
SYNAPSES = ("paper", "lean")
STEP_STATE, STEP_DIRECTION = "step_state", "step_direction"
"""Further entries of the saved state, if K follows a step-size rule."""


class NDBCNet(nn.Module):
    """Neuro-dynamic bionic control network (paper, section 4.3): sparse, continuous-time, with memory.

    The unit of time is one control step, cut into K sub-steps. Sensory neurons have no state: their potential is the
    scaled input.

    :param n_inputs: number of inputs; each is a sensory neuron
    :param n_outputs: number of outputs ``y = sum_i alpha_i V_i + bias``
    :param wiring: who is wired to whom, or its plain data (see :meth:`NDBCWiring.from_dict`)
    :param sub_steps: K, sub-steps per control step; three synaptic hops lie between sensory and motor neurons
    :param dynamics: ``"conductance"`` or ``"dissipative"`` (equations 20 and 21)
    :param input_scale: fixed scales the inputs are divided by, ``(n_inputs,)``; by default 1
    :param readout: ``"all"`` sums over all neurons, as the paper's equation does, ``"motor"`` over the motor neurons
    :param max_rho: dissipative only: keep the contraction factor of the certificate, which is that of one sub-step, at
        or below this, during training too. Short steps (many sub-steps, short intervals) leave recurrent synapses less
        room, down to none
    :param adaptive_step: choose K by the step-size rule: True, or the fields of :class:`StepRule` that differ from
        their defaults; K then changes only in :meth:`after_update` and :meth:`refresh_step`, never inside a call
    :param seed: seed of the initial values; by default torch's global stream
    :param synapses: ``"paper"``: a conductance and a reversal potential per synapse, sensory ones included; ``"lean"``:
        one parameter per synapse, and inputs act through the input current alone, see
        :class:`~sb3_tbc.ndbc.lean.LeanCell`; conductance dynamics only
    :param time_constants: range of each layer's initial time constants in control steps, drawn log-uniformly, e.g.
        ``{"command": (0.5, 3.0)}``; layers left out, and all by default, start at .1 to .3 and so forget within a
        step. Slow neurons need no more sub-steps than fast ones. Conductance dynamics only
    :param initial_gains: range of the initial gains of all logistics, by default 2 to 4; conductance dynamics only
    :raises ValueError: if sizes do not fit together or an option is unknown

    Derivatives of any order and ``torch.func`` (``vmap``, ``jacrev``) work on single steps; sequences have first
    derivatives only and refuse the rest. ``torch.jit.script`` does not take the network: use ``torch.compile`` or the
    exports.
    """

    def __init__(
        self,
        n_inputs: int,
        n_outputs: int,
        wiring: NDBCWiring | PlainMapping,
        sub_steps: int = 3,
        dynamics: str = "conductance",
        input_scale: Sequence[float] | None = None,
        readout: str = "all",
        max_rho: float | None = None,
        adaptive_step: bool | PlainMapping = False,
        seed: int | None = None,
        synapses: str = "paper",
        time_constants: Mapping[str, Sequence[float] | None] | None = None,
        initial_gains: Sequence[float] | None = None,
    ) -> None:
        super().__init__()
        wiring = wiring if isinstance(wiring, NDBCWiring) else NDBCWiring.from_dict(wiring)
        _check_sizes(n_inputs, n_outputs, wiring, sub_steps, seed)
        only_conductance = {"time_constants": time_constants, "initial_gains": initial_gains}
        _check_options(dynamics, readout, max_rho, synapses, only_conductance)
        scale = th.ones(n_inputs) if input_scale is None else th.as_tensor(input_scale, dtype=th.float32).clone()
        if scale.shape != (n_inputs,) or not bool((scale.isfinite() & (scale > 0)).all()):
            raise ValueError(f"input_scale must be {n_inputs} positive numbers, got {input_scale}")
        generator = None if seed is None else th.Generator().manual_seed(seed)
        self.n_inputs, self.n_outputs, self.sub_steps, self.wiring = n_inputs, n_outputs, int(sub_steps), wiring
        self.dynamics, self.readout, self.synapses = dynamics, readout, synapses
        self.input_gain: th.Tensor
        self.register_buffer("input_gain", 1.0 / scale)
        self.cell: ConductanceCell | DissipativeCell
        if dynamics == "dissipative":
            self.cell = DissipativeCell(wiring, generator, max_rho=max_rho)
        else:
            kind = LeanCell if synapses == "lean" else ConductanceCell
            self.cell = kind(wiring, generator, time_constants=time_constants, initial_gains=initial_gains)
        self.read_from = wiring.layer("motor").start if readout == "motor" else 0
        n_read = wiring.n_neurons - self.read_from
        drawn = 2.0 * th.rand(n_outputs, n_read, generator=generator) - 1.0
        self.readout_weight = nn.Parameter(drawn / n_read**0.5)
        self.readout_bias = nn.Parameter(th.zeros(n_outputs))
        self.lipschitz = LipschitzProxy(self.state_dim)
        self._restore_step: tuple[list[int], th.Tensor] | None = None
        self.register_load_state_dict_post_hook(_after_loading)  # type: ignore[no-untyped-call]
        self.step_rule = (
            None if adaptive_step is False else StepRule(**({} if adaptive_step is True else adaptive_step))
        )
        self._check_enforceable(max_rho)
        self.updates = 0
        self.refresh_step()
        self._centre(generator)

    def _check_enforceable(self, max_rho: float | None) -> None:
        if max_rho is None or not isinstance(self.cell, DissipativeCell):
            return
        most = self.sub_steps if self.step_rule is None else self.step_rule.max_sub_steps
        least = 1.0 / (1.0 + self.cell.min_damping / most)
        if max_rho <= least:  # synapses that are silent once get no gradient, and stay so
            count = f"{most} sub-steps" if self.step_rule is None else f"adaptive_step, up to {most} sub-steps,"
            raise ValueError(
                f"max_rho={max_rho} leaves no room for recurrent synapses: with {count} and damping at least "
                f"{self.cell.min_damping} it must exceed {least:.3f}; use fewer sub-steps or a larger value"
            )

    @th.no_grad()
    def _centre(self, generator: th.Generator | None) -> None:
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
        self,
        inputs: th.Tensor,
        state: th.Tensor | None = None,
        mask: th.Tensor | None = None,
        interval: th.Tensor | None = None,
    ) -> tuple[th.Tensor, th.Tensor]:
        """Outputs and the potentials they leave behind.

        :param inputs: ``(batch, n_inputs)`` for one step or ``(batch, time, n_inputs)`` for a sequence
        :param state: potentials to start from, ``(batch, state_dim)``; by default zero
        :param mask: 0 where the potentials are reset *before* the step, whatever they were, else 1; ``(batch,)`` or
            ``(batch, time)``
        :param interval: length of the step in control steps where it is not 1, ``(batch,)`` or ``(batch, time)``;
            0 leaves the potentials as they are
        :return: outputs ``(batch, n_outputs)`` or ``(batch, time, n_outputs)``, and the final potentials
        :raises ValueError: if a shape does not fit or an interval is negative
        :raises TypeError: for what is no tensor, or of a type that the network's own does not hold
        """
        if isinstance(inputs, th.Tensor) and inputs.dim() == 2:
            state = self._advance(inputs, state, mask, interval)
            return self.read(state), state
        fast = self._unroll_fast(inputs, state, mask, interval)
        if fast is not None:
            weight = functional.pad(self.readout_weight, (self.read_from, 0))
            return fast.read(weight, self.readout_bias), fast.last()
        trace = self.unroll(inputs, state, mask, interval)
        if inputs.shape[1] == 0:
            return self.read(trace), self.initial_state(len(inputs)) if state is None else state
        return self.read(trace), trace[:, -1]

    def read(self, state: th.Tensor) -> th.Tensor:
        """The readout ``y = sum_i alpha_i V_i + bias`` of potentials ``(..., state_dim)``."""
        return functional.linear(state[..., self.read_from :], self.readout_weight, self.readout_bias)

    def unroll(
        self,
        inputs: th.Tensor,
        state: th.Tensor | None = None,
        mask: th.Tensor | None = None,
        interval: th.Tensor | None = None,
    ) -> th.Tensor:
        """Potentials after every step of a sequence, ``(batch, time, state_dim)``; arguments as in :meth:`forward`."""
        fast = self._unroll_fast(inputs, state, mask, interval)
        if fast is not None:
            return fast.potentials()
        state = self.initial_state(inputs.shape[0]) if state is None else state
        trace = []
        for t in range(inputs.shape[1]):
            mask_t, interval_t = (None if x is None else x[:, t] for x in (mask, interval))
            state = self._advance(inputs[:, t], state, mask_t, interval_t)
            trace.append(state)
        return th.stack(trace, dim=1) if trace else state.unsqueeze(1)[:, :0]

    def _unroll_fast(
        self, inputs: th.Tensor, state: th.Tensor | None, mask: th.Tensor | None, interval: th.Tensor | None
    ) -> Unrolled | None:
        """A sequence through :class:`.UnrolledCell`; None if that does not support the case."""
        self._check_shapes(inputs, state, mask, interval, dims=3)
        checked = self.step_rule is not None and self.step_rule.half_step_check
        if not isinstance(self.cell, ConductanceCell) or interval is not None or checked or inputs.shape[1] == 0:
            return None
        state = self.initial_state(inputs.shape[0]) if state is None else state
        return unroll(self.cell, inputs, self.input_gain, state, mask, self.sub_steps)

    def _advance(
        self, inputs: th.Tensor, state: th.Tensor | None, mask: th.Tensor | None, interval: th.Tensor | None
    ) -> th.Tensor:
        """The potentials one control step later; plain tensor operations, so any tracer can follow."""
        self._check_shapes(inputs, state, mask, interval, dims=2)
        state = self.initial_state(inputs.shape[0]) if state is None else state
        # A product with the mask would keep a state that is NaN.
        state = state if mask is None else th.where(mask.unsqueeze(-1) != 0, state, 0.0)
        if interval is None:
            return self._advance_by(inputs, state, None)
        _check_intervals(interval)
        passes = interval.unsqueeze(-1) > 0
        later = self._advance_by(inputs, state, th.where(passes, interval.unsqueeze(-1), 1.0))
        return th.where(passes, later, state)  # where no time passes, C / dt is infinite

    def _advance_by(self, inputs: th.Tensor, state: th.Tensor, length: th.Tensor | None) -> th.Tensor:
        """The potentials after control steps of ``length``, ``(batch, 1)``; None for 1."""
        cell: Cell = self.cell
        if self.step_rule is not None and self.step_rule.half_step_check:
            length = state.new_ones(len(state), 1) if length is None else length
            return advance_checked(cell, inputs * self.input_gain, state, length, self.sub_steps, self.step_rule)
        arrays = cell.arrays()
        step_terms = cell.step_terms(arrays, (1.0 if length is None else length) / self.sub_steps)
        input_terms = cell.input_terms(inputs * self.input_gain, arrays, step_terms)
        for _ in range(self.sub_steps):
            state = cell.step(state, input_terms, arrays, step_terms)
        return state

    def _check_shapes(
        self, inputs: th.Tensor, state: th.Tensor | None, mask: th.Tensor | None, interval: th.Tensor | None, dims: int
    ) -> None:
        for name, value in (("inputs", inputs), ("state", state), ("mask", mask), ("interval", interval)):
            if value is not None:
                _check_tensor(name, value, None if name == "mask" else self.input_gain.dtype)
        lead = tuple(inputs.shape[:-1])
        if inputs.dim() != dims or inputs.shape[-1] != self.n_inputs:
            raise ValueError(f"inputs must be (batch, [time,] {self.n_inputs}), got shape {tuple(inputs.shape)}")
        if state is not None and tuple(state.shape) != (lead[0], self.state_dim):
            raise ValueError(f"state must be ({lead[0]}, {self.state_dim}), got shape {tuple(state.shape)}")
        for name, value in (("mask", mask), ("interval", interval)):
            if value is not None and tuple(value.shape) != lead:
                raise ValueError(f"{name} must have one entry per step, shape {lead}, got {tuple(value.shape)}")

    def _save_to_state_dict(self, destination: Plain, prefix: str, keep_vars: bool) -> None:
        """With a step-size rule, also K, the updates since it was chosen, and where the power iteration stands."""
        super()._save_to_state_dict(destination, prefix, keep_vars)
        if self.step_rule is not None:
            destination[prefix + STEP_STATE] = th.tensor([self.sub_steps, self.updates])
            destination[prefix + STEP_DIRECTION] = self.lipschitz.direction.clone()

    def _load_from_state_dict(self, state_dict: Plain, prefix: str, *args: object) -> None:
        """Load weights and K.

        The index tables of the cell are part of the state, so weights of another wiring are recognised and refused:
        they would act through its synapses while ``net.wiring`` still described the present ones.
        """
        for name, own in self.cell.named_buffers(prefix="cell"):
            given = state_dict.get(prefix + name)
            if given is not None and not (given.shape == own.shape and bool((given.to(own) == own).all())):
                raise RuntimeError(  # in torch's words for weights that do not fit, by which loading knows them
                    f"state_dict does not fit: {prefix}{name} is that of another wiring; build the network with the "
                    "wiring that the weights belong to (the same sizes, fans, seed, sensory_to and synapses)"
                )
        chosen, direction = (state_dict.pop(prefix + name, None) for name in (STEP_STATE, STEP_DIRECTION))
        super()._load_from_state_dict(state_dict, prefix, *args)
        self._restore_step = None if chosen is None else (chosen.tolist(), direction)

    def draw(self, ax: Axes | None = None, input_names: Sequence[str] | None = None, **more: object) -> Axes:
        """Draw neurons, the readout's weights, and synapses with their present polarities.

        :param ax: matplotlib axes to draw into; new ones by default
        :param input_names: a name per sensory neuron
        :param more: as for :func:`sb3_tbc.ndbc.drawing.draw_wiring`; the readout is this network's, unless it is given
        :return: the axes
        """
        more.setdefault("readout", self.readout_weights())
        return self.signed_wiring().draw(ax, input_names, **more)

    def readout_weights(self) -> FloatArray:
        """Weight of each neuron on each output, ``(state_dim, n_outputs)``; zero for neurons that are not read."""
        weight = functional.pad(self.readout_weight.detach(), (self.read_from, 0))
        return np.asarray(weight.T.cpu().numpy())

    def signed_wiring(self) -> NDBCWiring:
        """The wiring with the polarities as they are now."""
        cell = self.cell
        return self.wiring.with_signs(*cell.signs(self.wiring)) if isinstance(cell, LeanCell) else self.wiring

    def refresh_step(self) -> int:
        """Choose K by the step-size rule from the present weights; without a rule K stays as it is."""
        if self.step_rule is not None:
            lipschitz = self.lipschitz.evaluate(self.cell, self.step_rule.power_iterations)
            self.sub_steps = self.step_rule.sub_steps(lipschitz)
        return self.sub_steps

    def after_update(self, n_updates: int = 1) -> bool:
        """Tell the step-size rule about updates of the weights.

        :param n_updates: how many there were
        :return: whether K changed, so that compiled or frozen forms have to be made anew
        """
        before, rule = self.updates, self.step_rule
        self.updates += n_updates
        if rule is None or before // rule.refresh_every == self.updates // rule.refresh_every:
            return False
        sub_steps = self.sub_steps
        return self.refresh_step() != sub_steps

    @th.no_grad()
    def time_constants(self, inputs: th.Tensor, state: th.Tensor) -> th.Tensor:
        """Effective time constants ``1 / (1 / tau_i + sum_j w_ij sigma(V_j) / C_i)`` with ``tau_i = C_i / g_l,i``.

        The sum runs over sensory synapses and the input current too; smaller means faster.

        :param inputs: ``(batch, n_inputs)``
        :param state: potentials, ``(batch, state_dim)``
        :return: ``(batch, state_dim)``, in control steps
        """
        cell = self.cell
        if isinstance(cell, DissipativeCell):
            return (1.0 / cell.arrays().damping).expand(len(state), -1)
        arrays = cell.arrays()
        conductance = cell.input_terms(inputs * self.input_gain, arrays, th.zeros_like(arrays.capacitance))
        released = th.sigmoid(state[:, : cell.n_presynaptic] * arrays.gain - cell.threshold)
        return arrays.capacitance / (conductance + released @ arrays.recurrent)[:, self.state_dim :]

    def certificate(self) -> Certificate:
        """Bounded-input bounded-state certificate of the dissipative dynamics, per sub-step (equation 21).

        It holds for inputs as :meth:`forward` takes them, before they are divided by ``input_scale``.

        :raises ValueError: for conductance dynamics, whose potentials are bounded whatever the weights
        """
        if not isinstance(self.cell, DissipativeCell):
            raise ValueError("conductance dynamics need no certificate: NDBCNet.cell.bounds() holds for any weights")
        return self.cell.certificate(1.0 / self.sub_steps, self.input_gain.unsqueeze(-1))


def _after_loading(net: NDBCNet, _: object) -> None:
    """Restore K, and what the step-size rule remembers, after all weights are loaded."""
    if net.step_rule is None:
        return
    if net._restore_step is None:  # saved by a version that did not keep K
        net.refresh_step()
        return
    (net.sub_steps, net.updates), direction = net._restore_step
    net.lipschitz.direction.copy_(direction)


def _check_tensor(name: str, value: object, own: th.dtype | None) -> None:
    """Refuse what is no tensor, or of a type that the network's own does not hold.

    :param own: None where any type will do
    :raises TypeError: with the cure
    """
    if not isinstance(value, th.Tensor):
        raise TypeError(f"{name} must be a tensor, got {type(value).__name__}: torch.as_tensor(...) makes one")
    if own is not None and th.promote_types(value.dtype, own) != own:
        raise TypeError(
            f"{name} is of {value.dtype}, the network of {own}: use {name}.to({own}), or net.to({value.dtype})"
        )


def _check_sizes(n_inputs: int, n_outputs: int, wiring: NDBCWiring, sub_steps: int, seed: int | None) -> None:
    if n_inputs != wiring.n_inputs:
        raise ValueError(f"n_inputs={n_inputs}, but the wiring has {wiring.n_inputs} sensory neurons")
    for name, value in (("n_outputs", n_outputs), ("sub_steps", sub_steps)):
        if isinstance(value, bool) or not isinstance(value, Integral) or value < 1:
            raise ValueError(f"{name} must be a whole number of at least 1, got {value!r}")
    check_seed(seed)


def _check_options(
    dynamics: str, readout: str, max_rho: float | None, synapses: str, only_conductance: PlainMapping
) -> None:
    for name, value, allowed in (
        ("dynamics", dynamics, DYNAMICS),
        ("readout", readout, ("all", "motor")),
        ("synapses", synapses, SYNAPSES),
    ):
        if value not in allowed:
            raise ValueError(f"{name} must be one of {allowed}, got {value!r}")
    if max_rho is not None and dynamics != "dissipative":
        raise ValueError("max_rho belongs to dynamics='dissipative'; conductance dynamics are bounded without it")
    given = {name: value for name, value in only_conductance.items() if value is not None}
    given |= {"synapses": synapses} if synapses != "paper" else {}
    if given and dynamics != "conductance":
        name, value = next(iter(given.items()))
        raise ValueError(f"{name}={value!r} belongs to dynamics='conductance', got dynamics={dynamics!r}")


def _check_intervals(interval: th.Tensor) -> None:
    """Refuse lengths that are negative or NaN; while a graph is traced there are no values to check."""
    if th.compiler.is_compiling():
        return
    if not bool((interval >= 0).all()):
        raise ValueError(f"interval must not be negative or NaN, smallest is {float(interval.min())}: it is a length")
