"""Exploring with both levels, and turning finished episodes into replay."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import NamedTuple, TypeVar

import numpy as np
from stable_baselines3.common.vec_env import VecEnv

from sb3_tbc.arrays import AnyArray, Arrays, BoolArray, FloatArray, Indices
from sb3_tbc.replay.both_levels import Replay
from sb3_tbc.smdp.faults import reset_or_name
from sb3_tbc.smdp.goal_test import RewardComparison
from sb3_tbc.smdp.guard import OnBadStep
from sb3_tbc.smdp.hierarchical_vec_env import HierarchicalStep, HierarchicalVecEnv, Proposal
from sb3_tbc.smdp.hindsight import (
    GoalTest,
    HighLevelSteps,
    HindsightSettings,
    high_level_steps,
    low_level_steps,
)
from sb3_tbc.smdp.options import Episode, OptionRules
from sb3_tbc.smdp.rewards import HighLevelReward, LowLevelReward
from sb3_tbc.smdp.spaces import GoalObservation
from sb3_tbc.smdp.views import LevelViews
from sb3_tbc.tbc_hrl.policy import TBCPolicy

T = TypeVar("T")


class Exploration(NamedTuple):
    """How both levels act while they learn."""

    random_fraction: float  # share of uniformly random actions on each level
    testing_fraction: float  # share of options that test their subgoal
    deterministic_testing: bool  # whether the low level acts deterministically in a test


class TwoLevelRunner:
    """Both levels at work in a vector of goal environments, step by step.

    :param venv: the environments
    :param policy: both levels
    :param rng: source of all randomness here
    :param deterministic: act as in an evaluation
    :param on_bad_step: what follows where an environment gives what is not finite
    """

    def __init__(
        self,
        venv: VecEnv,
        policy: TBCPolicy,
        rng: np.random.Generator,
        deterministic: bool = False,
        on_bad_step: OnBadStep = "stop",
    ) -> None:
        actor = policy.actor
        self.actor, self.rng, self.deterministic = actor, rng, deterministic
        self.env = HierarchicalVecEnv(
            venv, self.propose, policy.views, policy.rules, actor.low.state_dim, policy.schedule,
            actor.reconsideration, on_bad_step,
        )  # fmt: skip
        self.membrane = actor.blank(venv.num_envs)
        self.observation: FloatArray = np.zeros(0)  # the low level's

    def reset(self) -> None:
        """Begin new episodes."""
        self.begin(reset_or_name(self.env.venv))  # type: ignore[arg-type]

    def begin(self, observation: GoalObservation) -> None:
        """Begin episodes in environments that were just reset; weights that were changed by hand hold from now on.

        :param observation: what the environments show
        """
        self.actor.notice_changes()
        self.membrane = self.actor.blank(self.env.num_envs)
        self.observation = self.env.begin(observation)

    def step(self) -> HierarchicalStep:
        """One step of every environment."""
        before = self.membrane
        unit, after = self.act()
        step = self.env.advance(unit, before, self.actor.carried(after))
        self.observation = step.observations
        self.membrane = self.actor.forget(after, step.window_over, step.episode_over)
        return step

    def run(self, n_episodes: int, read: Callable[[Episode], T]) -> list[T]:
        """Run whole episodes from new starts, ordered by round, then environment.

        Every environment runs the same number of them (rounded up, the surplus is left out), so that short episodes
        are not over-represented.

        :param read: what to keep of an episode
        """
        self.reset()
        found: list[list[T]] = [[] for _ in range(self.env.num_envs)]
        per_env = -(-n_episodes // self.env.num_envs)
        while min(len(rows) for rows in found) < per_env:
            for index, episode in self.step().episodes.items():
                found[index].append(read(episode))
        return [rows[i] for i in range(per_env) for rows in found][:n_episodes]

    def propose(self, observations: FloatArray, where: Indices) -> Proposal:
        """The high level's options for the environments ``where``."""
        unit = self.actor.propose(observations, self.deterministic, self.rng)
        return Proposal(unit, np.zeros(len(where), dtype=bool))

    def act(self) -> tuple[FloatArray, FloatArray]:
        """The low level's unit actions for every environment, and its memory after them."""
        return self.actor.act(self.observation, self.membrane, self.deterministic, self.rng)


