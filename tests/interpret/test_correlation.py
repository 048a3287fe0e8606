"""Correlation on data whose answer is known: a planted unit is found, slow noise is not."""

from __future__ import annotations

import numpy as np
import pytest

from sb3_tbc.interpret.correlation import correlate


def slow(rng: np.random.Generator, steps: int, columns: int) -> np.ndarray:
    """An autoregressive series: neighbours are alike, as the steps of an episode are."""
    noise = rng.normal(size=(steps, columns))
    for t in range(1, steps):
        noise[t] += 0.95 * noise[t - 1]
    return noise


def test_a_planted_unit_is_found_with_its_size() -> None:
    rng = np.random.default_rng(0)
    features = [slow(rng, 150, 2) for _ in range(20)]
    units = []
    for f in features:
        f /= f.std(axis=0)
        u = slow(rng, 150, 3)
        u /= u.std(axis=0)
        u[:, 1] = 0.6 * f[:, 0] + 0.8 * u[:, 1]  # r = 0.6 by construction
        units.append(u)
    found = correlate(units, features, n_shifts=3000)
    assert found.r[1, 0] == pytest.approx(0.6, abs=0.08)
    assert found.low[1, 0] < 0.6 < found.high[1, 0]
    assert found.p_holm[1, 0] < 0.01
    others = np.ones((3, 2), dtype=bool)
    others[1, 0] = False
    assert (found.p_holm[others] > 0.05).all()
    assert found.control_mean < 0.15


def test_a_large_circuit_can_have_a_finding() -> None:
    """The smallest p is one over the number of shifts, times the number of tests after the correction."""
    rng = np.random.default_rng(3)
    features = [slow(rng, 60, 1) for _ in range(8)]
    units = [np.concatenate([slow(rng, 60, 399), f], axis=1) for f in features]  # the last unit is the feature
    found = correlate(units, features)
    assert found.p_holm[-1, 0] < 0.05
    assert (found.p_holm[:-1] < 0.05).mean() < 0.02


def test_it_equals_pearson_for_one_episode() -> None:
    rng = np.random.default_rng(1)
    units, features = rng.normal(size=(80, 2)), rng.normal(size=(80, 3))
    expected = np.corrcoef(units.T, features.T)[:2, 2:]
    np.testing.assert_allclose(correlate([units], [features], n_shifts=10).r, expected, atol=1e-12)


def test_slow_noise_is_not_called_a_finding_too_often() -> None:
    """A test that took steps as independent would call most of these significant."""
    rng = np.random.default_rng(2)
    uncorrected = []
    for _ in range(40):
        units, features = ([slow(rng, 200, 1) for _ in range(3)] for _ in range(2))
        uncorrected.append(correlate(units, features, n_shifts=400).p[0, 0])
    assert np.mean(np.array(uncorrected) < 0.05) < 0.15


def test_a_unit_that_never_moves_has_no_correlation() -> None:
    found = correlate([np.ones((50, 1))], [np.arange(50.0)[:, None]], n_shifts=20)
    assert found.r[0, 0] == 0.0
    assert found.p[0, 0] == 1.0


def test_no_episode_is_refused() -> None:
    with pytest.raises(ValueError, match="at least one episode"):
        correlate([], [])
