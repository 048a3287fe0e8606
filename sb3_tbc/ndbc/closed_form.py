"""The closed form for deployment: one exponential per neuron and control step instead of K sub-steps (paper, 4.3)."""

from __future__ import annotations

from typing import TYPE_CHECKING, NamedTuple

import numpy as np
import torch as th

from sb3_tbc.arrays import FloatArray, FloatType
from sb3_tbc.ndbc.cell import ConductanceCell

if TYPE_CHECKING:
    from sb3_tbc.ndbc.network import NDBCNet


class ClosedFormError(NamedTuple):
    """How far the closed form is from the sub-stepped network on the same inputs, from the same starting state."""

    output_max: float
    output_rms: float
    state_max: float
    bound_max: float  # largest error bound against the exact solution of the differential equation


class Relaxation(NamedTuple):
    """One control step of the closed form, ``V(t) = (start - target) exp(-rate t) + target``, each ``(batch, N)``."""

    start: FloatArray
    target: FloatArray
    rate: FloatArray
    total: FloatArray  # sum of conductances: rate x capacitance
    heard: tuple[FloatArray, ...]  # the release of presynaptic neurons that each group hears, (batch, P)

    def after(self, time: float) -> FloatArray:
        """Potentials after ``time``."""
        return np.asarray(self.start - (self.target - self.start) * np.expm1(-self.rate * time))


