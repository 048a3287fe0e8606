"""Exploring with both levels, and turning finished episodes into replay."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray
from stable_baselines3.common.vec_env import VecEnv

from sb3_tbc.level.level import SACLevel
from sb3_tbc.replay.both_levels import Replay
from sb3_tbc.smdp.hierarchical_vec_env import HierarchicalVecEnv, Proposal, Schedule
from sb3_tbc.smdp.hindsight import (
    GoalRange,
    GoalTest,
    HighLevelSteps,
    HindsightSettings,
    high_level_steps,
    low_level_steps,
)
from sb3_tbc.smdp.options import Episode, OptionRules
from sb3_tbc.smdp.rewards import HighLevelReward, LowLevelReward
from sb3_tbc.smdp.spaces import FloatArray, GoalObservation
from sb3_tbc.smdp.views import LevelLayout


class Exploration(NamedTuple):
    """How both levels act while they learn."""

    random_fraction: float  # share of uniformly random actions on each level
    testing_fraction: float  # share of options that test their subgoal
    deterministic_testing: bool  # whether the low level acts deterministically in a test
    memory: str  # when the membrane is reset: "window", "episode" or "none"


def forget(
    membrane: FloatArray, memory: str, window_over: NDArray[np.bool_], infos: Sequence[dict[str, Any]]
) -> FloatArray:
    """Membrane potentials ``(n_envs, state_dim)`` after a step, reset where ``memory`` ends.

    :param window_over: whose option ended with the step
    :param infos: the step's infos; ``"episode_over"`` marks the end of an episode
    """
    if not membrane.shape[1]:
        return membrane
    if memory == "none":
        return np.zeros(membrane.shape, dtype=np.float32)
    over = window_over if memory == "window" else np.array(["episode_over" in info for info in infos])
    return np.where(over[:, None], np.float32(0.0), membrane) if over.any() else membrane


class Collector:
    """Both levels exploring a vector of goal environments.

    :param venv: the environments
    :param high: proposes options
    :param low: executes them
    :param exploration: see :class:`Exploration`
    :param rng: source of all randomness here
    :param schedule: gives the time budgets where the high level does not
    """

    def __init__(
        self,
        venv: VecEnv,
        high: SACLevel,
        low: SACLevel,
        layout: LevelLayout,
        rules: OptionRules,
        exploration: Exploration,
        rng: np.random.Generator,
        schedule: Schedule | None = None,
    ) -> None:
        self.high, self.low, self.rng = high, low, rng
        self.exploration = exploration
        self.env = HierarchicalVecEnv(venv, self.propose, layout, rules, low.state_dim, schedule)
        self.reset()

    def reset(self) -> None:
        """Begin new episodes."""
        self.membrane: FloatArray = np.zeros((self.env.num_envs, self.low.state_dim), dtype=np.float32)
        self.observation: FloatArray = self.env.reset()

    def get_state(self) -> dict[str, NDArray[Any]]:
        """Live options, running episodes and memory, as plain arrays."""
        return {**self.env.get_state(), "membrane": self.membrane, "observation": self.observation}

    def set_state(self, state: Mapping[str, NDArray[Any]], observation: GoalObservation) -> bool:
        """Take over what :meth:`get_state` gave; False if what the environments show does not belong to it.

        :param observation: what the environments show now
        """
        seen = self.env.set_state(state, observation)
        self.membrane, self.observation = state["membrane"].astype(np.float32), seen
        return np.array_equal(seen, state["observation"])

    def step(self) -> list[dict[str, Any]]:
        """One step of every environment; the infos it gave."""
        observation, _, window_over, infos = self.env.step(self.env.unscale(self.act()))
        self.observation = np.asarray(observation)
        self.membrane = forget(self.membrane, self.exploration.memory, window_over, infos)
        return list(infos)

    def take_episodes(self) -> list[Episode]:
        """The episodes finished since the last call."""
        episodes, self.env.episodes = self.env.episodes, []
        return episodes

    def propose(self, observations: FloatArray, where: NDArray[np.intp]) -> Proposal:
        """The exploring high level: mostly SAC samples, sometimes uniform, some of them tests."""
        n = len(where)
        unit, _ = self.high.act(observations, np.zeros((n, 0), dtype=np.float32), False, self.rng)
        self._randomise(unit)
        return Proposal(unit.astype(np.float64), self.rng.random(n) < self.exploration.testing_fraction)

    def act(self) -> FloatArray:
        """The exploring low level's unit actions for every environment."""
        before = self.membrane
        tested = self.env.clock.testing if self.exploration.deterministic_testing else False
        unit, after = self.low.act(self.observation, before, tested, self.rng)
        self._randomise(unit, tested)
        self.env.remember(before, after)
        self.membrane = after
        return unit

    def _randomise(self, unit: FloatArray, spared: bool | NDArray[np.bool_] = False) -> None:
        """Replace a share of the actions by uniform ones, in place; not those of a mask ``(n,)``."""
        uniform = self.rng.random(len(unit)) < self.exploration.random_fraction
        if not np.count_nonzero(uniform):
            return
        if spared is not False:
            uniform &= np.logical_not(spared)
        unit[uniform] = self.rng.uniform(-1.0, 1.0, (np.count_nonzero(uniform), unit.shape[1]))


class EpisodeStore:
    """Turns finished episodes into transitions of both levels, hindsight included.

    :param replay: where they go
    :param reward: the high level's reward and discount
    :param low_reward: the low level's reward
    :param hindsight: how much of it
    :param rng: draws hindsight goals and times
    :param asked: the goals asked for so far, which limit those of hindsight; None does not limit them
    """

    def __init__(
        self,
        replay: Replay,
        layout: LevelLayout,
        rules: OptionRules,
        reward: HighLevelReward,
        low_reward: LowLevelReward,
        hindsight: HindsightSettings,
        rng: np.random.Generator,
        asked: GoalRange | None = None,
    ) -> None:
        self.asked = asked
        self.replay, self.layout, self.rules = replay, layout, rules
        self.reward, self.low_reward, self.hindsight, self.rng = reward, low_reward, hindsight, rng

    def add(self, episode: Episode, goal_test: GoalTest) -> HighLevelSteps:
        """Store an episode; what the high level learns from it."""
        subgoals = self.layout.subgoals
        if self.asked is not None:
            self.asked.add(episode.desired_goal[0])
        self.replay.low.extend(low_level_steps(episode, subgoals, self.rules, self.low_reward))
        steps = high_level_steps(
            episode, subgoals, self.rules, self.reward, self.hindsight, goal_test, self.layout.high, self.rng,
            self.asked,
        )  # fmt: skip
        self.replay.high.extend(steps)
        return steps


def goal_test_of(venv: VecEnv) -> GoalTest:
    """The task's own reward and termination, asked of the first environment (as SB3's HER does)."""

    def ask(method: str, achieved: FloatArray, desired: FloatArray) -> NDArray[Any]:
        answer = venv.env_method(method, achieved, desired, {}, indices=[0])[0]
        return np.broadcast_to(np.asarray(answer), (len(achieved),))

    return GoalTest(
        lambda a, d: ask("compute_reward", a, d).astype(np.float64),
        lambda a, d: ask("compute_terminated", a, d).astype(bool),
    )
