"""What the tests of SB3's contract share: small agents of all four algorithms, and the table in ``docs/sb3.md``."""

from __future__ import annotations

import re
from collections.abc import Callable
from pathlib import Path
from typing import Any, TypeVar

import pytest
from corridor import Corridor
from stable_baselines3.common.base_class import BaseAlgorithm

from sb3_tbc import HAC, TBCHRL, HiTS, SubgoalSpace
from sb3_tbc.tbc_hrl.flat_sac import FlatSAC

PAGE = Path(__file__).parents[2] / "docs" / "sb3.md"
TWO_LEVELS = {"tbc-hrl": TBCHRL, "hits": HiTS, "hac": HAC}
ALGORITHMS: dict[str, Any] = {**TWO_LEVELS, "sac": FlatSAC}
LEVEL: dict[str, Any] = {"batch_size": 16, "buffer_size": 2000, "policy_kwargs": {"net_arch": [8, 8]}}

every_algorithm = pytest.mark.parametrize("algo", ALGORITHMS)
two_levels = pytest.mark.parametrize("algo", TWO_LEVELS)

Test = TypeVar("Test", bound=Callable[..., None])
SHOWN: dict[str, set[str]] = {}
"""Rows of the table, as ``"what: verdict"``, and the tests that show them."""


def shows(verdict: str, *rows: str) -> Callable[[Test], Test]:
    """Say of a test which rows of the table it shows.

    :param verdict: ``yes``, ``refused`` or ``not applicable``
    :param rows: first column of the table, without marks
    """

    def note(test: Test) -> Test:
        for row in rows:
            SHOWN.setdefault(f"{row}: {verdict}", set()).add(test.__name__)
        return test

    return note


def table_rows() -> list[str]:
    """The rows of all tables of the page, as ``"what: verdict"``, but for those that name a test file of their own."""
    rows = []
    for line in PAGE.read_text(encoding="utf-8").splitlines():
        cells = [cell.strip() for cell in line.strip().strip("|").split("|")]
        verdict = re.match(r"yes|refused|not applicable", cells[1]) if len(cells) == 3 else None
        if verdict and line.startswith("|") and not cells[2].startswith("`tests/"):
            rows += [f"{name}: {verdict[0]}" for name in re.findall(r"`([^`]+)`", cells[0])]
    return rows


def corridor(goal: float | None = None) -> Corridor:
    """A corridor of 20 steps whose subgoal space is plain data."""
    env = Corridor(20, goal)
    env.subgoals = SubgoalSpace.from_slices([-1.0], [1.0], [0.05], local_scale=[1.0, 50.0, 100.0], names=["position"])
    return env


def make(algo: str, env: Any = None, **settings: Any) -> BaseAlgorithm:
    """A small agent that learns within a hundred steps."""
    small = LEVEL if algo == "sac" else {"high": LEVEL, "low": LEVEL, "max_options": 5, "compile": False}
    given = {"gradient_ratio": 0.1, "seed": 0, **small, **settings}
    model: BaseAlgorithm = ALGORITHMS[algo]("MultiInputPolicy", corridor() if env is None else env, **given)
    return model
