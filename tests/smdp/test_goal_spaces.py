"""Unit actions in the environment's own units."""

from __future__ import annotations

import numpy as np
import pytest
from gymnasium import spaces

from sb3_tbc.smdp.goal_spaces import UnitActions, goal_space_problems


@pytest.mark.parametrize("dtype", [np.float32, np.float64])
def test_actions_lie_in_their_space(dtype: type[np.floating]) -> None:
    ends = np.random.default_rng(0).uniform([-5.0, 0.0], [0.0, 5.0], (1000, 2)).round(2).astype(dtype)
    space = spaces.Box(ends[:, 0], ends[:, 1], dtype=dtype)
    unit = UnitActions(space)
    for corner in (-1.0, 1.0):
        actions = unit.unscale(np.full(1000, corner, dtype=np.float32))
        assert space.contains(actions)
        assert np.allclose(unit.scale(actions), corner, atol=1e-5)


@pytest.mark.parametrize(("low", "high"), [([-1, -np.inf], [1, 1]), ([-1, -3e38], [1, 3e38])])
def test_actions_without_bounds_have_a_cure_that_works(low: list[float], high: list[float]) -> None:
    """RescaleAction refuses such spaces, and ClipAction is what makes them."""
    goals = spaces.Dict({key: spaces.Box(-1, 1, (1,)) for key in ("observation", "achieved_goal", "desired_goal")})
    given = spaces.Box(np.float32(low), np.float32(high))
    (problem,) = goal_space_problems(goals, given)
    assert problem.startswith("its action bounds must be finite")
    assert "RescaleAction" not in problem
    assert "ClipAction takes bounds away" in problem
