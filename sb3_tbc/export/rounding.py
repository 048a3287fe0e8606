"""Weights of eight bits: whole numbers from -127 to 127, and a step for each neuron that hears them.

Steps are powers of two, so that a step times a whole number is exact in single precision: what was rounded here can be
stored as whole numbers without a second rounding, and every export format computes with the same weights.
"""

from __future__ import annotations

from dataclasses import replace
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from sb3_tbc.arrays import FloatArray
from sb3_tbc.export.policy import MLP, Circuit, Dissipative, ExportedPolicy

LARGEST = 127
MOST_HALVINGS = 30  # a shift of 32 bits in C


class Whole(NamedTuple):
    """A weight matrix as whole numbers; the weights from input i to output o are ``numbers[i, o] * steps[o]``."""

    numbers: NDArray[np.int8]  # (inputs, outputs)
    unit: float  # the largest step, a power of two
    halvings: NDArray[np.uint8]  # (outputs,): how often the unit is halved to give the output's step

    @property
    def values(self) -> NDArray[np.float32]:
        """The rounded matrix."""
        return (self.numbers * (self.unit / 2.0**self.halvings)).astype(np.float32)


def whole(matrix: FloatArray) -> Whole:
    """Round to eight bits; an entry is off by half of its output's step at most. A second time changes nothing.

    :param matrix: finite numbers, ``(inputs, outputs)``
    """
    largest = np.abs(np.asarray(matrix, np.float64)).max(axis=0, initial=0.0)
    exponents = np.ceil(np.log2(np.where(largest > 0, largest, largest.max(initial=0.0) or 1.0) / LARGEST))
    top = exponents.max(initial=-np.inf)
    halvings = np.minimum(top - exponents, MOST_HALVINGS)
    numbers = np.rint(matrix / 2.0 ** (top - halvings)).astype(np.int8)
    return Whole(numbers, float(2.0**top), halvings.astype(np.uint8))


def rounded(policy: ExportedPolicy) -> ExportedPolicy:
    """The policy with all weight matrices of its low level rounded; what there is one of per neuron stays as it is.

    The high level stays as it is, too: UR5Reacher's success falls to .66 where it is rounded (docs/deploy.md).
    """
    low = policy.low
    if isinstance(low, Circuit):
        return replace(policy, low=_circuit(low), weights="int8")
    return replace(policy, low=_dissipative(low) if isinstance(low, Dissipative) else _mlp(low), weights="int8")


def _mlp(mlp: MLP) -> MLP:
    return replace(mlp, weights=tuple(whole(w).values for w in mlp.weights))


def _circuit(c: Circuit) -> Circuit:
    n, s = c.n_neurons, len(c.sensory_gain)
    sensory = _synapses(c.from_inputs[:s], n, c.lean)
    return replace(
        c,
        current_weight=whole(c.current_weight).values,
        from_inputs=np.concatenate([sensory, c.from_inputs[s:]]),
        recurrent=_synapses(c.recurrent, n, c.lean),
        readout=whole(c.readout).values,
    )


def _synapses(synapses: FloatArray, n: int, lean: bool) -> NDArray[np.float32]:
    """Rounded ``[conductance * reversal potential, conductance]``; a synapse without conductance has no current."""
    weighted = whole(synapses[:, :n]).values
    total = np.abs(weighted) if lean else whole(synapses[:, n:]).values
    return np.concatenate([np.where(total > 0, weighted, 0), total], axis=1).astype(np.float32)


def _dissipative(c: Dissipative) -> Dissipative:
    return replace(
        c,
        input_weight=whole(c.input_weight).values,
        recurrent=whole(c.recurrent).values,
        readout=whole(c.readout).values,
    )