class Collector(TwoLevelRunner):
    """Both levels exploring.

    :param exploration: see :class:`Exploration`

    Other parameters are :class:`TwoLevelRunner`'s.
    """

    def __init__(
        self,
        venv: VecEnv,
        policy: TBCPolicy,
        rng: np.random.Generator,
        exploration: Exploration,
        on_bad_step: OnBadStep = "stop",
    ) -> None:
        super().__init__(venv, policy, rng, on_bad_step=on_bad_step)
        self.exploration = exploration

    def get_state(self) -> Arrays:
        """Live options, running episodes and memory, as plain arrays."""
        return {**self.env.get_state(), "membrane": self.membrane, "observation": self.observation}

    def set_state(self, state: Mapping[str, AnyArray], observation: GoalObservation) -> bool:
        """Restore what :meth:`get_state` gave; False if the environments' observations do not belong to it.

        :param observation: what the environments show now
        """
        seen = self.env.set_state(state, observation)
        self.membrane, self.observation = state["membrane"].astype(np.float32), seen
        return np.array_equal(seen, state["observation"])

    def propose(self, observations: FloatArray, where: Indices) -> Proposal:
        """The exploring high level: mostly SAC samples, sometimes uniform, some of them tests."""
        unit = self.actor.propose(observations, False, self.rng)
        self._randomise(unit)
        return Proposal(unit, self.rng.random(len(where)) < self.exploration.testing_fraction)

    def act(self) -> tuple[FloatArray, FloatArray]:
        """The exploring low level: mostly SAC samples, sometimes uniform; the means in tests, if asked for."""
        tested = self.env.clock.testing if self.exploration.deterministic_testing else False
        unit, after = self.actor.act(self.observation, self.membrane, tested, self.rng)
        self._randomise(unit, tested)
        return unit, after

    def _randomise(self, unit: FloatArray, spared: bool | BoolArray = False) -> None:
        """Replace a share of the actions by uniform ones, in place; not those of a mask ``(n,)``."""
        uniform = self.rng.random(len(unit)) < self.exploration.random_fraction
        if not np.count_nonzero(uniform):
            return
        if spared is not False:
            uniform &= np.logical_not(spared)
        drawn = self.rng.uniform(-1.0, 1.0, (np.count_nonzero(uniform), unit.shape[1]))
        unit[uniform] = drawn.astype(np.float32)  # as a level's own actions


class EpisodeStore:
    """Turns finished episodes into transitions of both levels, hindsight included.

    :param replay: where they go
    :param reward: the high level's reward and discount
    :param low_reward: the low level's reward
    :param hindsight: how much of it
    :param rng: draws hindsight goals and times
    """

    def __init__(
        self,
        replay: Replay,
        views: LevelViews,
        rules: OptionRules,
        reward: HighLevelReward,
        low_reward: LowLevelReward,
        hindsight: HindsightSettings,
        rng: np.random.Generator,
    ) -> None:
        self.replay, self.views, self.rules = replay, views, rules
        self.reward, self.low_reward, self.hindsight, self.rng = reward, low_reward, hindsight, rng
        self._compare = RewardComparison()

    def add(self, episode: Episode, goal_test: GoalTest, progress: float = 0.0) -> HighLevelSteps:
        """Store an episode; what the high level learns from it.

        :param progress: share of the training that is done
        """
        self._compare(goal_test, episode.achieved_goal[1:], episode.desired_goal[1:], episode.rewards)
        self.replay.low.extend(low_level_steps(episode, self.low_reward))
        hindsight = self.hindsight.after(progress)
        steps = high_level_steps(episode, self.views, self.rules, self.reward, hindsight, goal_test, self.rng)
        self.replay.high.extend(steps.first(self.replay.high.buffer_size))  # cuts come last; a small buffer holds some
        return steps
