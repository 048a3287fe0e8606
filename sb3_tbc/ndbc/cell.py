"""The conductance cell: what a synapse does, and one semi-implicit step of all membrane potentials at once."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
import torch as th
from torch import nn
from torch.nn import functional

from sb3_tbc.ndbc.wiring import NDBCWiring

INITIAL_RANGES = {
    "conductance": (0.1, 0.6),
    "reversal": (0.5, 1.5),
    "capacitance": (0.1, 0.3),
    "leak": (0.05, 0.2),
    "gain": (2.0, 4.0),
    "input_conductance": (0.5, 1.0),
}
"""Initial values are uniform in these."""


class ConductanceArrays(NamedTuple):
    """Everything a step needs, derived once per call (N neurons, I inputs, M inter neurons)."""

    current_weight: th.Tensor  # (I, M), input current, on the sensory -> inter mask
    from_inputs: th.Tensor  # (I + M, 2 N): columns w E | w of sensory synapses and of the input current
    recurrent: th.Tensor  # (P, 2 N): columns w E | w of the synapses among neurons, P presynaptic ones
    rest: th.Tensor  # (2 N,): g_l V_leak | g_l + g_in
    capacitance: th.Tensor  # (N,)
    gain: th.Tensor  # (P,), steepness of the presynaptic logistic
    sensory_gain: th.Tensor  # (I,)


class ConductanceValues(NamedTuple):
    """The positive quantities of the cell, one per synapse (sensory ones first), inter neuron, neuron or input."""

    conductance: th.Tensor
    reversal: th.Tensor  # |E|; the sign is the synapse's polarity
    input_conductance: th.Tensor
    capacitance: th.Tensor
    leak: th.Tensor
    gain: th.Tensor
    sensory_gain: th.Tensor


def inverse_softplus(value: th.Tensor) -> th.Tensor:
    """The free parameter whose softplus is ``value`` (> 0)."""
    return value + th.log(-th.expm1(-value))


def uniform(size: int, low: float, high: float, generator: th.Generator | None) -> th.Tensor:
    """Uniform numbers in ``[low, high)``, from torch's global stream if there is no generator."""
    return low + (high - low) * th.rand(size, generator=generator)


