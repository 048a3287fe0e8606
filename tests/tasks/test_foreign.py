"""Gymnasium-Robotics by plain ids, on versions of MuJoCo that it does not know yet."""

import subprocess
import sys

import gymnasium as gym
import numpy as np
import pytest
from sb3_tbc.tasks import foreign
from sb3_tbc.tasks.generic import DescribedGoalEnv, check_goal_env


def test_home_of_an_id():
    assert foreign.home_of("FetchReach-v4") == foreign.ROBOTICS
    assert foreign.home_of("CartPole-v1") == ""
    assert foreign.home_of("NoSuchThing-v0") is None


def test_without_gymnasium_robotics(monkeypatch):
    monkeypatch.setitem(sys.modules, foreign.ROBOTICS, None)
    assert foreign.home_of("NoSuchThing-v0") is None


def test_importing_is_quiet():
    code = "from sb3_tbc.tasks.foreign import home_of; print(home_of('FetchReach-v4'))"
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert (done.stdout, done.stderr) == ("gymnasium_robotics\n", "")


def test_mending_twice_changes_nothing():
    from gymnasium_robotics.utils import mujoco_utils

    first = foreign.mend_joint_types()
    module = mujoco_utils.mujoco
    assert foreign.mend_joint_types() == first
    assert mujoco_utils.mujoco is module
    assert int(module.mjtJoint.mjJNT_HINGE) == 3
    assert module.mj_step is __import__("mujoco").mj_step


def test_where_enums_compare_nothing_is_touched(monkeypatch):
    import mujoco
    from gymnasium_robotics.utils import mujoco_utils

    class Plain:
        mjJNT_FREE = 0

    monkeypatch.setattr(mujoco, "mjtJoint", Plain)
    monkeypatch.setattr(mujoco_utils, "mujoco", mujoco)
    assert not foreign.mend_joint_types()
    assert mujoco_utils.mujoco is mujoco


@pytest.mark.parametrize("env_id", ["FetchReach-v4", "FetchPush-v4"])
def test_fetch_can_be_built_and_moves_as_told(env_id):
    foreign.home_of(env_id)
    check_goal_env(gym.make(env_id))
    env = DescribedGoalEnv(gym.make(env_id), n_probe_steps=300)
    np.testing.assert_array_equal(env.subgoals.thresholds, [0.05])
    assert env.subgoals.groups == ((0, 1, 2),)


def test_a_straight_line_solves_fetch_reach():
    foreign.home_of("FetchReach-v4")
    env = DescribedGoalEnv(gym.make("FetchReach-v4"), n_probe_steps=100)
    for seed in range(3):
        observation, info = env.reset(seed=seed)
        for _ in range(env.max_episode_steps):
            direction = 10 * (observation["desired_goal"] - observation["achieved_goal"])
            observation, reward, terminated, _, info = env.step(np.append(np.clip(direction, -1, 1), 0).astype("f4"))
            if terminated:
                break
        assert info["is_success"]
        assert reward == 0.0
