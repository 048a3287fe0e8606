"""Statistics against SciPy, hand-worked cases and simulation."""

from __future__ import annotations

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
    assert stats.welch_test([1.0, 1.0], [1.0, 1.0]) == 1.0
    assert stats.welch_test([1.0, 1.0], [0.9, 0.9]) == 0.0
    with pytest.raises(ValueError, match="two seeds a side"):
        stats.welch_test([1.0], [0.5, 0.6])


def test_compare_marks_and_corrects() -> None:
    ours = {"A": [0.99, 0.98, 0.97, 0.98], "B": [0.5, 0.7, 0.6, 0.4], "C": [0.5]}
    theirs = {"A": [0.5, 0.52, 0.48, 0.5], "B": [0.5, 0.6, 0.55, 0.5], "C": [0.4, 0.5]}
    result = stats.compare(ours, theirs)
    assert set(result) == {"A", "B"}
    assert result["A"].mark == "**"
    assert result["A"].cliffs_delta == 1.0
    assert result["B"].mark == ""
    assert result["A"].p_holm == pytest.approx(2 * result["A"].p_value)
    assert result["A"].difference == pytest.approx(0.48)


def test_stability_and_steps_to() -> None:
    rates = [0.2, 0.9, 1.0, 0.6, 0.95]
    assert stats.stability(rates) == (0.75, 0.6)
    assert stats.stability([0.1, 0.2]) is None
    assert stats.steps_to([5, 10, 15, 20, 25], rates, 0.95) == 15
    assert stats.steps_to([5], [0.1], 0.9) is None
