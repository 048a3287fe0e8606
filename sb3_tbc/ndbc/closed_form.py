"""The closed form for deployment: one exponential per neuron and control step instead of K sub-steps (paper, 4.3)."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np
import torch as th
from numpy.typing import NDArray

from sb3_tbc.ndbc.cell import ConductanceCell
from sb3_tbc.ndbc.wiring import LAYERS

if TYPE_CHECKING:
    from sb3_tbc.ndbc.network import NDBCNet

FloatArray = NDArray[np.floating[Any]]


class ClosedFormError(NamedTuple):
    """How far the closed form is from the sub-stepped network on the same inputs, from the same starting state."""

    output_max: float
    output_rms: float
    state_max: float
    bound_max: float  # largest error bound against the exact solution of the differential equation


class ClosedFormNDBC:
    """``V(t) = (V0 - A) exp(-(w_tau + f(I)) t) + A`` for conductance dynamics, without retraining. NumPy only.

    With presynaptic activity held fixed the equation is linear: ``w_tau = g_l / C``, ``f(I) = sum w sigma / C`` over
    all synapses and the input current, and A is the potential it relaxes to. Layers are taken in order, each seeing
    what the layers before it reach by the end of the control step, so a signal passes from sensory to motor neurons in
    one go. Inter neurons hear only inputs: for them the form is exact.

    :param net: the network; its weights are read now and by :meth:`refresh`
    :param dtype: precision of the arithmetic
    :raises ValueError: for dissipative dynamics
    """

    def __init__(self, net: NDBCNet, dtype: type[np.floating[Any]] = np.float32) -> None:
        if not isinstance(net.cell, ConductanceCell):
            raise ValueError("only conductance dynamics have the closed form; this network is dissipative")
        self.net, self.cell, self.dtype = net, net.cell, dtype
        self.layers = [net.wiring.layer(name) for name in LAYERS]
        self.refresh()

    def refresh(self) -> None:
        """Read the network's current weights."""
        net, cell = self.net, self.cell
        with th.no_grad():
            named = cell.arrays()._asdict()
        named |= {name: getattr(cell, name) for name in ("sensory_threshold", "current_bias", "threshold")}
        named |= {name: getattr(net, name) for name in ("input_gain", "readout_weight", "readout_bias")}
        self.values = {name: tensor.detach().cpu().numpy().astype(self.dtype) for name, tensor in named.items()}
        v, n = self.values, net.state_dim
        self.reversal_weight, self.weight = v["recurrent"][:, :n], v["recurrent"][:, n:]

    def __call__(self, inputs: FloatArray, state: FloatArray) -> tuple[FloatArray, FloatArray]:
        """One control step, as :class:`FrozenNDBC` takes it.

        :param inputs: ``(batch, n_inputs)``
        :param state: potentials, ``(batch, state_dim)``; not changed
        :return: outputs ``(batch, n_outputs)`` and the next potentials
        """
        potentials, _, _ = self._relax(inputs, state, 1.0)
        read = potentials[:, self.net.read_from :]
        return read @ self.values["readout_weight"].T + self.values["readout_bias"], potentials

    def _drive(self, inputs: FloatArray) -> FloatArray:
        v = self.values
        scaled = inputs * v["input_gain"]
        sensed = _logistic(scaled * v["sensory_gain"] - v["sensory_threshold"])
        current = np.tanh(scaled @ v["current_weight"] + v["current_bias"])
        drive: FloatArray = np.concatenate((sensed, current), axis=1) @ v["from_inputs"] + v["rest"]
        return drive

    def _released(self, potentials: FloatArray) -> FloatArray:
        gain = self.values["gain"]
        return _logistic(potentials[:, : len(gain)] * gain - self.values["threshold"])

    def _relax(
        self, inputs: FloatArray, state: FloatArray, duration: float
    ) -> tuple[FloatArray, FloatArray, FloatArray]:
        """Potentials after ``duration``, total conductances, and ``1 - exp(-(w_tau + f) t)``, each ``(batch, N)``."""
        n = self.net.state_dim
        drive = self._drive(inputs)
        potentials = np.array(state, dtype=self.dtype)
        totals, relaxed = np.empty_like(potentials), np.empty_like(potentials)
        for layer in self.layers:
            released = self._released(potentials)
            total = drive[:, n:][:, layer] + released @ self.weight[:, layer]
            target = (drive[:, :n][:, layer] + released @ self.reversal_weight[:, layer]) / total
            share = -np.expm1(-total * duration / self.values["capacitance"][layer])
            potentials[:, layer] += (target - potentials[:, layer]) * share
            totals[:, layer], relaxed[:, layer] = total, share
        return potentials, totals, relaxed

    def error_bound(self, inputs: FloatArray, state: FloatArray, duration: float = 1.0) -> FloatArray:
        """Bound on ``|V_closed - V_exact|`` per neuron after ``duration`` control steps from ``state``, ``(batch, N)``.

        The error e of a neuron obeys ``C e' = -D e + r`` with ``|r| <= sum_j w_j max|E_j - V| |sigma_j(t) - sigma_j|``,
        hence ``|e| <= r (1 - exp(-D t / C)) / D``. A presynaptic neuron's logistic is off by at most ``gain / 4`` times
        how far its potential strays from the value the form used, and by at most one.
        """
        end, totals, relaxed = self._relax(inputs, state, duration)
        low, high = self.span(state)
        reach = self._reach(low, high)
        span = high - low
        stray = span[:, : len(self.values["gain"])].copy()  # neurons of the same or a later layer: V_j(0) was used
        error = np.zeros_like(end)
        for layer in self.layers:
            missed = np.minimum(1.0, stray * self.values["gain"] / 4.0)
            push = np.einsum("bp,pn,bpn->bn", missed, self.weight[:, layer], reach[:, :, layer])
            error[:, layer] = np.minimum(push * relaxed[:, layer] / totals[:, layer], span[:, layer])
            moved = np.abs(end[:, layer] - np.asarray(state)[:, layer]) + error[:, layer]
            count = max(0, min(layer.stop, stray.shape[1]) - layer.start)
            stray[:, layer.start : layer.start + count] = np.minimum(moved, span[:, layer])[:, :count]
        return error

    def span(self, state: FloatArray) -> tuple[FloatArray, FloatArray]:
        """The interval the exact potentials cannot leave from ``state`` on, lower and upper bounds ``(batch, N)``."""
        low, high = (bound.cpu().numpy().astype(self.dtype) for bound in self.cell.bounds(np.inf, -np.inf))
        return np.minimum(low, state), np.maximum(high, state)

    def _reach(self, low: FloatArray, high: FloatArray) -> FloatArray:
        """Largest ``|E_ij - V_i|`` inside the interval, ``(batch, P, N)``; zero where there is no synapse."""
        reversal = np.divide(self.reversal_weight, self.weight, out=np.zeros_like(self.weight), where=self.weight > 0)
        distance = np.maximum(np.abs(reversal - low[:, None]), np.abs(high[:, None] - reversal))
        return np.asarray(np.where(self.weight > 0, distance, 0.0))

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
