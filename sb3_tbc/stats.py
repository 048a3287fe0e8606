"""Statistics over seeds, as table 2 of the paper asks: the seed is the unit, not the episode. NumPy and SciPy only."""

from __future__ import annotations

import warnings
from collections.abc import Mapping, Sequence
from typing import NamedTuple, TypeVar

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy import stats

Key = TypeVar("Key")


class Interval(NamedTuple):
    """A point estimate and its confidence bounds."""

    mean: float
    low: float
    high: float


class Comparison(NamedTuple):
    """One environment's comparison of two methods, first minus second.

    ``p_value`` is Welch's, two-sided, ``p_holm`` the same corrected over all tests of the call; both are ``None`` where
    there is no test, and ``note`` says why. ``cliffs_delta`` lies in [-1, 1]; ``improvement`` is the probability that a
    run of the first beats one of the second, ties counted half; ``mark`` is ``**``, ``*`` or empty, from the corrected
    value.
    """

    difference: float
    p_value: float | None
    p_holm: float | None
    cliffs_delta: float
    improvement: float
    mark: str
    note: str


class Spread(NamedTuple):
    """How far seeds lie apart: extremes and the 10th and 90th percentile."""

    minimum: float
    percentile_10: float
    percentile_90: float
    maximum: float


FEWEST_SEEDS = 3
"""Fewest seeds for a test. With fewer, the paper bootstraps episodes (section 5.1), which says nothing about other
seeds; so no test is made.
"""
NO_VARIANCE = "no variance"
TOO_FEW_SEEDS = "fewer than three seeds"


def wilson_interval(successes: int, trials: int, confidence: float = 0.95) -> tuple[float, float]:
    """Wilson's score interval of a success rate; valid near 0 and 1 and with few episodes, too.

    :param successes: episodes that succeeded
    :param trials: episodes
    :raises ValueError: unless ``0 <= successes <= trials`` and ``trials > 0``
    """
    return _proportion(successes, trials, confidence, "wilson")


def clopper_pearson(successes: int, trials: int, confidence: float = 0.95) -> tuple[float, float]:
    """Exact interval of a success rate: it holds the true rate at least as often as its confidence says.

    :param successes: episodes that succeeded
    :param trials: episodes
    :raises ValueError: unless ``0 <= successes <= trials`` and ``trials > 0``
    """
    return _proportion(successes, trials, confidence, "exact")


def _proportion(successes: int, trials: int, confidence: float, method: str) -> tuple[float, float]:
    if not 0 <= successes <= trials or trials <= 0:
        raise ValueError(f"need 0 <= successes <= trials and trials > 0, got {successes} of {trials}")
    interval = stats.binomtest(int(successes), int(trials)).proportion_ci(confidence, method=method)
    return float(interval.low), float(interval.high)


def success_interval(
    rates: ArrayLike, episodes: Sequence[int], confidence: float = 0.95, n_resamples: int = 10_000
) -> Interval:
    """Mean success rate over seeds and its interval, which never has width zero.

    From three seeds on, the seed is the unit: the interval is the percentile bootstrap over seed means (paper, section
    5.1). Seeds that all end at 1.00 would give it width zero, although an episode may still fail. So either end is
    moved outwards, where needed, to that of the exact interval over all episodes (Clopper-Pearson), of which the mean
    over seeds succeeded. With one or two seeds the exact interval stands alone: it holds for these agents, not for
    other seeds.

    :param rates: final success rate of each seed, ``(n_seeds,)``
    :param episodes: episodes behind each of them
    :raises ValueError: if there is no seed, or not one number of episodes for each
    """
    sample = np.asarray(rates, dtype=np.float64)
    if sample.ndim != 1 or len(sample) != len(episodes):
        raise ValueError(f"need one rate and one number of episodes per seed, got {sample.shape} and {len(episodes)}")
    interval = bootstrap_mean(sample, confidence, n_resamples)
    trials = int(sum(episodes))
    exact = clopper_pearson(round(interval.mean * trials), trials, confidence)
    if len(sample) < FEWEST_SEEDS:
        return Interval(interval.mean, *exact)
    return Interval(interval.mean, min(interval.low, exact[0]), max(interval.high, exact[1]))