class ClosedFormNDBC:
    """``V(t) = (V0 - A) exp(-(w_tau + f(I)) t) + A`` for conductance dynamics, without retraining. NumPy only.

    With presynaptic activity held fixed the equation is linear: ``w_tau = g_l / C``, ``f(I) = sum w sigma / C`` over
    all synapses and the input current, and A is the potential it relaxes to. Neurons are taken in the wiring's
    :meth:`~sb3_tbc.ndbc.wiring.NDBCWiring.relaxation_order`, each hearing what those before it reach by the end of the
    control step, so a signal passes from sensory to motor neurons in one go. Inter neurons hear only inputs: for them
    the form is exact.

    :param net: the network; its weights are read now and by :meth:`refresh`
    :param dtype: precision of the arithmetic
    :raises ValueError: for dissipative dynamics
    """

    def __init__(self, net: NDBCNet, dtype: FloatType = np.float32) -> None:
        if not isinstance(net.cell, ConductanceCell):
            raise ValueError("only conductance dynamics have the closed form; this network is dissipative")
        self.net, self.cell, self.dtype = net, net.cell, dtype
        self.groups = [np.array(group) for group in net.wiring.relaxation_order()]
        self.refresh()

    def refresh(self) -> None:
        """Read the network's current weights."""
        net, cell = self.net, self.cell
        with th.no_grad():
            named = cell.arrays()._asdict()
        named |= {name: getattr(cell, name) for name in ("sensory_threshold", "current_bias", "threshold")}
        named |= {name: getattr(net, name) for name in ("input_gain", "readout_weight", "readout_bias")}
        self.values = {name: tensor.detach().cpu().numpy().astype(self.dtype) for name, tensor in named.items()}
        n = net.state_dim
        recurrent = self.values["recurrent"]
        self._columns = [recurrent[:, np.concatenate((group, group + n))] for group in self.groups]
        weighted, self.weight = recurrent[:, :n], recurrent[:, n:]
        self.reversal = np.divide(weighted, self.weight, out=np.zeros_like(weighted), where=self.weight > 0)

    def __call__(self, inputs: FloatArray, state: FloatArray) -> tuple[FloatArray, FloatArray]:
        """One control step, as :class:`FrozenNDBC` takes it.

        :param inputs: ``(batch, n_inputs)``
        :param state: potentials, ``(batch, state_dim)``; not changed
        :return: outputs ``(batch, n_outputs)`` and the next potentials
        """
        potentials = self._relax(inputs, state, 1.0).after(1.0)
        read = potentials[:, self.net.read_from :]
        return read @ self.values["readout_weight"].T + self.values["readout_bias"], potentials

    def _input_terms(self, inputs: FloatArray) -> FloatArray:
        v = self.values
        scaled = inputs * v["input_gain"]
        sensed = _logistic(scaled[:, : self.cell.n_sensory_synapsing] * v["sensory_gain"] - v["sensory_threshold"])
        current = np.tanh(scaled @ v["current_weight"] + v["current_bias"])
        terms: FloatArray = np.concatenate((sensed, current), axis=1) @ v["from_inputs"] + v["rest"]
        return terms

    def _released(self, potentials: FloatArray) -> FloatArray:
        gain = self.values["gain"]
        return _logistic(potentials[..., : len(gain)] * gain - self.values["threshold"])

    def _relax(self, inputs: FloatArray, state: FloatArray, duration: float) -> Relaxation:
        """What every neuron relaxes to and how fast, later groups hearing where earlier ones are after ``duration``."""
        n, terms = self.net.state_dim, self._input_terms(inputs)
        start = np.asarray(state, dtype=self.dtype)
        potentials, target, total = start.copy(), np.empty_like(start), np.empty_like(start)
        heard = []
        for group, columns in zip(self.groups, self._columns, strict=True):
            heard.append(self._released(potentials))
            weighted, conductance = np.split(heard[-1] @ columns, 2, axis=1)
            total[:, group] = conductance + terms[:, group + n]
            target[:, group] = (weighted + terms[:, group]) / total[:, group]
            share = -np.expm1(-total[:, group] * duration / self.values["capacitance"][group])
            potentials[:, group] += (target[:, group] - start[:, group]) * share
        return Relaxation(start, target, total / self.values["capacitance"], total, tuple(heard))

    def error_bound(
        self, inputs: FloatArray, state: FloatArray, duration: float = 1.0, pieces: int = 32, passes: int = 8
    ) -> FloatArray:
        """Bound on ``|V_closed - V_exact|`` per neuron after ``duration`` control steps from ``state``, ``(batch, N)``.

        The error e of neuron i obeys ``C e' = -D e + r``, ``|r| <= sum_j w_ij |E_ij - V_i| |sigma_j(t) - sigma_j|``,
        where D and sigma_j are those of the closed form. The control step is cut into pieces; in each, potentials lie
        in a tube, at first the interval no potential leaves. The tubes bound r, that bounds e, and the closed form plus
        and minus e is the next, narrower tube.

        :param inputs: ``(batch, n_inputs)``
        :param state: potentials, ``(batch, state_dim)``
        :param duration: control steps
        :param pieces: pieces of the control step, shortest at its start, where potentials move fastest
        :param passes: how often the tubes are narrowed; the bound holds after any number
        """
        closed = self._relax(inputs, state, duration)
        times = duration * np.linspace(0.0, 1.0, pieces + 1) ** 3
        path = np.stack([closed.after(t) for t in times], axis=1)
        floor, ceiling = np.minimum(path[:, 1:], path[:, :-1]), np.maximum(path[:, 1:], path[:, :-1])
        low, high = (np.repeat(bound[:, None], pieces, axis=1) for bound in self.span(state))
        for _ in range(passes):
            push = self._push(closed, low, high) / closed.total[:, None]
            error = np.zeros_like(path)
            for k, length in enumerate(np.diff(times)):
                kept = np.exp(-closed.rate * length)
                error[:, k + 1] = error[:, k] * kept + push[:, k] * (1.0 - kept)
            worst = np.maximum(error[:, 1:], error[:, :-1])  # in between it is monotonic
            low, high = np.maximum(low, floor - worst), np.minimum(high, ceiling + worst)
        return np.minimum(error[:, -1], np.maximum(high[:, -1] - path[:, -1], path[:, -1] - low[:, -1]))

    def _push(self, closed: Relaxation, low: FloatArray, high: FloatArray) -> FloatArray:
        """Bound on ``sum_j w_ij |E_ij - V_i| |sigma_j(t) - sigma_j|`` in each piece's tube, ``(batch, pieces, N)``."""
        least, most = self._released(low), self._released(high)
        middle, half = 0.5 * (low + high), 0.5 * (high - low)
        push = np.zeros_like(low)
        for group, heard in zip(self.groups, closed.heard, strict=True):
            missed = np.maximum(most - heard[:, None], heard[:, None] - least)
            for j, i in np.argwhere(self.weight[:, group] > 0):
                post = group[i]
                reach = np.abs(self.reversal[j, post] - middle[..., post]) + half[..., post]
                push[..., post] += self.weight[j, post] * missed[..., j] * reach
        return push

    def span(self, state: FloatArray) -> tuple[FloatArray, FloatArray]:
        """The interval that exact potentials starting from ``state`` never leave: two bounds, ``(batch, N)`` each."""
        low, high = (bound.cpu().numpy().astype(self.dtype) for bound in self.cell.bounds(np.inf, -np.inf))
        return np.minimum(low, state), np.maximum(high, state)

    def compare(self, inputs: FloatArray, state: FloatArray) -> ClosedFormError:
        """The closed form beside the network's K sub-steps, one control step from each state."""
        outputs, potentials = self(inputs, state)
        with th.no_grad():
            tensors = (th.as_tensor(np.asarray(x, dtype=np.float32)) for x in (inputs, state))
            reference, stepped = (x.cpu().numpy() for x in self.net(*tensors))
        difference = outputs - reference
        return ClosedFormError(
            float(np.abs(difference).max()),
            float(np.sqrt(np.mean(difference**2))),
            float(np.abs(potentials - stepped).max()),
            float(self.error_bound(inputs, state).max()),
        )


def _logistic(x: FloatArray) -> FloatArray:
    return np.asarray(0.5 + 0.5 * np.tanh(0.5 * x))
