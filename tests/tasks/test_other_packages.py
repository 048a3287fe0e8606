"""Goal environments of other packages, one of each kind that was once read wrong; skipped where not installed."""

import gymnasium as gym
import numpy as np
import pytest
from sb3_tbc.tasks.foreign import import_quietly
from sb3_tbc.tasks.generic import describe_goal_env


def described(module, env_id, **kwargs):
    """The description of an environment, from few random steps; skips where its package is not installed."""
    pytest.importorskip(module)
    import_quietly(module)
    env = gym.make(env_id, **kwargs)
    try:
        return describe_goal_env(env, n_probe_steps=200)
    finally:
        env.close()


def test_bounds_are_those_that_an_arm_reaches_not_those_it_declares():
    """panda-gym declares goals of +-10 m; its arm reaches tenths of a metre."""
    subgoals = described("panda_gym", "PandaReach-v3").subgoals
    assert (subgoals.high - subgoals.low < 1.5).all()  # the environment is not seeded: about 1.0, by chance
    np.testing.assert_allclose(subgoals.thresholds, [0.05], rtol=1e-3)
    assert subgoals.groups == ((0, 1, 2),)


def test_a_dense_reward_is_read_through_the_success_test_of_the_package():
    test = described("panda_gym", "PandaReachDense-v3").success_test
    assert test.own == "task.is_success"
    assert test.worst is None


def test_coordinates_that_the_task_ignores_are_reached_by_every_subgoal():
    """highway-env's parking does not count velocities."""
    description = described("highway_env", "parking-v0", max_episode_steps=100)
    subgoals, span = description.subgoals, description.subgoals.high - description.subgoals.low
    assert description.success_test.own == "_is_success"
    assert (subgoals.thresholds[2:4] > span[2:4]).all()
    assert (subgoals.thresholds[[0, 1, 4]] < span[[0, 1, 4]]).all()


def test_a_parking_lot_without_a_time_limit_is_refused_with_the_cure():
    with pytest.raises(ValueError, match=r"no time limit; pass gymnasium\.make"):
        described("highway_env", "parking-v0")


def test_poses_have_a_distance_and_an_angle():
    subgoals = described("gymnasium_robotics", "HandManipulateBlock-v1").subgoals
    np.testing.assert_allclose(subgoals.thresholds, [0.01, 0.1], rtol=1e-3)
    assert subgoals.groups == ((0, 1, 2), (3, 4, 5, 6))


@pytest.mark.parametrize("env_id", ["HandManipulatePen-v1", "HandManipulatePenDense-v1"])
def test_rewards_that_differ_in_batches_are_refused(env_id):
    """The pen's reward sets the third row, not the third angle, of a batch."""
    with pytest.raises(ValueError, match=r"in a batch, .* singly"):
        described("gymnasium_robotics", env_id)


def test_a_dense_maze_is_refused_with_the_cure():
    with pytest.raises(
        ValueError, match="no success test of its own tells when a goal is reached; use its sparse variant"
    ):
        described("gymnasium_robotics", "PointMaze_UMazeDense-v3")