def paired_block_bootstrap(
    first: Sequence[ArrayLike],
    second: Sequence[ArrayLike],
    block: int = 1,
    confidence: float = 0.95,
    n_resamples: int = 10_000,
    seed: int = 0,
) -> Interval:
    """Difference of two methods' means from episodes, for fewer than three seeds (paper, section 5.1).

    Within each seed, blocks of consecutive episodes are drawn with replacement (they wrap around at the end), at the
    same places for both methods, because both were evaluated on the same episodes; seeds are then averaged.

    :param first: per seed one value per episode, each ``(n_episodes,)``
    :param second: the same for the other method, with as many episodes
    :param block: episodes in a block, the evaluation window; 1 where their order is not known
    :raises ValueError: if seeds or episodes do not pair
    """
    pairs = [(np.asarray(a, dtype=np.float64), np.asarray(b, dtype=np.float64)) for a, b in zip(first, second)]  # noqa: B905
    if len(first) != len(second) or not pairs or any(a.shape != b.shape or a.size == 0 for a, b in pairs):
        sizes = [[np.size(x) for x in side] for side in (first, second)]
        raise ValueError(
            f"the same seeds with as many episodes on both sides are needed, got {sizes[0]} and {sizes[1]}"
        )
    rng = np.random.default_rng(seed)
    draws = [_block_means(a - b, block, n_resamples, rng) for a, b in pairs]
    low, high = np.percentile(np.mean(draws, axis=0), [50 * (1 - confidence), 50 * (1 + confidence)])
    return Interval(float(np.mean([np.mean(a - b) for a, b in pairs])), float(low), float(high))


