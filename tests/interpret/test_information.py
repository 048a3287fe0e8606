"""Mutual information on joint distributions whose bits are known."""

from __future__ import annotations

import numpy as np
import pytest

from sb3_tbc.interpret.information import into_quantiles, mutual_information, phase_information


def draw(joint: np.ndarray, n: int, seed: int) -> tuple[np.ndarray, np.ndarray]:
    chosen = np.random.default_rng(seed).choice(joint.size, size=n, p=joint.ravel())
    return chosen // joint.shape[1], chosen % joint.shape[1]


def bits(joint: np.ndarray) -> float:
    rows, columns = joint.sum(1, keepdims=True), joint.sum(0, keepdims=True)
    return float((joint * np.log2(joint / (rows * columns))).sum())


def test_a_known_joint_distribution() -> None:
    joint = np.full((8, 4), 0.4 / 32) + 0.6 * np.kron(np.eye(4), np.full((2, 1), 1 / 8))
    estimates = [mutual_information(*draw(joint, 300, seed)) for seed in range(200)]
    assert np.mean(estimates) == pytest.approx(bits(joint), abs=0.02)


def test_independence_is_zero_on_average_even_with_few_samples() -> None:
    joint = np.full((8, 4), 1 / 32)
    estimates = [mutual_information(*draw(joint, 200, seed)) for seed in range(300)]
    assert abs(np.mean(estimates)) < 0.01  # the plain estimate would be 21 / (2 * 200 * ln 2) = 0.076 too large


def test_a_deterministic_pair_has_all_bits() -> None:
    x = np.tile(np.arange(4), 5000)
    assert mutual_information(x, x) == pytest.approx(2.0, abs=0.001)


def test_quantiles_are_even_and_a_still_unit_has_one_bin() -> None:
    counts = np.bincount(into_quantiles(np.random.default_rng(0).normal(size=8000)))
    assert len(counts) == 8
    assert counts.min() > 900
    assert set(into_quantiles(np.zeros(100))) == {0}


@pytest.mark.parametrize("share", [0.5, 0.8, 0.9])
def test_a_unit_at_its_upper_limit_tells_as_much_as_its_mirror_image(share: float) -> None:
    rng = np.random.default_rng(0)
    windows = [np.where(np.arange(20) < 20 * share, 1.0, rng.random(20))[:, None] for _ in range(50)]
    upper, lower = phase_information(windows), phase_information([-window for window in windows])
    assert upper is not None
    assert lower is not None
    assert lower.bits[0] > 0.2
    assert upper.bits[0] == pytest.approx(lower.bits[0], abs=0.02)


def test_a_unit_that_counts_the_window_and_one_that_does_not() -> None:
    rng = np.random.default_rng(3)
    windows = [
        np.stack([np.arange(n) / n, rng.normal(size=n), np.zeros(n)], axis=1) for n in rng.integers(8, 40, size=60)
    ]
    found = phase_information(windows)
    assert found is not None
    assert found.bits[0] > 1.8
    assert abs(found.bits[1]) < 0.05
    assert found.bits[2] == 0.0
    assert found.control[0] < 0.3
    assert found.n_windows == 60


def test_windows_too_short_for_phases() -> None:
    assert phase_information([np.zeros((3, 2))]) is None
