"""Pearson correlation of units with task features; the episode is the unit of evidence, not the step."""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from sb3_tbc.arrays import FloatArray
from sb3_tbc.stats import holm

N_SHIFTS, SHIFTS_PER_TEST, N_RESAMPLES = 5000, 30, 1000
"""At least so many shifts, and so many for each pair of unit and feature: with fewer than twenty for each pair no
correlation of a large circuit could be significant after Holm's correction."""


class Correlation(NamedTuple):
    """N units and F features; a unit or feature that never moves has r = 0 and p = 1."""

    r: FloatArray  # (N, F)
    low: FloatArray  # (N, F), bounds of the 95 % interval, episodes resampled
    high: FloatArray
    p: FloatArray  # (N, F), share of circular shifts that correlate at least as much
    p_holm: FloatArray  # (N, F), corrected for all N x F tests
    control: FloatArray  # (N, F), mean |r| of the circular shifts

    @property
    def mean(self) -> float:
        """Mean |r| over units and features, the figure that the paper prints."""
        return float(np.abs(self.r).mean())

    @property
    def control_mean(self) -> float:
        """The same of the circular shifts: what slow changes alone give."""
        return float(self.control.mean())

    @property
    def significant(self) -> float:
        """Share of the N x F correlations with a corrected p below .05."""
        return float((self.p_holm < 0.05).mean())


def correlate(
    activations: Sequence[FloatArray], features: Sequence[FloatArray], seed: int = 0, n_shifts: int | None = None
) -> Correlation:
    """Correlate units with features within episodes.

    Each episode's mean is taken out first, then the episodes' sums are added up. Steps of one episode depend on each
    other, so intervals resample whole episodes, and p-values compare with activations that are shifted in a circle
    against the features of their own episode by a random time: that keeps how slowly each of them changes.

    :param activations: per episode ``(T, N)``
    :param features: per episode ``(T, F)``, of the same lengths
    :param seed: of shifts and resamples
    :param n_shifts: random shifts; None: 5000, or 30 for each pair of unit and feature if that is more
    :raises ValueError: if there is no episode
    """
    if not activations:
        raise ValueError("need at least one episode to correlate")
    rng = np.random.default_rng(seed)
    units = [a.astype(np.float64) - a.mean(axis=0) for a in activations]
    things = [f.astype(np.float64) - f.mean(axis=0) for f in features]
    shifted = [_all_shifts(a, f) for a, f in zip(units, things, strict=True)]  # (T, N, F) each
    joint = np.stack([s[0] for s in shifted])  # (episodes, N, F)
    power = np.stack([(a**2).sum(axis=0) for a in units]), np.stack([(f**2).sum(axis=0) for f in things])
    r = _ratio(joint.sum(axis=0), power[0].sum(axis=0), power[1].sum(axis=0))
    low, high = _interval(joint, *power, rng)
    if n_shifts is None:
        n_shifts = max(N_SHIFTS, SHIFTS_PER_TEST * r.size)
    total = np.zeros((n_shifts, *r.shape))
    for one in shifted:
        total += one[rng.integers(0, len(one), n_shifts)]
    null = np.abs(_ratio(total, power[0].sum(axis=0), power[1].sum(axis=0)))
    p = (1 + (null >= np.abs(r) - 1e-12).sum(axis=0)) / (1 + n_shifts)
    corrected = np.array(holm(p.ravel().tolist())).reshape(p.shape)
    return Correlation(r, low, high, p, corrected, null.mean(axis=0))


def _all_shifts(units: FloatArray, things: FloatArray) -> NDArray[np.float64]:
    """Sums of products for every circular shift, ``(T, N, F)``; row 0 is the true one."""
    spectrum = np.fft.rfft(units, axis=0)[:, :, None].conj() * np.fft.rfft(things, axis=0)[:, None, :]
    return np.fft.irfft(spectrum, n=len(units), axis=0)


def _ratio(joint: FloatArray, units: FloatArray, things: FloatArray) -> FloatArray:
    scale = np.sqrt(units[..., :, None] * things[..., None, :])
    return np.divide(joint, scale, out=np.zeros(np.broadcast(joint, scale).shape), where=scale > 1e-12)


def _interval(
    joint: FloatArray, units: FloatArray, things: FloatArray, rng: np.random.Generator
) -> tuple[FloatArray, FloatArray]:
    n = len(joint)
    weights = rng.multinomial(n, np.full(n, 1.0 / n), size=N_RESAMPLES).astype(np.float64)
    drawn = _ratio(np.tensordot(weights, joint, 1), weights @ units, weights @ things)
    low, high = np.percentile(drawn, [2.5, 97.5], axis=0)
    return low, high