class ConductanceCell(nn.Module):
    """Membrane potentials ``C dV/dt = g_l (V_leak - V) + sum_j w_ij sigma(V_j) (E_ij - V) + g_in (tanh(W u + b) - V)``.

    Conductances, capacitances, gains and the size of reversal potentials are softplus of free parameters, one per
    synapse or neuron: what the wiring leaves out has no parameter at all, so its weight and gradient are exactly zero.
    The sign the paper gives to w lives in the reversal potential: excitatory E > 0, inhibitory E < 0 (section 4.3). The
    logistic of neuron j is ``sigma(V_j) = 1 / (1 + exp(threshold_j - gain_j V_j))``; time in control steps.

    :param wiring: who is wired to whom, with polarities
    :param generator: source of the initial values; torch's global one if None
    """

    def __init__(self, wiring: NDBCWiring, generator: th.Generator | None = None) -> None:
        super().__init__()
        self.n_inputs, self.n_inter, self.n_neurons = wiring.n_inputs, wiring.inter, wiring.n_neurons
        self.n_presynaptic = int(np.flatnonzero(wiring.recurrent.any(axis=1)).max(initial=0)) + 1
        self._index_synapses(wiring)
        n, m, inputs = self.n_neurons, self.n_inter, self.n_inputs

        def positive(size: int, name: str) -> nn.Parameter:
            return nn.Parameter(inverse_softplus(uniform(size, *INITIAL_RANGES[name], generator)))

        self.raw_conductance = positive(len(self.polarity), "conductance")
        self.raw_reversal = positive(len(self.polarity), "reversal")
        self.raw_input_conductance = positive(m, "input_conductance")
        self.raw_capacitance = positive(n, "capacitance")
        self.raw_leak = positive(n, "leak")
        self.raw_gain = positive(self.n_presynaptic, "gain")
        self.raw_sensory_gain = positive(inputs, "gain")
        self.leak_potential = nn.Parameter(uniform(n, -0.1, 0.1, generator))
        self.threshold = nn.Parameter(uniform(self.n_presynaptic, -0.5, 0.5, generator))
        self.sensory_threshold = nn.Parameter(uniform(inputs, -0.5, 0.5, generator))
        spread = 2.0 / max(1.0, len(self.current_index) / m) ** 0.5
        self.current_weight = nn.Parameter(uniform(len(self.current_index), -spread, spread, generator))
        self.current_bias = nn.Parameter(uniform(m, -0.3, 0.3, generator))

    def _index_synapses(self, wiring: NDBCWiring) -> None:
        """Where each synapse's ``w E`` and ``w`` go in one flat matrix with rows sensory | input current | neurons."""
        n, m, inputs = self.n_neurons, self.n_inter, self.n_inputs
        pre_s, post_s = np.nonzero(wiring.sensory)
        pre_r, post_r = np.nonzero(wiring.recurrent)
        rows = np.concatenate([pre_s, inputs + m + pre_r])
        reversal_at = rows * 2 * n + np.concatenate([post_s, post_r])
        current_at = (inputs + np.arange(m)) * 2 * n + np.arange(m)
        polarity = np.concatenate([wiring.sensory[pre_s, post_s], wiring.recurrent[pre_r, post_r]])
        pre_c, post_c = np.nonzero(wiring.sensory[:, wiring.layer("inter")])
        self.polarity: th.Tensor
        self.matrix_index: th.Tensor
        self.current_index: th.Tensor
        self.register_buffer("polarity", th.as_tensor(polarity.astype(np.float32)))
        self.register_buffer("matrix_index", th.as_tensor(np.concatenate([reversal_at, reversal_at + n, current_at])))
        self.register_buffer("current_index", th.as_tensor(pre_c * m + post_c))

    def values(self) -> ConductanceValues:
        """The positive quantities from the current free parameters; differentiable."""
        raw: list[th.Tensor] = [
            self.raw_conductance,
            self.raw_reversal,
            self.raw_input_conductance,
            self.raw_capacitance,
        ]
        raw += [self.raw_leak, self.raw_gain, self.raw_sensory_gain]
        return ConductanceValues(*th.split(functional.softplus(th.cat(raw)), [len(r) for r in raw]))

    def arrays(self) -> ConductanceArrays:
        """Masked conductances from the current free parameters; differentiable."""
        n, m, inputs = self.n_neurons, self.n_inter, self.n_inputs
        value = self.values()
        entries = (value.conductance * value.reversal * self.polarity, value.conductance, value.input_conductance)
        zeros = self.raw_leak.new_zeros
        rows = [inputs + m, self.n_presynaptic]
        flat = zeros(sum(rows) * 2 * n).scatter(0, self.matrix_index, th.cat(entries))
        from_inputs, recurrent = th.split(flat.view(sum(rows), 2 * n), rows)
        current = zeros(inputs * m).scatter(0, self.current_index, self.current_weight).view(inputs, m)
        total = value.leak + functional.pad(value.input_conductance, (0, n - m))
        rest = th.cat([value.leak * self.leak_potential, total])
        return ConductanceArrays(current, from_inputs, recurrent, rest, *value[3:4], *value[5:])

    def pace(self, arrays: ConductanceArrays, dt: float | th.Tensor) -> th.Tensor:
        """``C / dt``, the inertia of each potential, ``(N,)``, or ``(batch, N)`` if ``dt`` is ``(batch, 1)``."""
        return arrays.capacitance / dt

    def drive(self, inputs: th.Tensor, arrays: ConductanceArrays, pace: th.Tensor) -> th.Tensor:
        """What stays constant over the sub-steps of one control step.

        :param inputs: scaled inputs, ``(..., n_inputs)``
        :param arrays: from :meth:`arrays`
        :param pace: from :meth:`pace`
        :return: ``(..., 2 n_neurons)``: sum of conductance x potential | sum of conductances + C / dt
        """
        sensed = th.sigmoid(inputs * arrays.sensory_gain - self.sensory_threshold)
        current = th.tanh(inputs @ arrays.current_weight + self.current_bias)
        constant = arrays.rest + functional.pad(pace, (self.n_neurons, 0))
        return th.cat([sensed, current], dim=-1) @ arrays.from_inputs + constant

    def step(self, state: th.Tensor, drive: th.Tensor, arrays: ConductanceArrays, pace: th.Tensor) -> th.Tensor:
        """One semi-implicit Euler sub-step: a convex combination of V, V_leak, the reversal potentials and the current.

        :param state: potentials V, ``(batch, n_neurons)``
        :param drive: from :meth:`drive`
        :param arrays: from :meth:`arrays`
        :param pace: from :meth:`pace`
        :return: the potentials one sub-step later
        """
        released = th.sigmoid(state[:, : self.n_presynaptic] * arrays.gain - self.threshold)
        weighted, total = (drive + released @ arrays.recurrent).chunk(2, dim=-1)
        return (state * pace + weighted) / total

    @th.no_grad()
    def bounds(self, state_low: float = 0.0, state_high: float = 0.0) -> tuple[th.Tensor, th.Tensor]:
        """The interval ``[min(V0, V_leak, E), max(...)]`` no potential leaves, per neuron, whatever inputs and steps.

        :param state_low: lower bound of the starting potentials
        :param state_high: upper bound of the starting potentials
        :return: lower and upper bounds, each ``(n_neurons,)``
        """
        n, m = self.n_neurons, self.n_inter
        value = self.values()
        post = self.matrix_index[: len(self.polarity)] % (2 * n)
        reversal = value.reversal * self.polarity
        low = self.leak_potential.clamp(max=state_low).scatter_reduce(0, post, reversal, "amin")
        high = self.leak_potential.clamp(min=state_high).scatter_reduce(0, post, reversal, "amax")
        low[:m], high[:m] = low[:m].clamp(max=-1.0), high[:m].clamp(min=1.0)  # the input current pulls towards a tanh
        return low, high
