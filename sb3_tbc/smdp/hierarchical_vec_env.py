"""The two levels meet here: a vector of goal environments becomes the low level's problem."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import Any, NamedTuple

import numpy as np
from gymnasium import spaces
from numpy.typing import NDArray
from stable_baselines3.common.vec_env import VecEnv, VecEnvWrapper
from stable_baselines3.common.vec_env.base_vec_env import VecEnvStepReturn

from sb3_tbc.errors import HierarchyError
from sb3_tbc.smdp.options import Episode, OptionClock, OptionRules
from sb3_tbc.smdp.recorder import EpisodeRecorder
from sb3_tbc.smdp.spaces import FloatArray, GoalObservation
from sb3_tbc.smdp.views import GOAL_KEYS, LevelLayout, check_goal_space, width


class Proposal(NamedTuple):
    """What the high level answers when asked for options: one row per environment that needs one."""

    unit_actions: FloatArray  # (n, subgoal_dim + 1) in [-1, 1]: subgoal, then time budget unless a schedule gives it
    testing: NDArray[np.bool_]  # (n,), whether the option is a subgoal test


HighLevel = Callable[[FloatArray, NDArray[np.intp]], Proposal]
"""Maps high-level observations ``(n, high_dim)`` of the environments ``(n,)`` to their next options."""

Schedule = Callable[[FloatArray, GoalObservation], FloatArray]
"""Appends unit time budgets to unit subgoals ``(n, subgoal_dim)`` chosen at goal observations."""


class HierarchicalVecEnv(VecEnvWrapper):
    """Runs timed windows over a vector of goal environments and shows the low level's problem.

    An observation is ``(local state, subgoal, remaining time)``, a reward is 1 when a window ends with its subgoal
    reached and else 0, and a done flag is the end of a *window*. When windows end, the high level is asked for the
    next options of just those environments; the others do not wait. Finished episodes wait in :attr:`episodes`.

    :param venv: goal environments; automatic resets as in SB3
    :param high_level: proposes options; may be set later through the attribute of the same name
    :param layout: how the levels' observations are put together
    :param rules: what ends an option
    :param state_dim: width of the low level's memory to record with each step
    :param schedule: gives the time budgets where the high level does not
    :raises ValueError: if the environments are not goal environments or their actions not a Box
    """

    def __init__(
        self,
        venv: VecEnv,
        high_level: HighLevel | None,
        layout: LevelLayout,
        rules: OptionRules,
        state_dim: int = 0,
        schedule: Schedule | None = None,
    ) -> None:
        space = check_goal_space(venv.observation_space)
        super().__init__(venv, observation_space=layout.low_space(), action_space=venv.action_space)
        self.high_level = high_level
        self.layout = layout
        self.rules = rules
        self.schedule = schedule
        self.clock = OptionClock(venv.num_envs, layout.subgoals.dim, rules)
        self.episodes: list[Episode] = []
        self._everywhere = np.arange(venv.num_envs)
        self._no_memory = np.zeros((venv.num_envs, state_dim), dtype=np.float32)
        self._memory = (self._no_memory, self._no_memory)
        self._recorder = EpisodeRecorder(venv.num_envs, self._sizes(space, state_dim))
        low, high = self.action_space.low, self.action_space.high  # type: ignore[attr-defined]
        self._centre, self._half = 0.5 * (low + high), 0.5 * (high - low)
        self._started = False

    def _sizes(self, space: spaces.Dict, state_dim: int) -> dict[str, int]:
        sizes = {key: width(space, key) for key in GOAL_KEYS}
        actions = self.action_space.shape
        if not isinstance(self.action_space, spaces.Box) or actions is None or len(actions) != 1:
            raise ValueError(
                f"a hierarchical agent needs a Box action space with one dimension, got {self.action_space}"
            )
        return {
            **sizes,
            "actions": actions[0],
            "states": state_dim,
            "next_states": state_dim,
        }

    def reset(self) -> FloatArray:
        """Reset every environment and ask for its first option."""
        observation: GoalObservation = self.venv.reset()  # type: ignore[assignment]
        self._begin_episodes(self._everywhere, observation)
        self._begin_options(self._everywhere, observation)
        self._started = True
        return self._low_observation(observation)

    def get_state(self) -> dict[str, NDArray[Any]]:
        """Live options and running episodes, as plain arrays; the environments themselves are not among them."""
        recorded = {f"recorder.{name}": array for name, array in self._recorder.get_state().items()}
        return {**recorded, **{f"clock.{name}": getattr(self.clock, name).copy() for name in self.clock.fields}}

    def set_state(self, state: Mapping[str, NDArray[Any]], observation: GoalObservation) -> FloatArray:
        """Take over what :meth:`get_state` gave, and go on from there.

        :param observation: what the environments show now
        :return: what the low level sees
        """
        parts = {name.partition("."): array for name, array in state.items()}
        self._recorder.set_state({name: x for (owner, _, name), x in parts.items() if owner == "recorder"})
        for (owner, _, name), array in parts.items():
            if owner == "clock":
                getattr(self.clock, name)[:] = array
        self.episodes = []
        self._started = True
        return self._low_observation(observation)

    def remember(self, states: FloatArray, next_states: FloatArray) -> None:
        """Membrane potentials before and after the coming step, ``(n_envs, state_dim)``, to be recorded with it."""
        self._memory = (states, next_states)

    def unscale(self, unit_actions: FloatArray) -> FloatArray:
        """The environments' actions for unit ones."""
        actions: FloatArray = self._centre + self._half * unit_actions
        return actions

    def step_async(self, actions: NDArray[Any]) -> None:
        """Step with actions in the environment's units.

        :raises HierarchyError: before the first reset
        """
        if not self._started:
            raise HierarchyError("HierarchicalVecEnv.step was called before reset")
        self._recorder.before_step((actions - self._centre) / self._half, *self._memory)
        self.venv.step_async(actions)

    def step_wait(self) -> VecEnvStepReturn:
        """Advance every environment by one step; close and replace the options that end with it."""
        observation, rewards, dones, infos = self.venv.step_wait()
        seen = self._before_reset(observation, dones, infos)  # type: ignore[arg-type]
        self._recorder.after_step(rewards, seen)
        self.clock.tick()
        reached, ended = self._window_ends(seen, dones)
        low_rewards = np.zeros(self.num_envs, dtype=np.float32)
        if np.count_nonzero(ended):  # several times as fast as any() on so few
            where = np.flatnonzero(ended)
            low_rewards[where] = self._close_options(where, seen, reached, dones, infos)
            self._next_options(where, observation, dones, infos)  # type: ignore[arg-type]
        return self._low_observation(observation), low_rewards, ended, infos  # type: ignore[arg-type]

    def _before_reset(
        self, observation: GoalObservation, dones: NDArray[np.bool_], infos: list[dict[str, Any]]
    ) -> GoalObservation:
        """What the step led to: SB3 hides the last observation of an episode in ``info``."""
        if not np.count_nonzero(dones):
            return observation
        seen = {key: np.array(observation[key]) for key in GOAL_KEYS}
        for index in np.flatnonzero(dones):
            for key in GOAL_KEYS:
                seen[key][index] = infos[index]["terminal_observation"][key]
        return seen

    def _window_ends(
        self, seen: GoalObservation, dones: NDArray[np.bool_]
    ) -> tuple[NDArray[np.bool_] | None, NDArray[np.bool_]]:
        """Which subgoals are reached (``None``: not looked at, no window can end by it) and which windows end."""
        ended = self.clock.expired | dones
        if self.layout.subgoals.event is not None:
            ended |= self.layout.subgoals.happened(seen)
        if self.rules.window_end == "timed":
            return None, ended
        reached = self.layout.subgoals.reached(self.layout.subgoals.achieved(seen), self.clock.subgoal)
        early = reached & (self.clock.elapsed >= self.rules.dt_min)
        return reached, ended | early

    def _close_options(
        self,
        where: NDArray[np.intp],
        seen: GoalObservation,
        reached: NDArray[np.bool_] | None,
        dones: NDArray[np.bool_],
        infos: list[dict[str, Any]],
    ) -> FloatArray:
        """Record the options that end; the low level's reward of each."""
        subgoals, here = self.layout.subgoals, {key: seen[key][where] for key in GOAL_KEYS}
        if reached is None:
            reached_here = subgoals.reached(subgoals.achieved(here), self.clock.subgoal[where])
        else:
            reached_here = reached[where]
        event = subgoals.happened(here)
        rewards = np.zeros(len(where), dtype=np.float32)
        for row, index in enumerate(where):
            step = int(self._recorder.steps[index])
            option = self.clock.close(index, step, bool(reached_here[row]), bool(dones[index]), bool(event[row]))
            self._recorder.options[index].append(option)
            infos[index]["option"] = option.as_info()
            rewards[row] = float(option.reached)
        return rewards

    def _next_options(
        self,
        where: NDArray[np.intp],
        observation: dict[str, FloatArray],
        dones: NDArray[np.bool_],
        infos: list[dict[str, Any]],
    ) -> None:
        """Finish episodes and begin options; enforced resets change ``observation`` in place."""
        over = where[dones[where] | (self.clock.used[where] >= self.rules.max_options)]
        for index in over:
            self._finish_episode(index, observation, bool(dones[index]), infos[index])
        if len(over):
            self._begin_episodes(over, {key: observation[key][over] for key in GOAL_KEYS})
        self._begin_options(where, observation)

    def _finish_episode(self, index: int, observation: dict[str, FloatArray], done: bool, info: dict[str, Any]) -> None:
        truncated = bool(info.get("TimeLimit.truncated", False)) or not done
        success = bool(info.get("is_success", False)) and done
        episode = self._recorder.finish(index, terminated=not truncated, success=success)
        self.episodes.append(episode)
        info["episode_over"] = True
        info["budget_exhausted"] = not done
        if not done:  # the environment itself would go on: end the episode for it
            info["terminal_observation"] = {key: np.array(observation[key][index]) for key in GOAL_KEYS}
            info["TimeLimit.truncated"] = True
            info["episode"] = {"r": float(episode.rewards.sum()), "l": episode.length, "t": 0.0}
            fresh, _ = self.venv.env_method("reset", indices=[int(index)])[0]
            for key in GOAL_KEYS:
                observation[key][index] = fresh[key]

    def _begin_episodes(self, where: NDArray[np.intp], observation: GoalObservation) -> None:
        self.clock.begin_episode(where)
        self._recorder.begin(where, observation)

    def _begin_options(self, where: NDArray[np.intp], observation: GoalObservation) -> None:
        if self.high_level is None:
            raise HierarchyError("HierarchicalVecEnv needs a high level that proposes options: set .high_level")
        seen = {key: observation[key][where] for key in GOAL_KEYS}
        proposal = self.high_level(self.layout.high(seen), where)
        unit = proposal.unit_actions if self.schedule is None else self.schedule(proposal.unit_actions, seen)
        self.clock.begin(where, unit, self.layout.subgoals.unscale(unit[:, :-1]), proposal.testing)

    def _low_observation(self, observation: GoalObservation) -> FloatArray:
        remaining = self.rules.remaining(self.clock.time_left)
        return self.layout.low(observation, self.clock.subgoal, remaining)
