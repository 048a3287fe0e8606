"""An environment from ``gymnasium.make`` shows the task's own attributes, as SB3's checker and older code expect."""

from __future__ import annotations

import copy
import pickle

import gymnasium as gym
import numpy as np
import pytest
from making import make
from sb3_tbc.tasks import TASKS
from stable_baselines3.common.env_checker import check_env


@pytest.mark.parametrize("task", TASKS)
def test_sb3s_checker_passes_as_made(task: str) -> None:
    check_env(make(task))


def test_attributes_are_the_tasks() -> None:
    env = gym.make("sb3_tbc/Pendulum-v0", max_episode_steps=50)
    assert env.subgoals is env.unwrapped.subgoals
    assert env.compute_reward(np.zeros(2), np.zeros(2), {}) == 0.0
    with pytest.raises(AttributeError, match="no_such_thing"):
        _ = env.no_such_thing
    for twin in (copy.deepcopy(env), pickle.loads(pickle.dumps(env))):
        assert twin.subgoals is not env.subgoals
    assert gym.make(env.spec).spec.max_episode_steps == 50
