"""A task's functions as learning asks them: batched where they can be, pair by pair where they answer for one."""

from __future__ import annotations

import warnings
from typing import Any

import numpy as np
import pytest
from corridor import Corridor
from gymnasium import spaces
from gymnasium.wrappers import TransformReward
from stable_baselines3.common.vec_env import DummyVecEnv, VecFrameStack

from sb3_tbc import SubgoalSpace
from sb3_tbc.errors import ConfigError
from sb3_tbc.smdp.goal_spaces import said_success
from sb3_tbc.smdp.goal_test import check_goal_test, goal_test_of
from sb3_tbc.tbc_hrl import TBCHRL
from sb3_tbc.tbc_hrl.flat_sac import FlatSAC


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


@pytest.mark.parametrize("dim", [1, 2, 3, 4])
def test_a_reward_for_one_goal_is_refused_before_learning_whatever_its_size(dim: int) -> None:
    """Of as many goals as entries it gives as many values, which look like one for each goal."""

    class OneGoal(Corridor):
        def __init__(self) -> None:
            super().__init__()
            goals = {key: spaces.Box(-1.0, 1.0, (dim,), np.float64) for key in ("achieved_goal", "desired_goal")}
            self.observation_space = spaces.Dict({**self.observation_space.spaces, **goals})

        def compute_reward(self, achieved_goal: Any, desired_goal: Any, info: Any) -> Any:
            return -np.sqrt(sum((achieved_goal[i] - desired_goal[i]) ** 2 for i in range(dim)))

        def compute_terminated(self, achieved_goal: Any, desired_goal: Any, info: Any) -> Any:
            return False

    with pytest.raises(ConfigError, match="Vectorise it: goals are arrays"):
        check_goal_test(DummyVecEnv([OneGoal]))


def test_stacked_goals_are_refused_with_a_subgoal_space_of_their_own_too() -> None:
    """The task would take a part of an earlier goal for the present one, and hindsight would learn that."""
    stacked = VecFrameStack(DummyVecEnv([Corridor]), 2)
    with pytest.raises(ConfigError, match=r"achieved_goal of shape \(2,\)"):
        check_goal_test(stacked)
    scales = {"local_scale": [1.0] * 6, "names": ["before", "now"]}
    subgoals = SubgoalSpace.from_slices([-1.0] * 2, [1.0] * 2, [0.05] * 2, **scales)
    for algorithm, more in ((TBCHRL, {"subgoals": subgoals}), (FlatSAC, {})):
        with pytest.raises(ConfigError, match="changes 'observation' alone"):
            algorithm("MultiInputPolicy", stacked, **more)


class ReadsInfo(Corridor):
    """Works with one empty info, not with a list of them."""

    def compute_reward(self, achieved_goal: Any, desired_goal: Any, info: Any) -> Any:
        return super().compute_reward(achieved_goal, desired_goal, info) - info.get("cost", 0.0)


def test_a_list_of_infos_is_tried_where_learning_gives_one() -> None:
    """SB3's hindsight replay does; that it fails must not be found out after the first episode."""
    check_goal_test(DummyVecEnv([ReadsInfo]))
    with pytest.raises(ConfigError, match="a list of empty ones as SB3 gives it: AttributeError"):
        check_goal_test(DummyVecEnv([ReadsInfo]), listed_infos=True)
    with pytest.raises(ConfigError, match="a list of empty ones"):
        FlatSAC("MultiInputPolicy", ReadsInfo())


class CrashesAtTheEnd(Corridor):
    """The last step pays for more than the goal."""

    def step(self, action: Any) -> Any:
        observation, reward, success, truncated, info = super().step(action)
        return observation, reward - 5.0 * truncated, success, truncated, info


@pytest.mark.parametrize("agent", [TBCHRL, FlatSAC])
def test_rewards_that_hindsight_cannot_recompute_are_told_once(agent: type[TBCHRL] | type[FlatSAC]) -> None:
    """A wrapper that scales rewards leaves those of hindsight as they are, so that an agent learns from both kinds."""
    settings: dict[str, Any] = {"seed": 0, "learning_starts": 1000}  # nothing is updated
    if agent is TBCHRL:
        settings |= {"max_options": 4, "compile": False}
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        for plain in (Corridor(20), CrashesAtTheEnd(20)):
            agent("MultiInputPolicy", plain, **settings).learn(45)
    scaled = TransformReward(Corridor(20), lambda reward: 10.0 * float(reward))
    with pytest.warns(UserWarning, match="gave the reward -10, compute_reward gives -1: .*TransformReward") as told:
        agent("MultiInputPolicy", scaled, **settings).learn(90)
    assert len([w for w in told if "compute_reward" in str(w.message)]) == 1


class InPlace(Corridor):
    """Reckons in the arrays that it is given."""

    def compute_reward(self, achieved_goal: Any, desired_goal: Any, info: Any) -> Any:
        achieved_goal -= desired_goal
        return np.where(np.abs(achieved_goal)[..., 0] <= 0.05, 0.0, -1.0)


def test_goals_must_not_be_changed_in_place() -> None:
    with pytest.raises(ConfigError, match="changes the goals that it is given"):
        check_goal_test(DummyVecEnv([InPlace]))


@pytest.mark.parametrize(
    ("info", "said"),
    [
        ({}, None), ({"is_success": None}, None), ({"is_success": "False"}, None), ({"is_success": np.nan}, None),
        ({"is_success": np.bool_(True)}, True), ({"is_success": 0.0}, False), ({"success": np.array([1.0])}, True),
        ({"is_success": False, "success": True}, False), ({"is_success": []}, None),
    ],
)  # fmt: skip
def test_what_an_info_says_of_success(info: dict[str, Any], said: bool | None) -> None:
    assert said_success(info) is said


@pytest.mark.parametrize("answer", ["no", np.nan, 0.3, None])
@pytest.mark.parametrize("batched", [True, False])
def test_ends_are_true_or_false(answer: Any, batched: bool) -> None:
    """A text or NaN would count as an end, nothing as none."""

    class Vague(Corridor):
        def compute_terminated(self, achieved_goal: Any, desired_goal: Any, info: Any) -> Any:
            return np.array([answer] * len(achieved_goal)) if batched and np.ndim(achieved_goal) > 1 else answer

    with pytest.raises(ConfigError, match=r"compute_terminated.* must give True or False for each goal"):
        check_goal_test(DummyVecEnv([Vague]))


@pytest.mark.parametrize("kind", [bool, int, np.float32])
def test_ends_may_be_numbers(kind: Any) -> None:
    class Numbers(Corridor):
        def compute_terminated(self, achieved_goal: Any, desired_goal: Any, info: Any) -> Any:
            return np.asarray(super().compute_terminated(achieved_goal, desired_goal, info)).astype(kind)

    check_goal_test(DummyVecEnv([Numbers]))
