"""What an agent asks of its environment: the time limit is the one that episodes really have."""

from __future__ import annotations

from typing import Any

import gymnasium as gym
import numpy as np
import pytest
from corridor import Corridor
from gymnasium import spaces
from gymnasium.wrappers import TimeLimit
from stable_baselines3.common.vec_env import DummyVecEnv, SubprocVecEnv, VecMonitor

from sb3_tbc import TBCHRL
from sb3_tbc.tbc_hrl.environment import episode_length
from sb3_tbc.tbc_hrl.flat_sac import FlatSAC

ID = "sb3_tbc/Pendulum-v0"


def short() -> gym.Env[Any, Any]:
    return gym.make(ID, max_episode_steps=100)


def longer() -> gym.Env[Any, Any]:
    return gym.make(ID, max_episode_steps=2000)


def wrapped() -> gym.Env[Any, Any]:
    return TimeLimit(gym.make(ID), 100)


@pytest.mark.parametrize(("make", "steps"), [(short, 100), (longer, 2000), (wrapped, 100), (Corridor, 50)])
def test_windows_follow_the_limit_that_episodes_have(make: Any, steps: int) -> None:
    model = TBCHRL("MultiInputPolicy", make(), max_options=5, compile=False)
    assert model.dt_max == steps / 5
    assert episode_length(VecMonitor(DummyVecEnv([make, make]))) == steps


@pytest.mark.parametrize(("make", "steps"), [(longer, 2000), (Corridor, 50)])
def test_the_same_across_processes(make: Any, steps: int) -> None:
    env = SubprocVecEnv([make])
    try:
        assert episode_length(env) == steps
    finally:
        env.close()


def test_fewer_steps_than_decisions_are_no_mistake() -> None:
    model = TBCHRL("MultiInputPolicy", Corridor(max_episode_steps=7), compile=False)
    assert (model.dt_max, model.config.max_options) == (1.0, 20)
    model.learn(30)


@pytest.mark.parametrize("algorithm", [TBCHRL, FlatSAC])
def test_what_no_goal_can_be_reached_in_is_refused_before_sb3_looks_at_it(algorithm: Any) -> None:
    """SB3 refuses actions without bounds by an assertion that names no cure."""
    endless = Corridor()
    endless.action_space = spaces.Box(-np.inf, np.inf, (1,), np.float32)
    with pytest.raises(ValueError, match="action bounds must be finite"):
        algorithm("MultiInputPolicy", endless)
    with pytest.raises(ValueError, match="action bounds must be finite"):
        algorithm("MultiInputPolicy", Corridor()).set_env(endless)


@pytest.mark.parametrize(
    ("name", "value", "message"),
    [
        ("reward_range", (0, -1), r"reward_range must be \(lowest, highest\), two numbers, got \(0, -1\)"),
        ("reward_range", (-1, 0, 1), "reward_range must"),
        ("reward_range", "ab", "reward_range must"),
        ("reward_range", (np.nan, 0), "reward_range must"),
        ("max_episode_steps", -5, "max_episode_steps must be a whole number of steps, or None for no limit, got -5"),
        ("max_episode_steps", 2.5, "max_episode_steps must"),
        ("max_episode_steps", True, "max_episode_steps must"),
        ("max_episode_steps", np.inf, "max_episode_steps must"),
        ("max_episode_steps", "50", "max_episode_steps must"),
        ("subgoals", [1], r"attribute subgoals must be a SubgoalSpace, got \[1\]"),
    ],
)
def test_what_a_task_says_of_itself_must_make_sense(name: str, value: Any, message: str) -> None:
    env = Corridor()
    setattr(env, name, value)
    with pytest.raises(ValueError, match=message):
        TBCHRL("MultiInputPolicy", env, compile=False)


def test_rewards_without_bounds_are_no_mistake() -> None:
    env = Corridor()
    setattr(env, "reward_range", (-np.inf, np.inf))  # noqa: B010 (it has no such attribute)
    assert TBCHRL("MultiInputPolicy", env, compile=False).reward_range is None
