"""Lean synapses: the conductance cell with one parameter per wired pair."""

from __future__ import annotations

import numpy as np
import torch as th
from torch import nn
from torch.nn import functional

from sb3_tbc.ndbc.cell import (
    INITIAL_RANGES,
    ConductanceArrays,
    ConductanceCell,
    ConductanceValues,
    positive_parameter,
    uniform,
)
from sb3_tbc.ndbc.wiring import NDBCWiring, SignMatrix


class LeanCell(ConductanceCell):
    """The conductance cell with about half of its parameters: ``C dV/dt = g_l (V_leak - V) + ... + ...`` with

    ``sum_j |s_ij| sigma(V_j) (sign(s_ij) - V_i)`` for synapses among neurons, and ``g_in (tanh(W u + b) - V)`` alone
    for inputs.

    A synapse has one free parameter s: its conductance is ``|s|`` and its reversal potential ``sign(s)``, so that
    training may turn an excitatory synapse into an inhibitory one. It starts with the wiring's polarity. Sensory
    neurons have no synapses of their own, one weight of W per wired pair instead.

    :param wiring: who is wired to whom, with the polarities to start from
    :param generator: source of the initial values; torch's global one if None
    """

    @property
    def n_sensory_synapsing(self) -> int:
        """None: inputs act through the input current."""
        return 0

    @property
    def sensory_threshold(self) -> th.Tensor:  # type: ignore[override]
        """Empty: sensory neurons have no logistic."""
        return self.current_bias.new_zeros(0)

    def _draw_parameters(self, generator: th.Generator | None) -> None:
        n = self.n_neurons
        size = uniform(len(self.polarity), *INITIAL_RANGES["conductance"], generator)
        self.synapse = nn.Parameter(size * self.polarity)
        self.raw_input_conductance = positive_parameter(self.n_driven, "input_conductance", generator)
        self.raw_capacitance = positive_parameter(n, "capacitance", generator)
        self.raw_leak = positive_parameter(n, "leak", generator)
        self.raw_gain = self._gain_parameter(self.n_presynaptic, generator)
        self.leak_potential = nn.Parameter(uniform(n, -0.1, 0.1, generator))
        self.threshold = nn.Parameter(uniform(self.n_presynaptic, -0.5, 0.5, generator))
        self._draw_current(generator)

    def values(self) -> ConductanceValues:
        """The positive quantities from the current free parameters; differentiable."""
        raw: list[th.Tensor] = [self.raw_input_conductance, self.raw_capacitance, self.raw_leak, self.raw_gain]
        current, capacitance, leak, gain = th.split(functional.softplus(th.cat(raw)), [len(r) for r in raw])
        value = ConductanceValues(
            conductance=self.synapse.abs(),
            reversal=th.ones_like(self.synapse),
            input_conductance=current,
            capacitance=capacitance,
            leak=leak,
            gain=gain,
            sensory_gain=gain.new_zeros(0),
        )
        return self._scaled(value)

    def reversal(self, value: ConductanceValues) -> th.Tensor:
        """Signed reversal potentials, one per synapse."""
        return th.where(self.synapse < 0, -value.reversal, value.reversal)

    def synapse_currents(self, value: ConductanceValues) -> th.Tensor:
        """``w E`` of every synapse: s itself."""
        return self.synapse

    def excitation(self, arrays: ConductanceArrays) -> tuple[th.Tensor, th.Tensor]:
        """Weights ``(n_inputs, M)`` and shifts ``(M,)`` of the input currents."""
        return arrays.current_weight, self.current_bias

    def heard_inputs(self, inputs: th.Tensor, arrays: ConductanceArrays) -> th.Tensor:
        """The potentials the input currents pull towards, ``(..., M)``."""
        return th.tanh(inputs @ arrays.current_weight + self.current_bias)

    @th.no_grad()
    def cut(self, synapse: int) -> None:
        """Let a synapse conduct nothing, see :meth:`ConductanceCell.cut`; a sensory one is its weight alone."""
        n_sensory = len(self.current_weight)
        if synapse < n_sensory:
            self.current_weight[synapse] = 0.0
        else:
            self.synapse[synapse - n_sensory] = 0.0

    @th.no_grad()
    def signs(self, wiring: NDBCWiring) -> tuple[SignMatrix, SignMatrix]:
        """Polarities as they are now: of the input current's weights, and of the synapses among neurons."""
        sensory, recurrent = np.zeros_like(wiring.sensory), np.zeros_like(wiring.recurrent)
        sensory[np.nonzero(wiring.sensory)] = _signs(self.current_weight)
        recurrent[np.nonzero(wiring.recurrent)] = _signs(self.synapse)
        return sensory, recurrent


def _signs(weight: th.Tensor) -> SignMatrix:
    return np.where(weight.detach().cpu().numpy() < 0, -1, 1).astype(np.int8)