def _block_means(
    values: NDArray[np.float64], block: int, n_resamples: int, rng: np.random.Generator
) -> NDArray[np.float64]:
    """Means ``(n_resamples,)`` of resamples made of blocks of consecutive values."""
    count = -(-len(values) // block)
    starts = rng.integers(len(values), size=(n_resamples, count))
    places = (starts[:, :, None] + np.arange(block)) % len(values)
    return np.asarray(values[places.reshape(n_resamples, -1)[:, : len(values)]].mean(axis=1))


def bootstrap_mean(
    values: ArrayLike, confidence: float = 0.95, n_resamples: int = 10_000, seed: int | None = 0
) -> Interval:
    """Mean over seeds with its percentile bootstrap interval.

    :param values: one number per seed, ``(n_seeds,)``; equal numbers give an interval of width zero, see
        :func:`success_interval`
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


def welch_test(first: ArrayLike, second: ArrayLike) -> float | None:
    """Two-sided Welch t-test on seed means.

    :return: ``None`` when both samples are constant: without variance there is no test
    :raises ValueError: with fewer than two seeds on a side
    """
    a, b = np.asarray(first, dtype=np.float64), np.asarray(second, dtype=np.float64)
    if len(a) < 2 or len(b) < 2:
        raise ValueError(f"Welch's test needs at least two seeds a side, got {len(a)} and {len(b)}")
    if np.ptp(a) == 0 and np.ptp(b) == 0:
        return None
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


def probability_of_improvement(first: ArrayLike, second: ArrayLike) -> float:
    """P(first > second) + P(equal) / 2 over pairs of seeds.

    :raises ValueError: if a side is empty
    """
    return (cliffs_delta(first, second) + 1.0) / 2.0


def interquartile_mean(tasks: Sequence[ArrayLike], confidence: float = 0.95, n_resamples: int = 10_000) -> Interval:
    """Mean of the middle half of all runs, over tasks; its interval resamples seeds within each task.

    All tasks weigh the same, however many seeds they have.

    :param tasks: per task one number per seed
    :raises ValueError: if there is no task or one without a seed
    """
    samples = [np.asarray(task, dtype=np.float64) for task in tasks]
    if not samples or any(sample.size == 0 for sample in samples):
        raise ValueError(f"need tasks with at least one seed each, got {[sample.size for sample in samples]}")
    weights = np.concatenate([np.full(len(sample), 1.0 / (len(sample) * len(samples))) for sample in samples])
    rng = np.random.default_rng(0)
    draws = [sample[rng.integers(len(sample), size=(n_resamples, len(sample)))] for sample in samples]
    middle = _middle_half(np.concatenate(draws, axis=1), weights)
    low, high = np.percentile(middle, [50 * (1 - confidence), 50 * (1 + confidence)])
    return Interval(float(_middle_half(np.concatenate(samples), weights)), float(low), float(high))


def _middle_half(values: NDArray[np.float64], weights: NDArray[np.float64]) -> NDArray[np.float64]:
    """Weighted means of the middle half of values ``(..., n)``; weights ``(n,)`` add up to 1."""
    order = np.argsort(values, axis=-1)
    ends = np.cumsum(weights[order], axis=-1)
    within = np.clip(ends, 0.25, 0.75) - np.clip(ends - weights[order], 0.25, 0.75)
    return np.asarray(2.0 * (within * np.take_along_axis(values, order, axis=-1)).sum(axis=-1))


def spread(values: ArrayLike) -> Spread:
    """Extremes and inter-percentile range over seeds.

    :raises ValueError: if there are no values
    """
    sample = np.asarray(values, dtype=np.float64)
    if sample.size == 0:
        raise ValueError("need at least one value")
    low, high = np.percentile(sample, [10, 90])
    return Spread(float(sample.min()), float(low), float(high), float(sample.max()))


def difference(first: Interval, second: Interval) -> Interval:
    """Difference of two means and its interval, from the intervals of both (Newcombe's method of combining limits).

    The distance from the difference to its lower end is the root of the summed squares of two distances: from the
    first mean to its lower limit, and from the second mean to its upper limit; likewise for the upper end. So the width
    is zero only if both intervals have width zero.
    """
    mean = first.mean - second.mean
    low = mean - np.hypot(first.mean - first.low, second.high - second.mean)
    high = mean + np.hypot(first.high - first.mean, second.mean - second.low)
    return Interval(mean, float(low), float(high))


def compare(first: Mapping[Key, ArrayLike], second: Mapping[Key, ArrayLike]) -> dict[Key, Comparison]:
    """Compare two methods wherever both have runs; p-values are corrected over all tests that were made (Holm).

    There is no test with fewer than three seeds on a side, and none where no seed differs from another on either side:
    such comparisons do not count in the correction.

    :param first: environment (or whatever is compared) -> one number per seed
    :param second: the same for the method compared with
    """
    pairs = {k: (np.asarray(first[k], float), np.asarray(second[k], float)) for k in first if k in second}
    enough = {k: min(len(a), len(b)) >= FEWEST_SEEDS for k, (a, b) in pairs.items()}
    p_values = {k: welch_test(a, b) if enough[k] else None for k, (a, b) in pairs.items()}
    tested = {k: p for k, p in p_values.items() if p is not None}
    corrected = dict(zip(tested, holm(list(tested.values())), strict=True))
    result = {}
    for name, (a, b) in pairs.items():
        p_holm = corrected.get(name)
        mark = "" if p_holm is None else "**" if p_holm < 0.01 else "*" if p_holm < 0.05 else ""
        note = "" if name in tested else NO_VARIANCE if enough[name] else TOO_FEW_SEEDS
        effect = cliffs_delta(a, b), probability_of_improvement(a, b)
        result[name] = Comparison(float(a.mean() - b.mean()), p_values[name], p_holm, *effect, mark, note)
    return result


def stability(success_rates: Sequence[float], threshold: float = 0.9) -> tuple[float, float] | None:
    """Share of evaluations at or above ``threshold``, counted from the first such one, and the lowest rate from there.

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
