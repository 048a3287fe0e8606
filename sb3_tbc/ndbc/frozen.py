"""NDBCNet without torch: one control step in NumPy from frozen weights, for acting."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np
import torch as th
from numpy.typing import NDArray
from torch.nn import functional

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
        """Read the network's current weights.

        The logistic function is taken as ``(1 + tanh(x / 2)) / 2``, one call instead of four; the halves are folded
        into the matrices.
        """
        net, cell, m = self.net, self.net.cell, self.net.cell.n_inputs
        self._sub_steps = net.sub_steps
        with th.no_grad():
            arrays = cell.arrays()
            inertia = arrays.capacitance * net.sub_steps
            sensory, current = arrays.from_inputs[:m], arrays.from_inputs[m:]
            half_sums = 0.5 * (sensory.sum(dim=0) + arrays.recurrent.sum(dim=0))
            rest = arrays.rest + half_sums + functional.pad(inertia, (self.state_dim, 0))
            excite = th.cat([th.diag(0.5 * arrays.sensory_gain), arrays.current_weight], dim=1)
            self._excite = _numpy(net.input_gain.unsqueeze(-1) * excite)
            self._excite_bias = _numpy(th.cat([-0.5 * cell.sensory_threshold, cell.current_bias]))
            self._from_inputs, self._rest = _numpy(th.cat([0.5 * sensory, current])), _numpy(rest)
            self._recurrent, self._inertia = _numpy(0.5 * arrays.recurrent), _numpy(inertia)
            self._gain, self._threshold = _numpy(0.5 * arrays.gain), _numpy(0.5 * cell.threshold)
            self._readout, self._readout_bias = _numpy(net.readout_weight.T), _numpy(net.readout_bias)
        self._read_from = self.state_dim - self._readout.shape[0]

    def __call__(self, inputs: FloatArray, state: FloatArray) -> tuple[FloatArray, FloatArray]:
        """One control step.

        :param inputs: ``(batch, n_inputs)``, float32
        :param state: potentials, ``(batch, state_dim)``, float32; not changed
        :return: outputs ``(batch, n_outputs)`` and the next potentials
        """
        n, presynaptic = self.state_dim, len(self._gain)
        recurrent, gain, threshold, inertia = self._recurrent, self._gain, self._threshold, self._inertia
        excited = inputs.dot(self._excite)
        excited += self._excite_bias
        drive = np.tanh(excited, out=excited).dot(self._from_inputs)
        drive += self._rest
        for _ in range(self._sub_steps):
            released = state[:, :presynaptic] * gain
            released -= threshold
            total = np.tanh(released, out=released).dot(recurrent)
            total += drive
            state = state * inertia
            state += total[:, :n]
            state /= total[:, n:]
        read = state if self._read_from == 0 else state[:, self._read_from :]
        outputs = read.dot(self._readout)
        outputs += self._readout_bias
        return outputs, state


def _numpy(tensor: th.Tensor) -> FloatArray:
    return np.ascontiguousarray(tensor.detach().cpu().numpy().copy())
