"""The conductance cell: what a synapse does, and one semi-implicit step of all membrane potentials at once."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
import torch as th
from torch import nn
from torch.nn import functional

from sb3_tbc.ndbc.wiring import NDBCWiring


class ConductanceArrays(NamedTuple):
    """Everything a step needs, derived once per call from the free parameters (N neurons, I inputs, M inter neurons)."""

    current_weight: th.Tensor  # (I, M), input current, on the sensory -> inter mask
    from_inputs: th.Tensor  # (I + M, 2 N): columns w E | w of sensory synapses and of the input current
    recurrent: th.Tensor  # (N, 2 N): columns w E | w of the synapses among neurons
    rest: th.Tensor  # (2 N,): g_l V_leak | g_l + g_in
    capacitance: th.Tensor  # (N,)
    gain: th.Tensor  # (N,), steepness of the presynaptic logistic
    sensory_gain: th.Tensor  # (I,)


def inverse_softplus(value: th.Tensor) -> th.Tensor:
    """The free parameter whose softplus is ``value`` (> 0)."""
    return value + th.log(-th.expm1(-value))


class ConductanceCell(nn.Module):
    """Membrane potentials ``C dV/dt = g_l (V_leak - V) + sum_j w_ij sigma(V_j) (E_ij - V) + g_in (tanh(W u + b) - V)``.

    Conductances, capacitances and the size of reversal potentials are softplus of free parameters, one per synapse or
    neuron: what the wiring leaves out has no parameter at all, so its weight and gradient are exactly zero. The sign the
    paper gives to w lives in the reversal potential: excitatory E > 0, inhibitory E < 0. (Paper, section 4.3.)

    :param wiring: who is wired to whom, with polarities
    :param generator: source of the initial values
    """

    def __init__(self, wiring: NDBCWiring, generator: th.Generator) -> None:
        super().__init__()
        self.n_inputs, self.n_inter, self.n_neurons = wiring.n_inputs, wiring.inter, wiring.n_neurons
        self._index_synapses(wiring)
        n, m = self.n_neurons, self.n_inter

        def uniform(size: int, low: float, high: float) -> th.Tensor:
            return low + (high - low) * th.rand(size, generator=generator)

        n_syn, n_current = len(self.polarity), len(self.current_index)
        self.raw_conductance = nn.Parameter(inverse_softplus(uniform(n_syn, *INITIAL["conductance"])))
        self.raw_reversal = nn.Parameter(inverse_softplus(uniform(n_syn, *INITIAL["reversal"])))
        self.raw_capacitance = nn.Parameter(inverse_softplus(uniform(n, *INITIAL["capacitance"])))
        self.raw_leak = nn.Parameter(inverse_softplus(uniform(n, *INITIAL["leak"])))
        self.leak_potential = nn.Parameter(uniform(n, -0.1, 0.1))
        self.raw_gain = nn.Parameter(inverse_softplus(uniform(n, *INITIAL["gain"])))
        self.threshold = nn.Parameter(uniform(n, -0.5, 0.5))
        self.raw_sensory_gain = nn.Parameter(inverse_softplus(uniform(self.n_inputs, *INITIAL["gain"])))
        self.sensory_threshold = nn.Parameter(uniform(self.n_inputs, -0.5, 0.5))
        self.raw_input_conductance = nn.Parameter(inverse_softplus(uniform(m, *INITIAL["input"])))
        fan_in = max(1.0, n_current / m)
        self.current_weight = nn.Parameter(uniform(n_current, -1.0, 1.0) * INITIAL["current"][1] / fan_in**0.5)
        self.current_bias = nn.Parameter(uniform(m, -0.3, 0.3))

    def _index_synapses(self, wiring: NDBCWiring) -> None:
        """Where each synapse's ``w E`` and ``w`` go in one flat matrix with rows sensory | input current | neurons."""
        n, m, inputs = self.n_neurons, self.n_inter, self.n_inputs
        pre_s, post_s = np.nonzero(wiring.sensory)
        pre_r, post_r = np.nonzero(wiring.recurrent)
        rows = np.concatenate([pre_s, inputs + m + pre_r])
        columns = np.concatenate([post_s, post_r])
        reversal_at = rows * 2 * n + columns
        current_at = (inputs + np.arange(m)) * 2 * n + np.arange(m)
        polarity = np.concatenate([wiring.sensory[pre_s, post_s], wiring.recurrent[pre_r, post_r]]).astype(np.float32)
        on_inter = wiring.sensory[:, wiring.layer("inter")]
        pre_c, post_c = np.nonzero(on_inter)
        self.polarity: th.Tensor
        self.matrix_index: th.Tensor
        self.current_index: th.Tensor
        self.register_buffer("polarity", th.as_tensor(polarity))
        self.register_buffer("matrix_index", th.as_tensor(np.concatenate([reversal_at, reversal_at + n, current_at])))
        self.register_buffer("current_index", th.as_tensor(pre_c * m + post_c))

    def positive(self) -> tuple[th.Tensor, ...]:
        """The positive quantities: conductance, |E|, g_in, C, g_l, gain, sensory gain, each one per synapse or neuron."""
        raw = [self.raw_conductance, self.raw_reversal, self.raw_input_conductance, self.raw_capacitance, self.raw_leak]
        raw += [self.raw_gain, self.raw_sensory_gain]
        return functional.softplus(th.cat(raw)).split([len(r) for r in raw])

    def arrays(self) -> ConductanceArrays:
        """Masked conductances from the current free parameters; differentiable."""
        n, m, inputs = self.n_neurons, self.n_inter, self.n_inputs
        positive = self.positive()
        conductance, reversal, input_conductance, capacitance, leak, gain, sensory_gain = positive
        values = th.cat([conductance * reversal * self.polarity, conductance, input_conductance])
        flat = values.new_zeros((inputs + m + n) * 2 * n).scatter(0, self.matrix_index, values)
        from_inputs, recurrent = flat.view(inputs + m + n, 2 * n).split([inputs + m, n])
        current = values.new_zeros(inputs * m).scatter(0, self.current_index, self.current_weight).view(inputs, m)
        rest = th.cat([leak * self.leak_potential, leak + functional.pad(input_conductance, (0, n - m))])
        return ConductanceArrays(current, from_inputs, recurrent, rest, capacitance, gain, sensory_gain)

    def drive(self, inputs: th.Tensor, arrays: ConductanceArrays) -> th.Tensor:
        """What the inputs contribute to numerator and denominator of the step, constant over its sub-steps.

        :param inputs: scaled inputs, ``(..., n_inputs)``
        :return: ``(..., 2 n_neurons)``: sum of conductance x potential | sum of conductances
        """
        sensed = th.sigmoid(inputs * arrays.sensory_gain - self.sensory_threshold)
        current = th.tanh(inputs @ arrays.current_weight + self.current_bias)
        return th.cat([sensed, current], dim=-1) @ arrays.from_inputs + arrays.rest

    def step(self, potentials: th.Tensor, drive: th.Tensor, inertia: th.Tensor, arrays: ConductanceArrays) -> th.Tensor:
        """One semi-implicit Euler sub-step: a convex combination of V, V_leak, the reversal potentials and the current.

        :param potentials: V, ``(batch, n_neurons)``
        :param drive: from :meth:`drive`, with ``inertia`` added to its second half
        :param inertia: ``C / dt``, ``(n_neurons,)`` or ``(batch, n_neurons)``
        :return: the potentials one sub-step later
        """
        released = th.sigmoid(potentials * arrays.gain - self.threshold)
        weighted, total = (drive + released @ arrays.recurrent).chunk(2, dim=-1)
        return (potentials * inertia + weighted) / total


INITIAL = {
    "conductance": (0.1, 0.6),
    "reversal": (0.5, 1.5),
    "capacitance": (0.1, 0.3),
    "leak": (0.05, 0.2),
    "gain": (2.0, 4.0),
    "input": (0.5, 1.0),
    "current": (0.0, 2.0),
}
"""Ranges of the initial values; chosen by fits of random teachers (docs/ndbcnet.md)."""
