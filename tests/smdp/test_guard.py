"""What a guard hands on of a step that it ended: the step before it, and what the reset shows."""

from __future__ import annotations

import numpy as np
import pytest
from corridor import Corridor
from stable_baselines3.common.monitor import Monitor
from stable_baselines3.common.vec_env import DummyVecEnv, SubprocVecEnv, VecFrameStack

from sb3_tbc.errors import ConfigError, EnvironmentFault
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


def test_frames_that_are_stacked_around_a_vector_cannot_begin_again() -> None:
    stacked = VecFrameStack(GoalVecEnv([Corridor]), 3)
    Guard(with_episode_limit(stacked))
    with pytest.raises(ConfigError, match="on_bad_step='end-episode' resets one environment alone"):
        Guard(with_episode_limit(stacked), "end-episode")


def test_episodes_of_someone_else_in_stacked_frames_end_the_run_in_words() -> None:
    stacked = with_episode_limit(VecFrameStack(GoalVecEnv([Corridor]), 3))
    guard = Guard(stacked)
    guard.reset()
    stacked.reset()
    with pytest.raises(EnvironmentFault, match="it was reset by someone else"):
        guard.step(np.zeros((1, 1), np.float32), np.zeros(1, dtype=np.int64))


def two_monitored() -> list:
    return [lambda: Monitor(Corridor(goal=0.9))] * 2


VECTORS = {
    "here": lambda: GoalVecEnv(two_monitored()),
    "dummy": lambda: DummyVecEnv(two_monitored()),
    "processes": lambda: SubprocVecEnv(two_monitored(), start_method="fork"),
    "bare processes": lambda: SubprocVecEnv([lambda: Corridor(goal=0.9)] * 2, start_method="fork"),
}


@pytest.mark.parametrize("kind", VECTORS)
@pytest.mark.parametrize("before", [0, 3])
def test_an_episode_that_someone_else_begins_is_none_of_the_agents(kind: str, before: int, caplog) -> None:
    """Evaluating in the agent's own environments between two steps of it must not mix two episodes."""
    venv = with_episode_limit(VECTORS[kind]())
    guard = Guard(venv)
    guard.reset()
    actions, steps = np.ones((2, 1), np.float32), np.zeros(2, dtype=np.int64)
    for number in range(before):
        assert not guard.step(actions, steps + number).bad.any()
    venv.reset()
    venv.step(-actions)
    step = guard.step(actions, steps + before)
    assert step.bad.all()
    assert step.dones.all()
    np.testing.assert_allclose(step.seen["achieved_goal"][:, 0], 0.1 * before)
    np.testing.assert_allclose(step.observation["achieved_goal"][:, 0], 0.0)
    assert "reset by someone else" in caplog.text
    after = guard.step(actions, steps)
    assert not after.bad.any()
    np.testing.assert_allclose(after.seen["achieved_goal"][:, 0], 0.1)
    venv.close()
