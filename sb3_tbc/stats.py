"""Statistics over seeds, as table 2 of the paper asks: the seed is the unit, not the episode. NumPy and SciPy only."""

from __future__ import annotations

import warnings
from collections.abc import Mapping, Sequence
from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy import stats


class Interval(NamedTuple):
    """A point estimate and its confidence bounds."""

    mean: float
    low: float
    high: float


class Comparison(NamedTuple):
    """One environment's comparison of two methods.

    ``difference`` is first minus second; ``p_value`` Welch's, two-sided; ``p_holm`` corrected over environments;
    ``cliffs_delta`` in [-1, 1]; ``mark`` is ``**``, ``*`` or empty, from the corrected value.
    """

    difference: float
    p_value: float
    p_holm: float
    cliffs_delta: float
    mark: str


def wilson_interval(successes: int, trials: int, confidence: float = 0.95) -> tuple[float, float]:
    """Wilson's score interval of a success rate; honest at 0 and 1 and with few episodes.

    :param successes: episodes that succeeded
    :param trials: episodes
    :raises ValueError: unless ``0 <= successes <= trials`` and ``trials > 0``
    """
    if not 0 <= successes <= trials or trials <= 0:
        raise ValueError(f"need 0 <= successes <= trials and trials > 0, got {successes} of {trials}")
    interval = stats.binomtest(int(successes), int(trials)).proportion_ci(confidence, method="wilson")
    return float(interval.low), float(interval.high)


def bootstrap_mean(
    values: ArrayLike, confidence: float = 0.95, n_resamples: int = 10_000, seed: int | None = 0
) -> Interval:
    """Mean over seeds with its percentile bootstrap interval.

    :param values: one number per seed, ``(n_seeds,)``; a single seed gives an interval of width zero
    :raises ValueError: if there are no values
    """
    sample = np.asarray(values, dtype=np.float64)
    if sample.ndim != 1 or sample.size == 0:
        raise ValueError(f"need one number per seed, got an array of shape {sample.shape}")
    low, high = bootstrap_band(sample[:, None], confidence, n_resamples, seed)
    return Interval(float(sample.mean()), float(low[0]), float(high[0]))


def bootstrap_band(
    curves: ArrayLike, confidence: float = 0.95, n_resamples: int = 10_000, seed: int | None = 0
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Percentile bootstrap bounds of the mean curve; whole curves are resampled, so the band keeps their correlation.

    :param curves: ``(n_seeds, n_points)``
    :return: lower and upper bounds, each ``(n_points,)``
    """
    data = np.asarray(curves, dtype=np.float64)
    if len(data) == 1:
        return data[0].copy(), data[0].copy()
    rng = np.random.default_rng(seed)
    # Resampling n curves with replacement = weighting them with multinomial counts: one matrix product, no copies.
    weights = rng.multinomial(len(data), np.full(len(data), 1.0 / len(data)), size=n_resamples) / len(data)
    tail = 50.0 * (1.0 - confidence)
    low, high = np.percentile(weights @ data, [tail, 100.0 - tail], axis=0)
    return low, high


def welch_test(first: ArrayLike, second: ArrayLike) -> float:
    """Two-sided Welch t-test on seed means; 1 when both samples are constant and equal, 0 when constant and different.

    :raises ValueError: with fewer than two seeds on a side
    """
    a, b = np.asarray(first, dtype=np.float64), np.asarray(second, dtype=np.float64)
    if len(a) < 2 or len(b) < 2:
        raise ValueError(f"Welch's test needs at least two seeds a side, got {len(a)} and {len(b)}")
    if np.ptp(a) == 0 and np.ptp(b) == 0:
        return float(a[0] == b[0])
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", RuntimeWarning)  # one sample may well be constant: five seeds that all succeed
        return float(stats.ttest_ind(a, b, equal_var=False).pvalue)


def holm(p_values: Sequence[float]) -> list[float]:
    """Holm-Bonferroni adjusted p-values, in the order given."""
    count = len(p_values)
    order = np.argsort(p_values)
    steps = np.asarray(p_values, dtype=np.float64)[order] * np.arange(count, 0, -1)
    adjusted = np.empty(count)
    adjusted[order] = np.minimum(np.maximum.accumulate(steps), 1.0)
    return [float(p) for p in adjusted]


def cliffs_delta(first: ArrayLike, second: ArrayLike) -> float:
    """Cliff's delta, P(first > second) - P(first < second), in [-1, 1]; from SciPy's Mann-Whitney U.

    :raises ValueError: if a side is empty
    """
    a, b = np.asarray(first, dtype=np.float64), np.asarray(second, dtype=np.float64)
    if a.size == 0 or b.size == 0:
        raise ValueError(f"Cliff's delta needs values on both sides, got {a.size} and {b.size}")
    u_statistic = stats.mannwhitneyu(a, b, method="asymptotic").statistic
    return float(2.0 * u_statistic / (len(a) * len(b)) - 1.0)


def compare(first: Mapping[str, ArrayLike], second: Mapping[str, ArrayLike]) -> dict[str, Comparison]:
    """Compare two methods on every environment both have at least two seeds of, corrected over environments (Holm).

    :param first: environment -> one number per seed
    :param second: the same for the method compared with
    """
    pairs = {k: (np.asarray(first[k], float), np.asarray(second[k], float)) for k in first if k in second}
    pairs = {k: pair for k, pair in pairs.items() if min(len(pair[0]), len(pair[1])) >= 2}
    p_values = [welch_test(a, b) for a, b in pairs.values()]
    result = {}
    for (name, (a, b)), p_value, p_holm in zip(pairs.items(), p_values, holm(p_values), strict=True):
        mark = "**" if p_holm < 0.01 else "*" if p_holm < 0.05 else ""
        result[name] = Comparison(float(a.mean() - b.mean()), p_value, p_holm, cliffs_delta(a, b), mark)
    return result


def stability(success_rates: Sequence[float], threshold: float = 0.9) -> tuple[float, float] | None:
    """Share of evaluations at or above ``threshold`` from the first such one on, and the worst of them.

    :return: ``None`` if the threshold was never met
    """
    rates = np.asarray(success_rates, dtype=np.float64)
    above = np.flatnonzero(rates >= threshold)
    if above.size == 0:
        return None
    after = rates[above[0] :]
    return float((after >= threshold).mean()), float(after.min())


def steps_to(timesteps: Sequence[float], success_rates: Sequence[float], threshold: float) -> int | None:
    """Environment steps at the first evaluation at or above ``threshold``, or ``None``."""
    for steps, rate in zip(timesteps, success_rates, strict=True):
        if rate >= threshold:
            return int(steps)
    return None
