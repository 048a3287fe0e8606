"""A task's functions as learning asks them: batched where they can be, pair by pair where they answer for one."""

from __future__ import annotations

from typing import Any

import numpy as np
from corridor import Corridor
from stable_baselines3.common.vec_env import DummyVecEnv

from sb3_tbc.smdp.goal_test import check_goal_test, goal_test_of


class OneAtATime(Corridor):
    """Says whether a goal ends the episode for one pair of goals, as the mazes of Gymnasium-Robotics do."""

    def compute_terminated(self, achieved_goal: Any, desired_goal: Any, info: Any) -> Any:
        return bool(np.linalg.norm(achieved_goal - desired_goal) <= 0.05)


def test_an_answer_for_one_pair_is_not_taken_for_all() -> None:
    venv = DummyVecEnv([OneAtATime])
    check_goal_test(venv)
    test = goal_test_of(venv)
    achieved, desired = np.zeros((3, 1)), np.array([[0.0], [0.5], [0.04]])
    np.testing.assert_array_equal(test.terminated(achieved, desired), [True, False, True])
    np.testing.assert_array_equal(test.terminated(achieved[:1], desired[:1]), [True])
    np.testing.assert_array_equal(test.reward(achieved, desired), [0.0, -1.0, 0.0])
