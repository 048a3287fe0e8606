"""What a guard hands on of a step that it ended: the step before it, and what the reset shows."""

from __future__ import annotations

import numpy as np
import pytest
from corridor import Corridor

from sb3_tbc.smdp.episode_limit import with_episode_limit
from sb3_tbc.smdp.goal_vec_env import GoalVecEnv
from sb3_tbc.smdp.guard import Guard


class NanAtStepTwo(Corridor):
    """Its second step shows a position that is no number."""

    def step(self, action):
        observation, *rest = super().step(action)
        if self.steps == 2:
            observation["achieved_goal"] = np.array([np.nan])
        return observation, *rest


def test_what_was_seen_is_the_step_before_and_not_the_reset() -> None:
    guard = Guard(with_episode_limit(GoalVecEnv([lambda: NanAtStepTwo(goal=0.9)])), "end-episode")
    guard.reset()
    actions, steps = np.ones((1, 1), np.float32), np.zeros(1, dtype=np.int64)
    assert not guard.step(actions, steps).bad[0]
    step = guard.step(actions, steps + 1)
    assert step.bad[0]
    assert step.dones[0]
    assert step.seen["achieved_goal"][0, 0] == pytest.approx(0.1)
    assert step.infos[0]["terminal_observation"]["achieved_goal"][0] == pytest.approx(0.1)
    assert step.observation["achieved_goal"][0, 0] == 0.0
