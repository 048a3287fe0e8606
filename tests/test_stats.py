"""Statistics against SciPy, hand-worked cases and simulation."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy import stats as scipy_stats

from sb3_tbc import stats


def test_wilson_against_its_formula() -> None:
    successes, trials, z = 87, 100, scipy_stats.norm.ppf(0.975)
    rate = successes / trials
    centre = (rate + z**2 / (2 * trials)) / (1 + z**2 / trials)
    half = z * np.sqrt(rate * (1 - rate) / trials + z**2 / (4 * trials**2)) / (1 + z**2 / trials)
    assert stats.wilson_interval(successes, trials) == pytest.approx((centre - half, centre + half))
    assert stats.wilson_interval(10, 10)[0] < 1.0
    assert stats.wilson_interval(10, 10)[1] == pytest.approx(1.0)
    with pytest.raises(ValueError, match="11 of 10"):
        stats.wilson_interval(11, 10)


def test_bootstrap_mean_close_to_scipy_and_repeatable() -> None:
    values = np.array([0.81, 0.9, 0.97, 1.0, 0.88, 0.93, 0.95, 0.9, 0.99, 0.85])
    ours = stats.bootstrap_mean(values)
    theirs = scipy_stats.bootstrap((values,), np.mean, method="percentile", n_resamples=10_000, rng=1)
    assert ours.mean == pytest.approx(values.mean())
    assert (ours.low, ours.high) == pytest.approx(theirs.confidence_interval, abs=0.003)
    assert stats.bootstrap_mean(values) == ours
    assert stats.bootstrap_mean([0.5]) == (0.5, 0.5, 0.5)
    with pytest.raises(ValueError, match="one number per seed"):
        stats.bootstrap_mean([])


def test_bootstrap_interval_covers_the_mean() -> None:
    rng = np.random.default_rng(0)
    hits = 0
    for _ in range(200):
        interval = stats.bootstrap_mean(rng.normal(size=20), n_resamples=500)
        hits += interval.low <= 0.0 <= interval.high
    assert 0.86 <= hits / 200 <= 0.99  # the percentile bootstrap is a little narrow with 20 values


def test_band_has_the_width_of_its_points() -> None:
    curves = np.random.default_rng(1).random((5, 3))
    low, high = stats.bootstrap_band(curves)
    assert low.shape == high.shape == (3,)
    assert np.all(low < curves.mean(axis=0))
    assert np.all(curves.mean(axis=0) < high)


def test_holm_hand_worked() -> None:
    assert stats.holm([0.01, 0.04, 0.03]) == pytest.approx([0.03, 0.06, 0.06])
    assert stats.holm([0.9, 0.8]) == pytest.approx([1.0, 1.0])
    assert stats.holm([]) == []


@settings(max_examples=30, deadline=None)
@given(st.lists(st.floats(0, 1), min_size=1, max_size=8))
def test_holm_never_lowers_a_p_value_and_keeps_the_order(p_values: list[float]) -> None:
    adjusted = np.array(stats.holm(p_values))
    assert np.all(adjusted >= np.array(p_values) - 1e-12)
    assert np.all(np.diff(adjusted[np.argsort(p_values)]) >= 0)


@settings(max_examples=30, deadline=None)
@given(st.lists(st.integers(0, 5), min_size=1, max_size=6), st.lists(st.integers(0, 5), min_size=1, max_size=6))
def test_cliffs_delta_counts_pairs(first: list[int], second: list[int]) -> None:
    pairs = np.sign(np.subtract.outer(first, second))
    assert stats.cliffs_delta(first, second) == pytest.approx(pairs.mean())


def test_welch_matches_scipy_and_survives_constant_samples() -> None:
    a, b = [0.9, 0.95, 1.0], [0.7, 0.8, 0.75, 0.72]
    assert stats.welch_test(a, b) == pytest.approx(scipy_stats.ttest_ind(a, b, equal_var=False).pvalue)
    assert stats.welch_test([1.0, 1.0], [1.0, 1.0]) is None
    assert stats.welch_test([1.0, 1.0], [0.9, 0.9]) is None  # no variance, no test: not "certainly different"
    assert stats.welch_test([1.0, 1.0], [0.9, 0.8]) is not None
    with pytest.raises(ValueError, match="two seeds a side"):
        stats.welch_test([1.0], [0.5, 0.6])


def test_compare_marks_and_corrects() -> None:
    ours = {"A": [0.99, 0.98, 0.97, 0.98], "B": [0.5, 0.7, 0.6, 0.4], "C": [0.5], "D": [1.0] * 3, "E": [0.1, 0.2]}
    theirs = {"A": [0.5, 0.52, 0.48, 0.5], "B": [0.5, 0.6, 0.55, 0.5], "C": [0.4, 0.5], "D": [1.0] * 5, "E": [0.3] * 5}
    result = stats.compare(ours, theirs)
    assert set(result) == set(ours)
    assert result["A"].mark == "**"
    assert result["A"].cliffs_delta == 1.0
    assert result["A"].improvement == 1.0
    assert result["B"].mark == ""
    assert result["A"].p_value is not None
    assert result["A"].p_holm == pytest.approx(2 * result["A"].p_value)  # two tests; C, D and E do not count
    assert result["A"].difference == pytest.approx(0.48)
    assert [(result[k].p_value, result[k].p_holm, result[k].mark) for k in "CDE"] == [(None, None, "")] * 3
    assert [result[k].note for k in "ABCDE"] == ["", "", *[stats.TOO_FEW_SEEDS], stats.NO_VARIANCE, stats.TOO_FEW_SEEDS]


def test_clopper_pearson_against_the_beta_distribution() -> None:
    low, high = stats.clopper_pearson(87, 100)
    assert low == pytest.approx(scipy_stats.beta.ppf(0.025, 87, 14))
    assert high == pytest.approx(scipy_stats.beta.ppf(0.975, 88, 13))
    assert stats.clopper_pearson(10, 10)[0] == pytest.approx(0.025 ** (1 / 10))
    with pytest.raises(ValueError, match="11 of 10"):
        stats.clopper_pearson(11, 10)


def test_success_intervals_never_have_width_zero() -> None:
    all_succeed = stats.success_interval([1.0] * 5, [100] * 5)
    assert all_succeed == (1.0, pytest.approx(0.025 ** (1 / 500)), 1.0)
    assert stats.success_interval([0.9], [100])[1:] == pytest.approx(stats.clopper_pearson(90, 100))
    with pytest.raises(ValueError, match="one number of episodes"):
        stats.success_interval([0.9, 0.8], [100])


def test_the_seed_is_the_unit_not_the_episode() -> None:
    """Half of the seeds never learn: 400 episodes say .5 within .05, four seeds say next to nothing."""
    rates, episodes = [0.0, 0.0, 1.0, 1.0], [100] * 4
    interval = stats.success_interval(rates, episodes)
    assert interval[1:] == stats.bootstrap_mean(rates)[1:] == (0.0, 1.0)
    assert np.diff(stats.clopper_pearson(200, 400)) < 0.11


def test_success_intervals_cover_the_truth() -> None:
    """Seeds with a true rate of their own around .8: the mean of all seeds is covered nearly as often as promised."""
    rng = np.random.default_rng(3)
    hits = 0
    for _ in range(200):
        rates = rng.binomial(100, rng.beta(16, 4, size=10)) / 100
        interval = stats.success_interval(rates, [100] * 10, n_resamples=500)
        hits += interval.low <= 0.8 <= interval.high
    assert 0.85 <= hits / 200 <= 0.99


def test_paired_block_bootstrap_against_scipy() -> None:
    rng = np.random.default_rng(0)
    first, second = rng.random(60), rng.random(60)
    ours = stats.paired_block_bootstrap([first], [second])
    theirs = scipy_stats.bootstrap(
        (first, second), lambda a, b: np.mean(a - b), paired=True, vectorized=False, method="percentile", rng=1
    )
    assert ours.mean == pytest.approx(np.mean(first - second))
    assert (ours.low, ours.high) == pytest.approx(theirs.confidence_interval, abs=0.01)
    assert stats.paired_block_bootstrap([first], [second]) == ours
    with pytest.raises(ValueError, match="as many episodes"):
        stats.paired_block_bootstrap([first], [second[:10]])
    with pytest.raises(ValueError, match="the same seeds"):
        stats.paired_block_bootstrap([first, first], [second])


def test_pairing_and_blocks_matter() -> None:
    rng = np.random.default_rng(1)
    base = rng.random(100)
    paired = stats.paired_block_bootstrap([base + 0.1], [base])
    assert (paired.low, paired.high) == pytest.approx((0.1, 0.1))  # the same episodes on both sides: no noise is left
    slow = np.repeat(rng.random(10), 10)  # episodes that resemble their neighbours
    single = stats.paired_block_bootstrap([slow], [np.zeros(100)])
    blocks = stats.paired_block_bootstrap([slow], [np.zeros(100)], block=10)
    assert blocks.high - blocks.low > 2 * (single.high - single.low)


def test_differences_combine_both_intervals() -> None:
    first, second = stats.Interval(0.9, 0.8, 0.95), stats.Interval(0.6, 0.5, 0.7)
    interval = stats.difference(first, second)
    assert interval == pytest.approx((0.3, 0.3 - np.hypot(0.1, 0.1), 0.3 + np.hypot(0.05, 0.1)))
    equal = stats.success_interval([1.0, 1.0], [100, 100])
    assert stats.difference(equal, equal).low < 0 < stats.difference(equal, equal).high
    rng, hits = np.random.default_rng(0), 0
    for _ in range(300):
        sides = [stats.success_interval([rng.binomial(100, p) / 100], [100]) for p in (0.9, 0.7)]
        interval = stats.difference(*sides)
        hits += interval.low <= 0.2 <= interval.high
    assert hits / 300 >= 0.93


def test_interquartile_mean_and_spread() -> None:
    tasks = [[0.0, 0.5, 1.0, 0.7], [0.2, 0.4, 0.6, 0.8]]
    iqm = stats.interquartile_mean(tasks)
    assert iqm.mean == pytest.approx(scipy_stats.trim_mean(np.concatenate(tasks), 0.25))
    assert iqm.low < iqm.mean < iqm.high
    assert stats.interquartile_mean([[0.0, 1.0, 1.0, 1.0, 1.0, 1.0, 1.0, 1.0]]).mean == 1.0
    assert stats.interquartile_mean([[0.0, 1.0, 4.0]]).mean == pytest.approx(1.0 * 2 / 3 + 4.0 / 6)
    assert stats.spread(np.arange(11.0)) == (0.0, 1.0, 9.0, 10.0)
    with pytest.raises(ValueError, match="at least one seed"):
        stats.interquartile_mean([[]])


@settings(max_examples=30, deadline=None)
@given(st.lists(st.integers(0, 3), min_size=1, max_size=6), st.lists(st.integers(0, 3), min_size=1, max_size=6))
def test_probability_of_improvement_counts_pairs(first: list[int], second: list[int]) -> None:
    wins = [1.0 if a > b else 0.5 if a == b else 0.0 for a in first for b in second]
    assert stats.probability_of_improvement(first, second) == pytest.approx(np.mean(wins))


def test_stability_and_steps_to() -> None:
    rates = [0.2, 0.9, 1.0, 0.6, 0.95]
    assert stats.stability(rates) == (0.75, 0.6)
    assert stats.stability([0.1, 0.2]) is None
    assert stats.steps_to([5, 10, 15, 20, 25], rates, 0.95) == 15
    assert stats.steps_to([5], [0.1], 0.9) is None


@pytest.mark.parametrize("interval", [stats.wilson_interval, stats.clopper_pearson])
def test_rates_that_cannot_be(interval: Callable[[int, int], tuple[float, float]]) -> None:
    for successes, trials in ((0, 0), (-1, 10), (1, 0)):
        with pytest.raises(ValueError, match=f"got {successes} of {trials}"):
            interval(successes, trials)
    low, high = interval(0, 10)
    assert low == pytest.approx(0.0)
    assert 0.2 < high < 0.4
    narrow = interval(5, 10, confidence=0.5)  # type: ignore[call-arg]
    assert interval(5, 10)[0] < narrow[0] < 0.5 < narrow[1] < interval(5, 10)[1]


def test_every_task_has_the_same_weight_in_the_interquartile_mean() -> None:
    few, many = stats.interquartile_mean([[1.0] * 2, [0.2] * 2]), stats.interquartile_mean([[1.0] * 10, [0.2]])
    assert few.mean == pytest.approx(0.6)
    assert many == pytest.approx(few)
    assert stats.interquartile_mean([[0.5], [0.1, 0.1], [0.9] * 7]).mean == pytest.approx(2 * (0.5 / 3 + 1.0 / 12))


def test_success_intervals_hold_their_mean() -> None:
    interval = stats.success_interval([0.5, 1.0], [20, 200])
    assert interval.mean == 0.75
    assert interval[1:] == pytest.approx(stats.clopper_pearson(165, 220))
    three = stats.success_interval([0.2, 0.5, 0.8], [100] * 3)
    assert three[1:] == stats.bootstrap_mean([0.2, 0.5, 0.8])[1:] == (pytest.approx(0.2), pytest.approx(0.8))


def test_confidence_and_resamples_are_obeyed() -> None:
    values = np.random.default_rng(2).random(12)
    wide, narrow = stats.bootstrap_mean(values), stats.bootstrap_mean(values, confidence=0.5)
    assert wide.low < narrow.low < values.mean() < narrow.high < wide.high
    half = 0.6745 * values.std() / np.sqrt(12)
    assert (narrow.low, narrow.high) == pytest.approx((values.mean() - half, values.mean() + half), abs=0.01)
    paired = stats.paired_block_bootstrap([values], [np.zeros(12)], confidence=0.5)
    assert (paired.low, paired.high) == pytest.approx((narrow.low, narrow.high), abs=0.01)
    assert len(np.unique(np.diff(stats.bootstrap_band(values[:, None], n_resamples=1)))) == 0  # one draw: no width
    low, high = stats.bootstrap_band(values[:, None], n_resamples=1)
    assert low == high
    assert stats.bootstrap_mean(values, seed=1) != wide
    median = stats.bootstrap_mean(values, confidence=0.0)
    assert median.low == median.high


def test_blocks_are_consecutive_and_wrap_around() -> None:
    values = np.array([0.0, 1.0, 10.0, 100.0, 1000.0])
    means = stats._block_means(values, 3, 4000, np.random.default_rng(0))
    blocks = [[values[(start + k) % 5] for k in range(3)] for start in range(5)]
    possible = {round(sum(first + second[:2]) / 5, 6) for first in blocks for second in blocks}
    assert {round(float(mean), 6) for mean in means} == possible
    seeds = stats.paired_block_bootstrap([[1.0, 1.0], [3.0, 3.0]], [[0.0, 0.0], [0.0, 0.0]])
    assert seeds == (2.0, 2.0, 2.0)


def test_the_interval_of_the_interquartile_mean_resamples_seeds_within_tasks() -> None:
    apart = [[0.0] * 4, [1.0] * 4]  # resampling over tasks would give an interval
    assert stats.interquartile_mean(apart) == (0.5, 0.5, 0.5)
    one = [np.linspace(0.0, 1.0, 40)]
    iqm = stats.interquartile_mean(one)
    simulated = [scipy_stats.trim_mean(np.random.default_rng(k).choice(one[0], size=40), 0.25) for k in range(2000)]
    assert (iqm.low, iqm.high) == pytest.approx(tuple(np.percentile(simulated, [2.5, 97.5])), abs=0.02)
    narrow = stats.interquartile_mean(one, confidence=0.5)
    assert iqm.low < narrow.low < narrow.high < iqm.high


def test_marks_and_what_only_one_method_has() -> None:
    ours = {"A": [0.8, 0.9, 1.0], "only ours": [1.0] * 3, "B": [0.1, 0.5, 0.9]}
    theirs = {"A": [0.55, 0.6, 0.65], "only theirs": [1.0] * 3, "B": [0.2, 0.5, 0.8]}
    result = stats.compare(ours, theirs)
    assert set(result) == {"A", "B"}
    alone = stats.compare({"A": ours["A"]}, theirs)["A"]
    assert alone.p_value is not None
    assert 0.01 < alone.p_value < 0.05
    assert alone.mark == "*"
    assert result["A"].p_holm == pytest.approx(2 * alone.p_value)
    assert result["A"].mark == ("*" if 2 * alone.p_value < 0.05 else "")
    assert alone.note == ""


def test_values_on_the_threshold_count() -> None:
    assert stats.stability([0.9, 0.5], 0.9) == (0.5, 0.5)
    assert stats.stability([0.5, 0.7], 0.7) == (1.0, 0.7)
    assert stats.steps_to([5, 10], [0.89, 0.9], 0.9) == 10
    with pytest.raises(ValueError, match="zip"):
        stats.steps_to([5], [0.1, 0.2], 0.9)
    with pytest.raises(ValueError, match="at least one value"):
        stats.spread([])
    with pytest.raises(ValueError, match="got 0 and 1"):
        stats.cliffs_delta([], [1.0])
