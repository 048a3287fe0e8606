"""Bounds and thresholds of subgoals in foreign environments come from what is seen and from rewards."""

import numpy as np
import pytest
from gymnasium import spaces
from points import Boxed, Point
from sb3_tbc.tasks.generic import describe_goal_env


def test_thresholds_come_from_the_reward_whatever_is_declared():
    subgoals = describe_goal_env(Point(threshold=0.5)).subgoals
    assert subgoals.groups == ((0, 1),)
    assert subgoals.reached(np.array([0.2, 0.2]), np.zeros(2))
    assert not subgoals.reached(np.array([0.3, 0.1]), np.zeros(2))
    one = describe_goal_env(Point(), thresholds=0.2).subgoals
    assert one.groups == ((0, 1),)
    np.testing.assert_array_equal(one.thresholds, [0.2])


def test_thresholds_come_from_rewards_where_nothing_is_declared():
    subgoals = describe_goal_env(Point(bound=4.0)).subgoals
    assert subgoals.groups == ((0, 1),)
    np.testing.assert_array_equal(subgoals.thresholds, [0.3])
    subgoals = describe_goal_env(Boxed(bound=4.0)).subgoals
    assert subgoals.groups == ((0,), (1,))
    np.testing.assert_array_equal(subgoals.thresholds, [0.3, 0.5])
    same = Boxed(bound=4.0)
    same.slack = 0.3
    assert describe_goal_env(same).subgoals.groups == ((0,), (1,))


def test_a_coordinate_that_the_reward_ignores_leaves_the_others_alone():
    env = Boxed(bound=4.0)
    env.slack = np.inf
    subgoals = describe_goal_env(env).subgoals
    assert subgoals.thresholds[0] == 0.3
    assert subgoals.thresholds[1] > (subgoals.high - subgoals.low)[1]  # any subgoal is reached in it


def test_a_coordinate_that_must_match_exactly_gets_a_share_of_its_range():
    env = Boxed(bound=4.0)
    env.slack = 1e-300
    subgoals = describe_goal_env(env, low=[-2, -2], high=[2, 2]).subgoals
    np.testing.assert_allclose(subgoals.thresholds, [0.3, 0.2])


class Pose(Point):
    """Position and orientation; both count, and the reward knows no distance between other points than poses."""

    turn, ignored = 0.2, False

    def __init__(self):
        super().__init__()
        goal = spaces.Box(-np.inf, np.inf, (6,), np.float64)
        self.observation_space = spaces.Dict(observation=goal, achieved_goal=goal, desired_goal=goal)

    def _see(self):
        angle = self.position.sum()
        pose = np.concatenate([self.position, [np.cos(angle), np.sin(angle), 0, 0]])
        return {"observation": pose, "achieved_goal": pose.copy(), "desired_goal": self.pose.copy()}

    def reset(self, *, seed=None, options=None):
        self.pose = np.zeros(6)
        super().reset(seed=seed)
        quaternion = self.np_random.normal(size=4)
        self.pose = np.concatenate([self.goal, quaternion / np.linalg.norm(quaternion)])
        return self._see(), {}

    def compute_reward(self, achieved_goal, desired_goal, info):
        one, other = np.asarray(achieved_goal), np.asarray(desired_goal)
        near = np.linalg.norm(one[..., :2] - other[..., :2], axis=-1) < 0.3
        assert np.allclose(np.linalg.norm(one[..., 2:], axis=-1), 1.0), "asked at a point that is no pose"
        angle = 2 * np.arccos(np.minimum(np.abs((one[..., 2:] * other[..., 2:]).sum(-1)), 1.0))
        return np.where(near & ((angle < self.turn) | self.ignored), 0.0, -1.0)


def test_quaternions_are_compared_by_angle_and_asked_about_only_where_they_are_rotations():
    subgoals = describe_goal_env(Pose()).subgoals
    assert subgoals.groups == ((0, 1), (2, 3, 4, 5))
    assert subgoals.rotations == (1,)
    np.testing.assert_allclose(subgoals.thresholds, [0.3, 0.2], rtol=1e-4)
    pose = np.array([0.1, 0.2, 0.5, 0.5, 0.5, 0.5])
    negative = pose * [1, 1, -1, -1, -1, -1]
    assert subgoals.reached(pose, pose)
    assert subgoals.reached(negative, pose)
    assert subgoals.reached(pose, pose * [1, 1, 3, 3, 3, 3])  # a subgoal's length means nothing
    for angle, near in ((0.19, True), (0.21, False)):
        turned = np.append(
            pose[:2], np.cos(angle / 2) * pose[2:] + np.sin(angle / 2) * np.array([0.5, -0.5, 0.5, -0.5])
        )
        assert bool(subgoals.reached(turned, pose)) is near
        assert bool(subgoals.reached(turned[None], pose[None])[0]) is near
    free = Pose()
    free.ignored = True
    assert describe_goal_env(free).subgoals.thresholds[1] > np.pi


class Scaled(Point):
    """The same task in another unit of length; its second goal never changes."""

    unit = 1.0

    def _see(self):
        seen = {key: self.unit * part for key, part in super()._see().items()}
        seen["achieved_goal"][1] = seen["desired_goal"][1] = 0.4 * self.unit
        return seen

    def compute_reward(self, achieved_goal, desired_goal, info):
        return super().compute_reward(np.asarray(achieved_goal) / self.unit, np.asarray(desired_goal) / self.unit, info)


@pytest.mark.parametrize("unit", [1e-4, 1e3])
def test_bounds_do_not_depend_on_the_unit_of_length(unit):
    expected, env = describe_goal_env(Scaled()).subgoals, Scaled()
    env.unit = unit
    found = describe_goal_env(env).subgoals
    np.testing.assert_allclose(found.low / unit, expected.low, rtol=1e-6)
    np.testing.assert_allclose(found.high / unit, expected.high, rtol=1e-6)
    np.testing.assert_allclose(found.thresholds / unit, expected.thresholds, rtol=1e-3)
