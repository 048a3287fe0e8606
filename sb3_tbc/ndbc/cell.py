"""The conductance cell: what a synapse does, and one semi-implicit step of all membrane potentials at once."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from typing import Any, NamedTuple, Protocol

import numpy as np
import torch as th
from torch import nn
from torch.nn import functional

from sb3_tbc.ndbc.wiring import LAYERS, NDBCWiring

INITIAL_RANGES = {
    "conductance": (0.1, 0.6),
    "reversal": (0.5, 1.5),
    "capacitance": (0.1, 0.3),
    "leak": (0.05, 0.2),
    "gain": (2.0, 4.0),
    "input_conductance": (0.5, 1.0),
}
"""Ranges from which initial values are drawn uniformly."""


class Cell(Protocol):
    """What :class:`~sb3_tbc.ndbc.network.NDBCNet` asks of a cell; N neurons.

    A control step is ``a = arrays()``, ``s = step_terms(a, dt)``, ``i = input_terms(inputs, a, s)``, and then one
    ``state = step(state, i, a, s)`` per sub-step.
    """

    def arrays(self) -> Any:
        """Masked weights from the current free parameters; differentiable."""

    def step_terms(self, arrays: Any, dt: float | th.Tensor) -> th.Tensor:
        """What depends on the length ``dt`` of a sub-step, ``(N,)``, or ``(batch, N)`` if ``dt`` is ``(batch, 1)``."""

    def input_terms(self, inputs: th.Tensor, arrays: Any, step_terms: th.Tensor) -> th.Tensor:
        """What stays constant over the sub-steps of one control step, for scaled inputs ``(..., n_inputs)``."""

    def step(self, state: th.Tensor, input_terms: th.Tensor, arrays: Any, step_terms: th.Tensor) -> th.Tensor:
        """The state ``(batch, N)`` one sub-step later."""


class ConductanceArrays(NamedTuple):
    """Everything a step needs, derived once per call.

    N neurons, I inputs, S sensory neurons with synapses of their own (all I in the paper's form, none of lean ones),
    M neurons with an input current, P neurons that others hear.
    """

    current_weight: th.Tensor  # (I, M), input current, on the mask of the sensory neurons' targets
    from_inputs: th.Tensor  # (S + M, 2 N): columns w E | w of sensory synapses and of the input current
    recurrent: th.Tensor  # (P, 2 N): columns w E | w of the synapses among neurons, P presynaptic ones
    rest: th.Tensor  # (2 N,): g_l V_leak | g_l + g_in
    capacitance: th.Tensor  # (N,)
    gain: th.Tensor  # (P,), steepness of the presynaptic logistic
    sensory_gain: th.Tensor  # (S,)


class ConductanceValues(NamedTuple):
    """The positive quantities of the cell: per synapse (sensory ones first), neuron with a current, neuron or input."""

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


def checked_time_constants(ranges: Mapping[str, Sequence[float] | None] | None) -> dict[str, tuple[float, float]]:
    """Ranges of time constants by layer, without the layers that have none.

    :raises ValueError: for another layer, or what is no range of positive numbers
    """
    checked = {}
    for layer, given in (ranges or {}).items():
        if layer not in LAYERS:
            raise ValueError(f"time_constants has ranges for {LAYERS}, got {layer!r}; sensory neurons have no state")
        if given is not None:
            checked[layer] = positive_range(f"time_constants[{layer!r}]", given)
    return checked


def positive_range(name: str, given: Sequence[float]) -> tuple[float, float]:
    """Lower and upper end of a range of positive numbers.

    :param name: names the range in messages
    :raises ValueError: for anything else
    """
    pair = tuple(float(x) for x in given)
    if len(pair) != 2 or not 0.0 < pair[0] <= pair[1] < math.inf:
        raise ValueError(f"{name} must be [low, high] with 0 < low <= high, got {list(given)}")
    return pair[0], pair[1]


def uniform(size: int, low: float, high: float, generator: th.Generator | None) -> th.Tensor:
    """Uniform numbers in ``[low, high)``, from torch's global stream if there is no generator."""
    return low + (high - low) * th.rand(size, generator=generator)


def positive_parameter(size: int, name: str, generator: th.Generator | None) -> nn.Parameter:
    """Free parameters whose softplus is uniform in the range that :data:`INITIAL_RANGES` gives to ``name``."""
    return nn.Parameter(inverse_softplus(uniform(size, *INITIAL_RANGES[name], generator)))


class ConductanceCell(nn.Module):
    """Membrane potentials ``C dV/dt = g_l (V_leak - V) + sum_j w_ij sigma(V_j) (E_ij - V) + g_in (tanh(W u + b) - V)``.

    Conductances, capacitances, gains and the size of reversal potentials are softplus of free parameters, one per
    synapse or neuron: what the wiring leaves out has no parameter at all, so its weight and gradient are exactly zero.
    The sign the paper gives to w lives in the reversal potential: excitatory E > 0, inhibitory E < 0 (section 4.3). The
    logistic of neuron j is ``sigma(V_j) = 1 / (1 + exp(threshold_j - gain_j V_j))``; time in control steps.

    :param wiring: who is wired to whom, with polarities
    :param generator: source of the initial values; torch's global one if None
    :param time_constants: range of the initial time constants of each layer named, in control steps, drawn
        log-uniformly; the capacitance is then the exponential of a free parameter, so that training changes slow
        neurons by the same factors as fast ones. Other layers, and all by default, draw capacitances as
        :data:`INITIAL_RANGES` says
    :param initial_gains: range of the initial gains of all logistics, by default that of :data:`INITIAL_RANGES`
    :raises ValueError: if a layer or a range is not possible
    """

    def __init__(
        self,
        wiring: NDBCWiring,
        generator: th.Generator | None = None,
        time_constants: Mapping[str, Sequence[float] | None] | None = None,
        initial_gains: Sequence[float] | None = None,
    ) -> None:
        super().__init__()
        ranges = checked_time_constants(time_constants)
        self._gains = positive_range("initial_gains", initial_gains or INITIAL_RANGES["gain"])
        self.log_capacitance = bool(ranges)
        self.n_inputs, self.n_driven, self.n_neurons = wiring.n_inputs, wiring.n_driven, wiring.n_neurons
        self.n_presynaptic = int(np.flatnonzero(wiring.recurrent.any(axis=1)).max(initial=0)) + 1
        self.polarity: th.Tensor
        self.matrix_index: th.Tensor
        self.current_index: th.Tensor
        self._index_synapses(wiring)
        self._draw_parameters(generator)
        if ranges:
            self._draw_time_constants(wiring, ranges, generator)

    @th.no_grad()
    def _draw_time_constants(
        self, wiring: NDBCWiring, ranges: Mapping[str, tuple[float, float]], generator: th.Generator | None
    ) -> None:
        """Capacitances for time constants in ``ranges``: ``C = tau x conductance``, with every logistic half open."""
        capacitance = functional.softplus(self.raw_capacitance)
        arrays = self.arrays()
        s, n = self.n_sensory_synapsing, self.n_neurons
        released = arrays.from_inputs[:s, n:].sum(dim=0) + arrays.recurrent[:, n:].sum(dim=0)
        conductance = arrays.rest[n:] + 0.5 * released
        for name, (low, high) in ranges.items():
            layer = wiring.layer(name)
            drawn = uniform(layer.stop - layer.start, math.log(low), math.log(high), generator).exp()
            capacitance[layer] = drawn * conductance[layer]
        self.raw_capacitance.copy_(capacitance.log())

    @property
    def n_sensory_synapsing(self) -> int:
        """Sensory neurons that have synapses besides the input current: all of them, or none where they are lean."""
        return self.n_inputs

    def _draw_parameters(self, generator: th.Generator | None) -> None:
        n, m, inputs = self.n_neurons, self.n_driven, self.n_inputs
        self.raw_conductance = positive_parameter(len(self.polarity), "conductance", generator)
        self.raw_reversal = positive_parameter(len(self.polarity), "reversal", generator)
        self.raw_input_conductance = positive_parameter(m, "input_conductance", generator)
        self.raw_capacitance = positive_parameter(n, "capacitance", generator)
        self.raw_leak = positive_parameter(n, "leak", generator)
        self.raw_gain = self._gain_parameter(self.n_presynaptic, generator)
        self.raw_sensory_gain = self._gain_parameter(inputs, generator)
        self.leak_potential = nn.Parameter(uniform(n, -0.1, 0.1, generator))
        self.threshold = nn.Parameter(uniform(self.n_presynaptic, -0.5, 0.5, generator))
        self.sensory_threshold = nn.Parameter(uniform(inputs, -0.5, 0.5, generator))
        self._draw_current(generator)

    def _gain_parameter(self, size: int, generator: th.Generator | None) -> nn.Parameter:
        return nn.Parameter(inverse_softplus(uniform(size, *self._gains, generator)))

    def _draw_current(self, generator: th.Generator | None) -> None:
        spread = 2.0 / max(1.0, len(self.current_index) / self.n_driven) ** 0.5
        self.current_weight = nn.Parameter(uniform(len(self.current_index), -spread, spread, generator))
        self.current_bias = nn.Parameter(uniform(self.n_driven, -0.3, 0.3, generator))

    def _index_synapses(self, wiring: NDBCWiring) -> None:
        """Where each synapse's ``w E`` and ``w`` go in one flat matrix with rows sensory | input current | neurons."""
        n, m, s = self.n_neurons, self.n_driven, self.n_sensory_synapsing
        pre_s, post_s = np.nonzero(wiring.sensory[:s])
        pre_r, post_r = np.nonzero(wiring.recurrent)
        rows = np.concatenate([pre_s, s + m + pre_r])
        reversal_at = rows * 2 * n + np.concatenate([post_s, post_r])
        current_at = (s + np.arange(m)) * 2 * n + np.arange(m)
        polarity = np.concatenate([wiring.sensory[pre_s, post_s], wiring.recurrent[pre_r, post_r]])
        pre_c, post_c = np.nonzero(wiring.sensory[:, :m])
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
        return self._scaled(ConductanceValues(*th.split(functional.softplus(th.cat(raw)), [len(r) for r in raw])))

    def _scaled(self, value: ConductanceValues) -> ConductanceValues:
        """The values with the capacitance that belongs to the form of its free parameter."""
        return value._replace(capacitance=self.raw_capacitance.exp()) if self.log_capacitance else value

    def synapse_currents(self, value: ConductanceValues) -> th.Tensor:
        """``w E`` of every synapse; differentiable."""
        return value.conductance * value.reversal * self.polarity

    def reversal(self, value: ConductanceValues) -> th.Tensor:
        """Signed reversal potentials, one per synapse; differentiable."""
        return value.reversal * self.polarity

    def arrays(self) -> ConductanceArrays:
        """Masked conductances from the current free parameters; differentiable."""
        value = self.values()
        return self._assemble(value, self.synapse_currents(value))

    def _assemble(self, value: ConductanceValues, weighted: th.Tensor) -> ConductanceArrays:
        """The arrays for positive quantities and each synapse's ``w E``."""
        n, m, inputs = self.n_neurons, self.n_driven, self.n_inputs
        zeros = self.raw_leak.new_zeros
        rows = [self.n_sensory_synapsing + m, self.n_presynaptic]
        entries = th.cat((weighted, value.conductance, value.input_conductance))
        flat = zeros(sum(rows) * 2 * n).scatter(0, self.matrix_index, entries)
        from_inputs, recurrent = th.split(flat.view(sum(rows), 2 * n), rows)
        current = zeros(inputs * m).scatter(0, self.current_index, self.current_weight).view(inputs, m)
        total = value.leak + functional.pad(value.input_conductance, (0, n - m))
        return ConductanceArrays(
            current_weight=current,
            from_inputs=from_inputs,
            recurrent=recurrent,
            rest=th.cat([value.leak * self.leak_potential, total]),
            capacitance=value.capacitance,
            gain=value.gain,
            sensory_gain=value.sensory_gain,
        )

    def excitation(self, arrays: ConductanceArrays) -> tuple[th.Tensor, th.Tensor]:
        """Weights W ``(n_inputs, S + M)`` and shifts b ``(S + M,)``: inputs u act through ``tanh(u W + b)`` alone.

        The logistic of sensory neurons is ``(1 + tanh(x / 2)) / 2``. W and b hold x / 2; callers halve the sensory rows
        of ``from_inputs`` and add half of their sum to ``rest``.
        """
        weight = th.cat((th.diag(0.5 * arrays.sensory_gain), arrays.current_weight), dim=1)
        return weight, th.cat((-0.5 * self.sensory_threshold, self.current_bias))

    def step_terms(self, arrays: ConductanceArrays, dt: float | th.Tensor) -> th.Tensor:
        """``C / dt``, the inertia of each potential, ``(N,)``, or ``(batch, N)`` if ``dt`` is ``(batch, 1)``."""
        return arrays.capacitance / dt

    def input_terms(self, inputs: th.Tensor, arrays: ConductanceArrays, step_terms: th.Tensor) -> th.Tensor:
        """What stays constant over the sub-steps of one control step.

        :param inputs: scaled inputs, ``(..., n_inputs)``
        :param arrays: from :meth:`arrays`
        :param step_terms: from :meth:`step_terms`
        :return: ``(..., 2 n_neurons)``: sum of conductance x potential | sum of conductances + C / dt
        """
        constant = arrays.rest + functional.pad(step_terms, (self.n_neurons, 0))
        return self.heard_inputs(inputs, arrays) @ arrays.from_inputs + constant

    def heard_inputs(self, inputs: th.Tensor, arrays: ConductanceArrays) -> th.Tensor:
        """What sensory neurons release, and the potentials the input currents pull towards, ``(..., S + M)``."""
        sensed = th.sigmoid(inputs * arrays.sensory_gain - self.sensory_threshold)
        current = th.tanh(inputs @ arrays.current_weight + self.current_bias)
        return th.cat([sensed, current], dim=-1)

    def step(
        self, state: th.Tensor, input_terms: th.Tensor, arrays: ConductanceArrays, step_terms: th.Tensor
    ) -> th.Tensor:
        """One semi-implicit Euler sub-step: a convex combination of V, V_leak, the reversal potentials and the current.

        :param state: potentials V, ``(batch, n_neurons)``
        :param input_terms: from :meth:`input_terms`
        :param arrays: from :meth:`arrays`
        :param step_terms: from :meth:`step_terms`
        :return: the potentials one sub-step later
        """
        released = th.sigmoid(state[:, : self.n_presynaptic] * arrays.gain - self.threshold)
        weighted, total = (input_terms + released @ arrays.recurrent).chunk(2, dim=-1)
        return (state * step_terms + weighted) / total

    @th.no_grad()
    def bounds(self, state_low: float = 0.0, state_high: float = 0.0) -> tuple[th.Tensor, th.Tensor]:
        """The interval ``[min(V0, V_leak, E), max(...)]`` no potential leaves, per neuron, whatever inputs and steps.

        :param state_low: lower bound of the starting potentials
        :param state_high: upper bound of the starting potentials
        :return: lower and upper bounds, each ``(n_neurons,)``
        """
        n, m = self.n_neurons, self.n_driven
        reversal = self.reversal(self.values())
        post = self.matrix_index[: len(reversal)] % (2 * n)
        low = self.leak_potential.clamp(max=state_low).scatter_reduce(0, post, reversal, "amin")
        high = self.leak_potential.clamp(min=state_high).scatter_reduce(0, post, reversal, "amax")
        low[:m], high[:m] = low[:m].clamp(max=-1.0), high[:m].clamp(min=1.0)  # the input current pulls towards a tanh
        return low, high

    @th.no_grad()
    def cut(self, synapse: int) -> None:
        """Let a synapse conduct nothing; a sensory one also loses its share in the input current.

        :param synapse: its number, sensory ones first, each kind in the order of presynaptic, then postsynaptic neuron
        """
        self.raw_conductance[synapse] = -th.inf  # softplus gives zero
        if synapse < len(self.current_weight):
            self.current_weight[synapse] = 0.0
