"""NDBCNet without torch: one control step in NumPy from frozen weights, for acting."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np
import torch as th
from numpy.typing import NDArray

if TYPE_CHECKING:
    from sb3_tbc.ndbc.network import NDBCNet

FloatArray = NDArray[np.floating[Any]]


class FrozenNDBC:
    """Single control steps of a network in float32 NumPy, about 20 microseconds at batch 1 and K = 3.

    :param net: the network; its weights are read now and by :meth:`refresh`
    """

    def __init__(self, net: NDBCNet) -> None:
        self.net = net
        self.state_dim = net.state_dim
        self.refresh()

    def refresh(self) -> None:
        """Read the network's current weights."""
        cell = self.net.cell
        with th.no_grad():
            arrays = cell.arrays()
            inertia = arrays.capacitance * self.net.sub_steps
            self._current_weight = _numpy(self.net.input_gain.unsqueeze(-1) * arrays.current_weight)
            self._from_inputs = _numpy(arrays.from_inputs)
            self._recurrent = _numpy(arrays.recurrent)
            self._rest = _numpy(arrays.rest + th.nn.functional.pad(inertia, (self.state_dim, 0)))
            self._inertia = _numpy(inertia)
            self._sensory_gain = _numpy(-self.net.input_gain * cell.sensory_gain)
            self._readout = _numpy(self.net.readout_weight.T)
            self._sensory_threshold, self._current_bias = _numpy(cell.sensory_threshold), _numpy(cell.current_bias)
            self._gain, self._threshold = _numpy(-cell.gain), _numpy(cell.threshold)
            self._readout_bias = _numpy(self.net.readout_bias)
        self._sub_steps = self.net.sub_steps
        self._read_from = self.state_dim - self._readout.shape[0]

    def __call__(self, inputs: FloatArray, state: FloatArray) -> tuple[FloatArray, FloatArray]:
        """One control step.

        :param inputs: ``(batch, n_inputs)``, float32
        :param state: potentials, ``(batch, state_dim)``, float32; not changed
        :return: outputs ``(batch, n_outputs)`` and the next potentials
        """
        n = self.state_dim
        sensed = np.exp(inputs * self._sensory_gain + self._sensory_threshold)
        sensed += 1.0
        np.reciprocal(sensed, out=sensed)
        current = np.tanh(inputs @ self._current_weight + self._current_bias)
        drive = np.concatenate((sensed, current), axis=1) @ self._from_inputs
        drive += self._rest
        for _ in range(self._sub_steps):
            released = state * self._gain
            released += self._threshold
            np.exp(released, out=released)
            released += 1.0
            np.reciprocal(released, out=released)
            total = released @ self._recurrent
            total += drive
            state = state * self._inertia
            state += total[:, :n]
            state /= total[:, n:]
        return state[:, self._read_from :] @ self._readout + self._readout_bias, state


def _numpy(tensor: th.Tensor) -> FloatArray:
    return np.ascontiguousarray(tensor.detach().cpu().numpy().copy())
