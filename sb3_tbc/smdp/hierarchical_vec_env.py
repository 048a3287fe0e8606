"""The two levels meet here: a vector of goal environments becomes the low level's problem."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import NamedTuple

import numpy as np
from stable_baselines3.common.preprocessing import get_action_dim
from stable_baselines3.common.vec_env import VecEnv
from stable_baselines3.common.vec_env.base_vec_env import VecEnvStepReturn

from sb3_tbc.aliases import Plain
from sb3_tbc.arrays import AnyArray, Arrays, BoolArray, FloatArray, Indices, put_under, taken_from
from sb3_tbc.errors import HierarchyError
from sb3_tbc.smdp.copyable import CopyableVecEnvWrapper
from sb3_tbc.smdp.episode_limit import BUDGET_EXHAUSTED, can_tell, with_episode_limit
from sb3_tbc.smdp.faults import reset_or_name
from sb3_tbc.smdp.goal_spaces import GOAL_KEYS, UnitActions, check_goal_space, rows_of, width
from sb3_tbc.smdp.goal_test import EpisodeJudge
from sb3_tbc.smdp.guard import Guard, OnBadStep
from sb3_tbc.smdp.last_windows import LastWindows
from sb3_tbc.smdp.options import Episode, OptionClock, OptionRules, TerminationReason
from sb3_tbc.smdp.recorder import EpisodeRecorder
from sb3_tbc.smdp.spaces import GoalObservation
from sb3_tbc.smdp.views import LevelViews


class Proposal(NamedTuple):
    """What the high level answers when asked for options: one row per environment that needs one."""

    unit_actions: FloatArray  # (n, subgoal_dim + 1) in [-1, 1]: subgoal, then time budget unless a schedule gives it
    testing: BoolArray  # (n,), whether the option is a subgoal test


HighLevel = Callable[[FloatArray, Indices], Proposal]
"""Maps high-level observations ``(n, high_dim)`` of the environments ``(n,)`` to their next options."""

GivesUp = Callable[[GoalObservation, OptionClock], BoolArray]
"""Which windows the high level ends before their time, ``(n_envs,)``, at goal observations of all environments."""

Schedule = Callable[[FloatArray, GoalObservation], FloatArray]
"""Appends unit time budgets to unit subgoals ``(n, subgoal_dim)`` chosen at goal observations."""


class HierarchicalStep(NamedTuple):
    """What one step of every environment led to."""

    observations: FloatArray  # (n_envs, low_dim), the low level's, of the next options where windows ended
    window_over: BoolArray  # (n_envs,)
    actions: AnyArray  # (n_envs, action_dim), in the task's units
    task_observations: GoalObservation  # the task's, after automatic resets
    task_rewards: FloatArray  # (n_envs,), the task's
    episode_over: BoolArray  # (n_envs,)
    infos: list[Plain]  # the task's; "option" where a window ended
    rewards: FloatArray  # (n_envs,), the low level's: 1 where a window ended with its subgoal reached
    episodes: dict[int, Episode]  # those that ended, by environment


class HierarchicalVecEnv(CopyableVecEnvWrapper):
    """Runs timed windows over a vector of goal environments and shows the low level's problem.

    An observation is ``(local state, subgoal, remaining time)``, a reward is 1 when a window ends with its subgoal
    reached and else 0, and a done flag is the end of a *window*. When windows end, the high level is asked for the
    next options of just those environments; the others do not wait. :meth:`advance` also tells what both levels learn
    from: whole episodes. For SB3's algorithms it is an ordinary ``VecEnv``, see :meth:`step_wait`.

    :param venv: goal environments; automatic resets as in SB3
    :param high_level: proposes options; may be set later through the attribute of the same name
    :param views: what each level sees
    :param rules: what ends an option
    :param state_dim: width of the low level's memory to record with each step
    :param schedule: gives the time budgets where the high level does not
    :param gives_up: which windows the high level ends before their time; None: none of them
    :param on_bad_step: what follows where an environment gives what is not finite, or of another shape: ``stop``, or
        ``end-episode`` with the step before
    :raises ValueError: if the environments are not goal environments or their actions not a Box
    """

    def __init__(
        self,
        venv: VecEnv,
        high_level: HighLevel | None,
        views: LevelViews,
        rules: OptionRules,
        state_dim: int = 0,
        schedule: Schedule | None = None,
        gives_up: GivesUp | None = None,
        on_bad_step: OnBadStep = "stop",
    ) -> None:
        space = check_goal_space(venv.observation_space, venv.action_space)
        venv = with_episode_limit(venv)
        super().__init__(venv, observation_space=views.low_space(), action_space=venv.action_space)
        self.high_level, self.views, self.rules, self.schedule = high_level, views, rules, schedule
        self.clock = OptionClock(venv.num_envs, views.subgoals, rules)
        self.unit = UnitActions(self.action_space)  # type: ignore[arg-type]
        self.gives_up = gives_up
        self._everywhere = np.arange(venv.num_envs)
        self._no_memory = np.zeros((venv.num_envs, state_dim), dtype=np.float32)
        sizes = {key: width(space, key) for key in GOAL_KEYS}
        sizes |= {"actions": get_action_dim(venv.action_space), "states": state_dim, "next_states": state_dim}
        self._recorder = EpisodeRecorder(venv.num_envs, sizes)
        ends_early = rules.ends_when_reached or views.subgoals.event is not None
        self._last_windows = LastWindows(venv, self.clock, ends_early and can_tell(venv))
        self.judge = EpisodeJudge(venv)
        self.guard = Guard(venv, on_bad_step)
        self._started = False
        self._held: dict[int, Arrays] = {}  # what a last window led to of which the task hears a step late
        self._given: AnyArray = np.zeros(0)  # what step_async was given

    def reset(self) -> FloatArray:
        """Reset every environment and ask for its first option."""
        return self.begin(reset_or_name(self.venv))  # type: ignore[arg-type]

    def begin(self, observation: GoalObservation) -> FloatArray:
        """Ask for the first options of environments that were just reset.

        :param observation: what the environments show
        :return: what the low level sees
        """
        self._recorder.steps[:] = 0
        self._held.clear()
        self.guard.begin(observation)
        self._begin_episodes(self._everywhere, observation)
        self._begin_options(self._everywhere, observation)
        self._started = True
        return self._low_observation(observation)

    def get_state(self) -> Arrays:
        """Live options and running episodes, as plain arrays; the environments themselves are not among them."""
        clock = {name: getattr(self.clock, name).copy() for name in self.clock.fields}
        return put_under("recorder", self._recorder.get_state()) | put_under("clock", clock)

    def set_state(self, state: Mapping[str, AnyArray], observation: GoalObservation) -> FloatArray:
        """Restore what :meth:`get_state` gave.

        :param observation: what the environments show now
        :return: what the low level sees
        """
        self._recorder.set_state(taken_from("recorder", state))
        for name, array in taken_from("clock", state).items():
            getattr(self.clock, name)[:] = array
        self._last_windows.note(self._everywhere)
        self._hold(self.clock.ended(observation) & (self.clock.elapsed > 0) & self.clock.is_last, observation)
        self.guard.go_on(observation)
        self._started = True
        return self._low_observation(observation)

    def advance(
        self, unit_actions: FloatArray, states: FloatArray | None = None, next_states: FloatArray | None = None
    ) -> HierarchicalStep:
        """Advance every environment by one step; close and replace the options that end with it.

        :param unit_actions: ``(n_envs, action_dim)`` in [-1, 1]
        :param states: the low level's memory before the step, ``(n_envs, state_dim)``, to be recorded with it
        :param next_states: and after it
        :raises HierarchyError: before the first reset
        """
        return self._advance(self.unit.unscale(unit_actions), unit_actions, states, next_states)

    def step_async(self, actions: AnyArray) -> None:
        """Step with actions in the environment's units, as SB3 does it."""
        self._given = actions

    def step_wait(self) -> VecEnvStepReturn:
        """The low level's problem in SB3's form, for any algorithm.

        ``info["terminal_observation"]`` is what the low level saw at the end of a window, and
        ``info["TimeLimit.truncated"]`` says that the window was cut off, so that its end is not the problem's.
        """
        step = self._advance(self._given, self.unit.scale(self._given), None, None, for_low_level=True)
        return step.observations, step.rewards, step.window_over, step.infos

    def _advance(
        self,
        actions: AnyArray,
        unit: FloatArray,
        states: FloatArray | None,
        next_states: FloatArray | None,
        for_low_level: bool = False,
    ) -> HierarchicalStep:
        if not self._started:
            raise HierarchyError("HierarchicalVecEnv.step was called before reset")
        self._last_windows.announce(range(self.num_envs))
        no_memory = self._no_memory
        self._recorder.before_step(
            unit, no_memory if states is None else states, no_memory if next_states is None else next_states
        )
        observation, task_rewards, dones, infos, seen, bad = self.guard.step(actions, self._recorder.steps)
        taken = ~bad  # a bad step did not happen: what it led to is not known
        if self._held:
            taken &= ~self._take_back(task_rewards, infos, seen)
        self._recorder.after_step(task_rewards, seen, taken)
        self.clock.tick(taken)
        over = self._windows_over(seen, dones)
        rewards, episodes = np.zeros(self.num_envs, dtype=np.float32), {}
        if np.count_nonzero(over):  # several times as fast as any() on so few
            where = np.flatnonzero(over)
            rewards[where] = self._close_options(where, seen, dones, infos)
            last = self._low_observation(seen) if for_low_level else None
            episodes = self._next_options(where, observation, dones, infos)
            if last is not None:
                _tell_low_level(where, last, infos)
        low = self._low_observation(observation)
        return HierarchicalStep(low, over, actions, observation, task_rewards, dones, infos, rewards, episodes)

    def _windows_over(self, seen: GoalObservation, dones: BoolArray) -> BoolArray:
        """Which windows end with this step, ``(n_envs,)``.

        The last window of an episode was announced to the task, which ends the episode with it. Where wrappers change
        what the task sees, this may be a step late; that step is then taken back.
        """
        if self.gives_up is not None:
            self.clock.give_up(self.gives_up(seen, self.clock))
        over = self.clock.ended(seen) | dones
        if not np.count_nonzero(over):
            return over
        late = over & ~dones & self.clock.is_last
        if np.count_nonzero(late):
            self._hold(late, seen)
            over &= ~late
        return over

    def _hold(self, late: BoolArray, seen: GoalObservation) -> None:
        """Keep what last windows led to, and have their episodes ended with the next step."""
        for index in map(int, np.flatnonzero(late)):
            self._last_windows.end_next_step(index)
            self._held[index] = {key: np.array(part[index]) for key, part in seen.items()}

    def _take_back(self, rewards: FloatArray, infos: list[Plain], seen: GoalObservation) -> BoolArray:
        """Undo the steps, in place, by which tasks heard that their last window was over; in which environments."""
        extra = np.zeros(self.num_envs, dtype=bool)
        for index, last in self._held.items():
            extra[index], rewards[index] = True, 0.0
            for key, part in last.items():
                seen[key][index] = part
            infos[index] |= {"terminal_observation": last, "TimeLimit.truncated": True, BUDGET_EXHAUSTED: True}
            infos[index]["is_success"] = False  # what was reached in that step is too late
        self._held.clear()
        return extra

    def _close_options(self, where: Indices, seen: GoalObservation, dones: BoolArray, infos: list[Plain]) -> FloatArray:
        """Record the options that end; the low level's reward of each."""
        reached = self.clock.reached(rows_of(seen, where), where)
        rewards = np.zeros(len(where), dtype=np.float32)
        for row, index in enumerate(where):
            if not self.clock.elapsed[index]:  # its first step was bad
                continue
            step = int(self._recorder.steps[index])
            cut_off = bool(dones[index]) and not _used_up(infos[index])
            option = self.clock.close(index, step, bool(reached[row]), cut_off)
            self._recorder.options[index].append(option)
            infos[index]["option"] = option.as_info()
            rewards[row] = float(option.reached)
        return rewards

    def _next_options(
        self, where: Indices, observation: GoalObservation, dones: BoolArray, infos: list[Plain]
    ) -> dict[int, Episode]:
        """Finish episodes and begin options."""
        over = where[dones[where]]
        told = [int(index) for index in over if self._recorder.steps[index]]
        episodes = {index: self._finish_episode(index, infos[index]) for index in told}
        if len(over):
            self._begin_episodes(over, rows_of(observation, over))
        self._begin_options(where, observation)
        return episodes

    def _finish_episode(self, index: int, info: Plain) -> Episode:
        truncated, exhausted = info.get("TimeLimit.truncated", False), _used_up(info)
        success = info["is_success"] = self.judge.succeeded(info)
        return self._recorder.finish(index, not truncated, success and not exhausted, exhausted)

    def _begin_episodes(self, where: Indices, observation: GoalObservation) -> None:
        self.clock.begin_episode(where)
        self._recorder.begin(where, observation)

    def _begin_options(self, where: Indices, observation: GoalObservation) -> None:
        if self.high_level is None:
            raise HierarchyError("HierarchicalVecEnv needs a high level that proposes options: set .high_level")
        seen = rows_of(observation, where)
        proposal = self.high_level(self.views.high(seen), where)
        unit = proposal.unit_actions if self.schedule is None else self.schedule(proposal.unit_actions, seen)
        self.clock.begin(where, unit, proposal.testing)
        self._last_windows.note(where)

    def _low_observation(self, observation: GoalObservation) -> FloatArray:
        return self.views.low(observation, self.clock.subgoal, self.clock.remaining)


def _used_up(info: Plain) -> bool:
    """Whether the episode ended with the last window it may have; a wrapper may end it with success in that step."""
    return bool(info.get("TimeLimit.truncated", False) and info.get(BUDGET_EXHAUSTED, False))


CUT_OFF = tuple(
    reason.value for reason in (TerminationReason.EPISODE_END, TerminationReason.EVENT, TerminationReason.RECONSIDERED)
)


def _tell_low_level(where: Indices, last: FloatArray, infos: list[Plain]) -> None:
    """Record in ``infos`` how windows ended, in the form in which SB3's algorithms expect the ends of episodes."""
    for index in where:
        cut = "option" not in infos[index] or infos[index]["option"]["reason"] in CUT_OFF
        infos[index] |= {"terminal_observation": last[index], "TimeLimit.truncated": cut}
