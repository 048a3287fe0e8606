"""NDBCNet without torch: one control step in NumPy from frozen weights, for acting."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np
import torch as th
from torch.nn import functional

from sb3_tbc.arrays import FloatArray
from sb3_tbc.ndbc.cell import ConductanceCell
from sb3_tbc.ndbc.dissipative import DissipativeCell

if TYPE_CHECKING:
    from sb3_tbc.ndbc.network import NDBCNet


class FrozenNDBC:
    """Single control steps of a network in NumPy, below 20 microseconds at batch 1 and K = 3.

    Works in double precision inside: training makes some neurons so fast, and some synapses so strong, that single
    precision would show in the fourth digit of an action.

    :param net: the network; its weights are read now and by :meth:`refresh`
    :raises ValueError: if the network checks half steps, which has no frozen form
    """

    def __init__(self, net: NDBCNet) -> None:
        if net.step_rule is not None and net.step_rule.half_step_check:
            raise ValueError(
                "agents with two levels act from a frozen form of the circuit, which has no half_step_check: leave it "
                "out of adaptive_step; NDBCNet itself and NDBCSAC take it"
            )
        self.net, self.state_dim = net, net.state_dim
        conductance = isinstance(net.cell, ConductanceCell)
        self._advance = self._advance_conductance if conductance else self._advance_dissipative
        self.refresh()

    @th.no_grad()
    def refresh(self) -> None:
        """Read the network's current weights and number of sub-steps."""
        net = self.net
        self._sub_steps = net.sub_steps
        self._readout, self._readout_bias = _numpy(net.readout_weight.T), _numpy(net.readout_bias)
        self._read_from = net.read_from
        if isinstance(net.cell, ConductanceCell):
            self._read_conductance(net.cell)
        elif isinstance(net.cell, DissipativeCell):
            self._read_dissipative(net.cell)

    def _read_conductance(self, cell: ConductanceCell) -> None:
        """Fold all that does not change between updates into four matrices, so that a sub-step is four NumPy calls.

        With ``sigma(x) = (1 + tanh(x / 2)) / 2`` inputs and neurons need one tanh each; the halves go into the matrices
        and their constant part into ``rest``. The conductance equation's sub-step (paper, section 4.3)

            V <- (C/dt V + sum_j g_ij sigma_j E_ij + ...) / (C/dt + sum_j g_ij sigma_j + ...)

        then has numerator and denominator that are linear in ``[tanh | V]``. A sub-step works on ``[x / 2 | V]``,
        presynaptic arguments and all potentials: both come out of one product and one quotient,
        ``[gain w - threshold g | w] / [g | g]``, for numerators w and denominators g of the potentials.
        """
        arrays = type(cell.arrays())(*(tensor.double() for tensor in cell.arrays()))
        inertia = cell.step_terms(arrays, 1.0 / self._sub_steps)
        gain, threshold = 0.5 * arrays.gain, 0.5 * cell.threshold.double()

        def widened(matrix: th.Tensor) -> FloatArray:
            weighted, total = matrix.chunk(2, dim=-1)
            heard = total[..., : len(gain)]
            arguments = weighted[..., : len(gain)] * gain - heard * threshold
            return _numpy(th.cat([arguments, weighted, heard, total], dim=-1))

        sensory, current = th.split(arrays.from_inputs, [cell.n_sensory_synapsing, cell.n_driven])
        half_sums = 0.5 * (sensory.sum(dim=0) + arrays.recurrent.sum(dim=0))
        excite, shift = cell.excitation(arrays)
        self._excite, self._excite_bias = _numpy(self.net.input_gain.unsqueeze(-1) * excite), _numpy(shift)
        self._from_inputs = widened(th.cat([0.5 * sensory, current]))
        self._rest = widened(arrays.rest + half_sums + functional.pad(inertia, (self.state_dim, 0)))
        kept = functional.pad(th.diag(inertia), (0, self.state_dim))
        self._recurrent = widened(th.cat([0.5 * arrays.recurrent, kept]))
        self._gain, self._threshold = _numpy(gain), _numpy(threshold)

    def _read_dissipative(self, cell: DissipativeCell) -> None:
        arrays = cell.arrays()
        eta = cell.step_terms(arrays, 1.0 / self._sub_steps)
        self._excite, self._excite_bias = (
            _numpy(self.net.input_gain.unsqueeze(-1) * arrays.input_weight),
            _numpy(cell.bias),
        )
        self._recurrent = _numpy(cell.enforced(arrays, eta))
        self._inertia, self._gain = _numpy(1.0 / (1.0 + eta * arrays.damping)), _numpy(eta)

    def __call__(self, inputs: FloatArray, state: FloatArray) -> tuple[FloatArray, FloatArray]:
        """One control step.

        :param inputs: ``(batch, n_inputs)``, float32
        :param state: potentials, ``(batch, state_dim)``, float32; not changed
        :return: outputs ``(batch, n_outputs)`` and the next potentials
        """
        state = self._advance(inputs, state)
        read = state if self._read_from == 0 else state[:, self._read_from :]
        outputs = read.dot(self._readout)
        outputs += self._readout_bias
        return outputs.astype(np.float32), state.astype(np.float32)

    def _advance_conductance(self, inputs: FloatArray, state: FloatArray) -> FloatArray:
        presynaptic, recurrent = len(self._gain), self._recurrent
        excited = inputs.astype(np.float64).dot(self._excite)
        excited += self._excite_bias
        constant = np.tanh(excited, excited).dot(self._from_inputs)
        constant += self._rest
        now, total = np.empty((len(state), len(recurrent))), np.empty_like(constant)
        arguments, potentials = now[:, :presynaptic], now[:, presynaptic:]
        numerators, denominators = total[:, : len(recurrent)], total[:, len(recurrent) :]
        potentials[...] = state
        np.multiply(potentials[:, :presynaptic], self._gain, arguments)
        arguments -= self._threshold
        for _ in range(self._sub_steps):
            np.tanh(arguments, arguments)
            now.dot(recurrent, total)
            total += constant
            np.divide(numerators, denominators, now)
        return potentials

    def _advance_dissipative(self, inputs: FloatArray, state: FloatArray) -> FloatArray:
        constant = inputs.dot(self._excite)
        constant += self._excite_bias
        for _ in range(self._sub_steps):
            force = state.dot(self._recurrent)
            force += constant
            np.tanh(force, out=force)
            force *= self._gain
            force += state
            force *= self._inertia
            state = force
        return state


def _numpy(tensor: th.Tensor) -> FloatArray:
    return np.ascontiguousarray(tensor.detach().cpu().numpy(), dtype=np.float64)
