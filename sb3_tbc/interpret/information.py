"""Mutual information in bits between a unit's activation and the phase of the window it acts in."""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from sb3_tbc.arrays import FloatArray

ACTIVATION_BINS, PHASE_BINS, N_SHUFFLES = 8, 4, 50
SHORTEST_WINDOW = PHASE_BINS
"""Fewest steps of a window that counts; shorter ones do not have all phases."""


class PhaseInformation(NamedTuple):
    """Bits per unit, ``(N,)``; below zero is estimation error around zero."""

    bits: FloatArray
    control: FloatArray  # the same with phases shifted in a circle within each window, mean of many
    n_windows: int

    @property
    def mean(self) -> float:
        """Mean over units."""
        return float(self.bits.mean())

    @property
    def percentile_90(self) -> float:
        """90th percentile over units."""
        return float(np.percentile(self.bits, 90))


def mutual_information(x: NDArray[np.integer], y: NDArray[np.integer]) -> float:
    """Mutual information of two discrete variables in bits, without the bias of counting (Panzeri and Treves 1996).

    The plain estimate is too large by ``(R_xy - R_x - R_y + 1) / (2 n ln 2)``, R being the numbers of values (pairs)
    that occur, to first order in 1/n.

    :param x: values 0, 1, ..., ``(n,)``
    :param y: values 0, 1, ..., ``(n,)``
    """
    joint = np.zeros((int(x.max()) + 1, int(y.max()) + 1))
    np.add.at(joint, (x, y), 1.0)
    occupied = np.count_nonzero(joint) - np.count_nonzero(joint.sum(1)) - np.count_nonzero(joint.sum(0)) + 1
    share = joint / joint.sum()
    expected = share.sum(1, keepdims=True) * share.sum(0, keepdims=True)
    there = share > 0
    plain = float((share[there] * np.log2(share[there] / expected[there])).sum())
    return plain - float(occupied) / (2.0 * len(x) * float(np.log(2.0)))


def into_quantiles(values: FloatArray, bins: int = ACTIVATION_BINS) -> NDArray[np.int64]:
    """Bins of about equally many values; equal values share a bin, so a unit that never moves has a single one.

    A unit that rests at its largest value for most of the time is told from one that never moves, as one that rests at
    its smallest is.
    """
    edges, top = np.quantile(values, np.linspace(0, 1, bins + 1)[1:-1]), values.max()
    # Bins hold their upper edge: one at the largest value parts nothing, one at the value next to it parts the largest.
    below = values[values < top]
    if below.size:
        edges[edges == top] = below.max()
    return np.searchsorted(np.unique(edges), values, side="left").astype(np.int64)


def phase_information(
    windows: Sequence[FloatArray], seed: int = 0, n_shuffles: int = N_SHUFFLES
) -> PhaseInformation | None:
    """Information of every unit about how far a window has run.

    :param windows: activations in each window, ``(steps, N)``; those below :data:`SHORTEST_WINDOW` steps are left out
    :param seed: of the control
    :param n_shuffles: shuffles of the control
    :return: None if no window is long enough
    """
    kept = [w for w in windows if len(w) >= SHORTEST_WINDOW]
    if not kept:
        return None
    rng = np.random.default_rng(seed)
    phases = [np.arange(len(w)) * PHASE_BINS // len(w) for w in kept]
    phase = np.concatenate(phases)
    binned = np.stack([into_quantiles(column) for column in np.concatenate(kept).T])
    shuffled = [np.concatenate([np.roll(p, rng.integers(len(p))) for p in phases]) for _ in range(n_shuffles)]
    bits = np.array([mutual_information(unit, phase) for unit in binned])
    control = np.array([np.mean([mutual_information(unit, other) for other in shuffled]) for unit in binned])
    return PhaseInformation(bits, control, len(kept))
