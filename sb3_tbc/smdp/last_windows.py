"""Tells environments when the last window of their episode ends, so that they end the episode with it."""

from __future__ import annotations

import math
from collections.abc import Container, Iterable

from stable_baselines3.common.vec_env import VecEnv

from sb3_tbc.smdp.episode_limit import LastWindow, announce
from sb3_tbc.smdp.options import OptionClock


class LastWindows:
    """The windows with which running episodes use up the high level's decisions.

    :param venv: the environments, with :func:`.with_episode_limit`
    :param clock: their windows
    :param task_can_tell: whether an environment sees itself that its window ends before its time, see :func:`.can_tell`
    """

    def __init__(self, venv: VecEnv, clock: OptionClock, task_can_tell: bool) -> None:
        self._venv, self._clock, self._subgoals = venv, clock, clock.subgoals
        self._event_ends = task_can_tell and clock.subgoals.event is not None
        self._reaching_ends = task_can_tell and clock.rules.ends_when_reached
        self._end: dict[int, int] = {}  # step of the window that is its last, by environment
        self._know_subgoal: set[int] = set()  # environments that end their episode when it is reached

    def note(self, where: Iterable[int]) -> None:
        """Find the last windows among those that have begun in the environments ``where``."""
        is_last = self._clock.is_last
        for index in map(int, where):
            self._end.pop(index, None)
            self._know_subgoal.discard(index)
            if is_last[index]:
                self._end[index] = max(1, math.ceil(self._clock.time_budget[index]))
                if self._event_ends:
                    announce(self._venv, index, LastWindow(False, self._subgoals))

    def end_next_step(self, index: int) -> None:
        """End an episode with the next step: its last window was over before its time, which the task did not see."""
        self._end[index] = 0

    def announce(self, live: Container[int]) -> None:
        """Tell the environments whose last window ends, or may end, with the next step.

        :param live: the environments that will take this step
        """
        for index, end in self._end.items():
            if index not in live:
                continue
            step = self._clock.elapsed[index] + 1
            if step >= end:
                announce(self._venv, index, LastWindow(True))
            elif self._reaching_ends and step >= self._clock.rules.dt_min and index not in self._know_subgoal:
                self._know_subgoal.add(index)
                subgoal = self._clock.subgoal[index].copy()
                announce(self._venv, index, LastWindow(False, self._subgoals, subgoal))
