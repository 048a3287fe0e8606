"""2N steps are N steps, saved, loaded, and N more: to the bit, for every algorithm."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
import torch as th
from halves import Way, by_command, by_python

from sb3_tbc.tbc_hrl import resume

ALGORITHMS = ("tbc-hrl", "hits", "hac", "sac")


CASES = [
    pytest.param(algo, n_envs, way, marks=pytest.mark.slow if (algo, n_envs) == ("sac", 1) else [])
    for algo in ALGORITHMS
    for n_envs in (1, 4)
    for way in ("loaded", "same object")
]


@pytest.mark.parametrize(("algo", "n_envs", "way"), CASES)
def test_by_python(algo: str, n_envs: int, way: Way, tmp_path: Path) -> None:
    assert by_python(tmp_path, algo, n_envs, False, way) == []


@pytest.mark.parametrize(("algo", "n_envs"), [("tbc-hrl", 1), ("sac", 4)])
def test_by_the_command(algo: str, n_envs: int, tmp_path: Path) -> None:
    assert by_command(tmp_path, algo, n_envs, False) == []


@pytest.mark.slow
@pytest.mark.parametrize("compile", [False, True])
@pytest.mark.parametrize("n_envs", [1, 4])
@pytest.mark.parametrize("algo", ALGORITHMS)
def test_all(algo: str, n_envs: int, compile: bool, tmp_path: Path) -> None:
    for way in (by_command, by_python):
        assert way(tmp_path / way.__name__, algo, n_envs, compile) == []


@pytest.mark.parametrize("left_out", ["agent", "high.noise", "low.noise", "high.replay", "low.replay"])
def test_a_random_stream_that_is_left_out_is_found(
    left_out: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The comparison is worth something: it sees one stream of random numbers that was not saved."""
    whole = resume.generators
    monkeypatch.setattr(
        resume, "generators", lambda learning: {k: v for k, v in whole(learning).items() if k != left_out}
    )
    found = by_python(tmp_path, "tbc-hrl", 1, False)
    assert any(name.startswith("parameters") for name in found), found


def test_a_random_stream_of_the_flat_agent_that_is_left_out_is_found(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    for owner, name in [(th, "set_rng_state"), (np.random, "set_state")]:
        with monkeypatch.context() as patch:
            patch.setattr(owner, name, lambda *_: None)
            assert by_python(tmp_path / name, "sac", 4, False)
