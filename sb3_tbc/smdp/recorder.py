"""Grows one array per quantity and environment while an episode runs, so that learning gets whole episodes."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np

from sb3_tbc.arrays import AnyArray, Arrays, BoolArray, FloatArray, Indices, IntArray
from sb3_tbc.smdp.options import Episode, Option, TerminationReason
from sb3_tbc.smdp.spaces import GoalObservation

REASONS = tuple(TerminationReason)

FIRST_ROWS = 1025
"""Rows to make room for at first; grows by doubling."""

Place = tuple[Indices | slice, IntArray | int]
"""Index of rows in arrays ``(n_envs, steps, .)``: environments, and the step of each."""


class EpisodeRecorder:
    """Records the running episode of each environment of a vector.

    :param n_envs: number of environments
    :param sizes: width of each recorded quantity: the fields of :class:`~sb3_tbc.smdp.options.Episode` by name
    """

    _exact = ("achieved_goal", "desired_goal")

    def __init__(self, n_envs: int, sizes: dict[str, int]) -> None:
        self.n_envs = n_envs
        self.steps = np.zeros(n_envs, dtype=np.int64)
        self.options: list[list[Option]] = [[] for _ in range(n_envs)]
        self._all = np.arange(n_envs)
        self._data = {
            name: np.zeros((n_envs, FIRST_ROWS, size), dtype=np.float64 if name in self._exact else np.float32)
            for name, size in sizes.items()
        }
        self._rewards = np.zeros((n_envs, FIRST_ROWS))

    def begin(self, indices: Indices, observation: GoalObservation) -> None:
        """Start new episodes; the arrays have one row per entry of ``indices``."""
        self.steps[indices] = 0
        for index in indices:
            self.options[index] = []
        self._write((indices, self.steps[indices]), observation)

    def before_step(self, actions: FloatArray, states: FloatArray, next_states: FloatArray) -> None:
        """Record what the low level is about to do in every environment, and its memory before and after."""
        at = self._now()
        if int(self.steps.max()) + 1 >= self._rewards.shape[1]:
            self._grow()
        self._data["actions"][at] = actions
        if states.shape[1]:
            self._data["states"][at] = states
            self._data["next_states"][at] = next_states

    def after_step(self, rewards: FloatArray, observation: GoalObservation, taken: BoolArray | bool = True) -> None:
        """Record what the step led to in every environment, before any automatic reset.

        :param taken: where the step counts, ``(n_envs,)``; elsewhere ``observation`` is the one before it
        """
        self._rewards[self._now()] = rewards
        self.steps += taken
        self._write(self._now(), observation)

    def finish(self, index: int, terminated: bool, success: bool, budget_exhausted: bool = False) -> Episode:
        """The episode that has just ended in environment ``index``, as arrays of its own."""
        length = int(self.steps[index])
        seen = {n: self._data[n][index, : length + 1].copy() for n in ("observation", *self._exact)}
        done = {n: self._data[n][index, :length].copy() for n in ("actions", "states", "next_states")}
        return Episode(
            **seen,
            **done,
            rewards=self._rewards[index, :length].copy(),
            options=tuple(self.options[index]),
            terminated=terminated,
            success=success,
            budget_exhausted=budget_exhausted,
        )

    def get_state(self) -> Arrays:
        """What was recorded of the running episodes, as plain arrays."""
        rows = int(self.steps.max()) + 1
        held = {name: array[:, :rows].copy() for name, array in self._data.items()}
        options = [
            [index, o.start, o.duration, o.time_budget, o.testing, o.reached, REASONS.index(o.reason), *o.unit_action,
             *o.subgoal]
            for index, begun in enumerate(self.options) for o in begun
        ]  # fmt: skip
        packed = np.array(options, dtype=np.float64).reshape(len(options), -1 if options else 0)
        return {**held, "steps": self.steps.copy(), "rewards": self._rewards[:, :rows].copy(), "options": packed}

    def set_state(self, state: Mapping[str, AnyArray]) -> None:
        """Restore what :meth:`get_state` gave."""
        self.steps[:] = state["steps"]
        rows = state["rewards"].shape[1]
        while self._rewards.shape[1] < rows:
            self._grow()
        self._rewards[:, :rows] = state["rewards"]
        for name, array in self._data.items():
            array[:, :rows] = state[name]
        self.options = [[] for _ in range(self.n_envs)]
        for index, start, duration, budget, testing, reached, reason, *rest in state["options"].tolist():
            n = len(rest) // 2 + 1  # the unit action has the time budget besides the subgoal
            action, subgoal = np.array(rest[:n]), np.array(rest[n:])
            self.options[int(index)].append(
                Option(
                    int(start), int(duration), action, subgoal, budget, bool(testing), bool(reached),
                    REASONS[int(reason)],
                )
            )  # fmt: skip

    def _now(self) -> Place:
        """Index of every environment's present row; a slice where there is one, which is several times as fast."""
        return (self._all if self.n_envs > 1 else slice(None), self.steps if self.n_envs > 1 else int(self.steps[0]))

    def _write(self, at: Place, observation: GoalObservation) -> None:
        for name in ("observation", *self._exact):
            self._data[name][at] = observation[name]

    def _grow(self) -> None:
        for name, array in self._data.items():
            self._data[name] = np.concatenate([array, np.zeros_like(array)], axis=1)
        self._rewards = np.concatenate([self._rewards, np.zeros_like(self._rewards)], axis=1)
