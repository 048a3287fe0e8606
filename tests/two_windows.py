"""One short episode of two windows in the corridor, and what reads it."""

from __future__ import annotations

from typing import Any

import numpy as np
from corridor import Corridor

from sb3_tbc.replay.buffers import SubgoalReplayBuffer
from sb3_tbc.smdp.hindsight import (
    GoalTest,
)
from sb3_tbc.smdp.options import Episode, Option, OptionRules, TerminationReason
from sb3_tbc.smdp.rewards import LowLevelReward
from sb3_tbc.smdp.views import LevelViews

ENV = Corridor()
RULES = OptionRules(dt_max=4.0, max_options=5)
LAYOUT = LevelViews(ENV.subgoals, True)
SPARSE = LowLevelReward("sparse", ENV.subgoals, RULES)
GOALS = GoalTest(lambda a, d: ENV.compute_reward(a, d, {}), lambda a, d: ENV.compute_terminated(a, d, {}))


def option(start: int, duration: int, subgoal: float, budget: float, testing: bool, reached: bool) -> Option:
    unit = np.array([subgoal, 2 * budget / 4.0 - 1])
    reason = TerminationReason.REACHED if reached else TerminationReason.EXPIRED
    return Option(start, duration, unit, np.array([subgoal]), budget, testing, reached, reason)


def episode() -> Episode:
    """Two windows to the right, 0 -> 0.3 -> 0.5: the first (3 steps, to 0.9) fails its test, the second reaches 0.5."""
    position = np.array([0.0, 0.1, 0.2, 0.3, 0.4, 0.5])
    rows = np.stack([position, np.arange(6.0), np.ones(6)], axis=1).astype(np.float32)
    return Episode(
        observation=rows,
        achieved_goal=position[:, None],
        desired_goal=np.full((6, 1), 0.5),
        actions=np.ones((5, 1), np.float32),
        states=np.zeros((5, 2), np.float32),
        next_states=np.ones((5, 2), np.float32),
        rewards=np.array([-1.0, -1, -1, -1, 0]),
        options=(option(0, 3, 0.9, 2.5, True, False), option(3, 2, 0.5, 1.5, False, True)),
        terminated=True,
        success=True,
    )


def low_buffer(size: int, hindsight: float, rules: OptionRules = RULES, **kwargs: Any) -> SubgoalReplayBuffer:
    spaces = LAYOUT.low_space(), ENV.action_space
    return SubgoalReplayBuffer(size, *spaces, LAYOUT, rules, 2, 0.99, hindsight, seed=0, **kwargs)
