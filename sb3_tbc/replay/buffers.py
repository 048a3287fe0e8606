"""Replay buffers of the two levels."""

from __future__ import annotations

from collections.abc import Callable
from typing import NamedTuple

import numpy as np
import torch as th
from gymnasium import spaces

from sb3_tbc.arrays import BoolArray, Float32, FloatArray, IntArray
from sb3_tbc.errors import HierarchyError
from sb3_tbc.replay.batch import LevelBatch
from sb3_tbc.replay.ring import RingBuffer
from sb3_tbc.smdp.hindsight import HighLevelSteps, LowLevelSteps, ordered_pairs
from sb3_tbc.smdp.options import OptionRules
from sb3_tbc.smdp.rewards import LowLevelReward
from sb3_tbc.smdp.spaces import SubgoalSpace
from sb3_tbc.smdp.views import LevelViews

Teacher = Callable[[Float32, Float32, Float32], Float32]
"""Maps high-level observations, local states and subgoal-space points to unit time budgets to imitate, ``(n,)``."""

HINDSIGHT_SUBGOALS = ("timed", "future", "episode")


class ReachPairs(NamedTuple):
    """Visited states and points visited later in the same episode."""

    local: Float32  # (n, local_dim), what the low level saw
    here: Float32  # (n, subgoal_dim), where it was
    goal: Float32  # (n, subgoal_dim), where it was later
    steps: Float32  # (n,), how many steps later it first was there


class OptionReplayBuffer(RingBuffer):
    """The high level's SMDP transitions; ``discounts`` carries each one's own discount, which SB3 reads per sample.

    :param buffer_size: transitions to keep; the oldest are overwritten
    :param observation_space: flat observations of the high level
    :param action_space: its unit actions: the subgoal, and the time budget where the level chooses it
    :param device: of the samples
    :param seed: seed of the sampling
    :param context: also keep what a teacher of time budgets needs of each option's first state
    :param teacher: gives the labels of :meth:`sample_labelled`; it reads what ``context`` keeps
    """

    def __init__(
        self,
        buffer_size: int,
        observation_space: spaces.Box,
        action_space: spaces.Box,
        device: th.device | str = "cpu",
        seed: int | None = None,
        context: SubgoalSpace | None = None,
        teacher: Teacher | None = None,
    ) -> None:
        observation, action = observation_space.shape[0], action_space.shape[0]
        widths = {
            "observations": observation,
            "actions": action,
            "next_observations": observation,
            "rewards": 1,
            "dones": 1,
            "discounts": 1,
        }
        if context is not None:
            widths |= {"local": context.local_dim, "here": context.dim}
        super().__init__(buffer_size, observation_space, action_space, widths, device, seed)
        self.teacher = teacher

    def extend(self, steps: HighLevelSteps) -> None:
        """Add the transitions of an episode; the time budget is left out where the level does not choose it."""
        rows = {name: getattr(steps, name) for name in self.data}
        self._extend({**rows, "actions": steps.actions[:, : self.action_dim]})

    def sample_labelled(self, gradient_steps: int, batch_size: int) -> tuple[LevelBatch, th.Tensor]:
        """As :meth:`sample_burst`, with the teacher's unit time budgets ``(gradient_steps, batch_size, 1)``.

        :raises HierarchyError: without a teacher
        """
        if self.teacher is None:
            raise HierarchyError("labelled samples need a teacher: pass teacher= to the replay buffer")
        at = self.rng.integers(0, self.size(), gradient_steps * batch_size)
        taken = self._take(at)
        labels = self.teacher(*(taken[name] for name in ("observations", "local", "here")))
        parts = [*self._batch(taken), np.asarray(labels, dtype=np.float32)]
        shape = (gradient_steps, batch_size, -1)
        *batch, labels_ = (th.from_numpy(part).view(shape).to(self.device) for part in parts)
        return LevelBatch(*batch), labels_

    def _rows(self, at: IntArray) -> tuple[Float32, ...]:
        return self._batch(self._take(at))

    @staticmethod
    def _batch(taken: dict[str, Float32]) -> tuple[Float32, ...]:
        no_state = np.zeros((len(taken["rewards"]), 0), dtype=np.float32)
        return (*(taken[name] for name in LevelBatch._fields[:6]), no_state, no_state, no_state)


class SubgoalReplayBuffer(RingBuffer):
    """The low level's transitions, with hindsight subgoals drawn when sampling. Nothing is stored twice.

    Of the samples, a share ``n / (n + 1)`` is relabelled. ``"timed"`` (HiTS): a step and a later-or-equal step of the
    same window are drawn uniformly, the point reached at the later one becomes the subgoal, and the remaining time is
    what was left until then (less a uniform fraction of a step, as time budgets are real-valued). ``"future"`` and
    ``"episode"`` (HAC, which has no time): the point reached at a strictly later step of the window, or at any of
    its steps; where fewer than n are there to draw from, the share falls accordingly.

    :param buffer_size: environment steps to keep; the oldest are overwritten
    :param observation_space: flat observations of the low level
    :param action_space: its unit actions
    :param views: what the low level sees, and the subgoal space
    :param rules: what ends a window
    :param state_dim: membrane potentials kept with each step; 0 for an actor without memory
    :param gamma: discount per environment step
    :param n_hindsight_goals: n above, relabelled samples per plain one
    :param device: of the samples
    :param seed: seed of the sampling
    :param reward: the low level's reward, by default the sparse one
    :param hindsight: ``"timed"``, ``"future"`` or ``"episode"``
    :param sequence_length: with more than 1, samples hold up to ``sequence_length - 1`` earlier steps of their window,
        under the sampled subgoal, and the memory before the first of these
    :param reach_pairs: keep what :meth:`sample_pairs` needs
    :raises ValueError: if ``hindsight`` is unknown or ``sequence_length`` not positive, or more than 1 without memory
    """

    def __init__(
        self,
        buffer_size: int,
        observation_space: spaces.Box,
        action_space: spaces.Box,
        views: LevelViews,
        rules: OptionRules,
        state_dim: int,
        gamma: float,
        n_hindsight_goals: float,
        device: th.device | str = "cpu",
        seed: int | None = None,
        reward: LowLevelReward | None = None,
        hindsight: str = "timed",
        sequence_length: int = 1,
        reach_pairs: bool = False,
    ) -> None:
        if hindsight not in HINDSIGHT_SUBGOALS:
            raise ValueError(f"hindsight must be one of {', '.join(HINDSIGHT_SUBGOALS)}, got {hindsight!r}")
        if sequence_length < 1:
            raise ValueError(f"sequence_length must be at least 1 (no burn-in), got {sequence_length}")
        if sequence_length > 1 and not state_dim:
            raise ValueError(
                f"sequence_length={sequence_length} unrolls the low level's memory, but it has none: use "
                "sequence_length=1, or a circuit (low.policy_kwargs.ndbc)"
            )
        subgoals = views.subgoals
        widths = {
            "local": subgoals.local_dim,
            "next_local": subgoals.local_dim,
            "actions": action_space.shape[0],
            "states": state_dim,
            "next_states": state_dim,
            "subgoal": subgoals.dim,
            "here": subgoals.dim,
            "achieved": subgoals.dim,
            "time_left": 1,
            "position": 1,
            "length": 1,
            "rewards": 1,
            "dones": 1,
        }
        if reach_pairs:
            widths["to_end"] = 1
        super().__init__(buffer_size, observation_space, action_space, widths, device, seed)
        self.views, self.rules, self.gamma = views, rules, gamma
        self.reward = reward or LowLevelReward("sparse", subgoals, rules)
        self.hindsight, self.n_hindsight_goals, self.sequence_length = hindsight, n_hindsight_goals, sequence_length

    def extend(self, steps: LowLevelSteps) -> None:
        """Add the transitions of an episode, in the order they happened."""
        rows = steps._asdict()
        if "to_end" in self.data:
            rows["to_end"] = np.arange(len(steps.rewards), 0, -1)
        self._extend(rows)

    def sample_pairs(self, n: int, horizon: int, rng: np.random.Generator) -> ReachPairs:
        """Uniformly drawn steps, and a uniformly drawn one of the up to ``horizon`` points reached from there on.

        The label is the step at which that point was first reached, within the subgoal's thresholds: if a path returns
        to a point, the later visits do not tell how far away it is.

        :param n: number of pairs
        :param horizon: environment steps
        :param rng: random numbers of this draw alone, so that it does not change how transitions are sampled
        """
        data = self.data
        at = rng.integers(0, self.size(), n)
        # how many rows were written after it, itself included: the ring's oldest rows follow its newest ones
        written = self.buffer_size - (at - self.pos) % self.buffer_size if self.full else self.pos - at
        ahead = np.minimum(data["to_end"][at, 0].astype(np.int64), written)
        steps = rng.integers(0, np.minimum(ahead, horizon)) + 1
        goal = data["achieved"][(at + steps - 1) % self.buffer_size]
        way = data["achieved"][(at[:, None] + np.arange(steps.max())) % self.buffer_size]
        first = self.views.subgoals.reached(way, goal[:, None]).argmax(axis=1) + 1  # the goal itself is on the way
        return ReachPairs(data["local"][at], data["here"][at], goal, first.astype(np.float32))

    def _rows(self, at: IntArray) -> tuple[Float32, ...]:
        at, taken = self._with_hindsight(at)
        subgoal, time_left, rewards = (taken[name] for name in ("subgoal", "time_left", "rewards"))
        scale = np.float32(1.0 / self.rules.dt_max)
        now, later = (np.clip(t * scale, 0.0, 1.0) for t in (time_left, time_left - 1.0))
        return (
            self.views.low_from(taken["local"], taken["here"], subgoal, now),
            taken["actions"],
            self.views.low_from(taken["next_local"], taken["achieved"], subgoal, later),
            rewards,
            taken["dones"],
            np.full_like(rewards, self.gamma),
            *self._memory(at, taken),
        )

    def _with_hindsight(self, at: IntArray) -> tuple[IntArray, dict[str, Float32]]:
        """The rows to sample, and what they hold: a share of them with subgoal, time, reward and end of hindsight."""
        at, where, second = self._timed(at) if self.hindsight == "timed" else self._untimed(at)
        taken = self._take(at)
        taken["subgoal"][where] = self.data["achieved"][second]
        if self.hindsight == "timed":
            ahead = (second - at[where]) % self.buffer_size
            early = self.rng.random(len(where), dtype=np.float32)
            taken["time_left"][where, 0] = ahead + 1 - (0.0 if self.rules.whole_budgets else early)
        here, achieved, subgoal = (taken[name][where] for name in ("here", "achieved", "subgoal"))
        may_end = taken["position"][where, 0] + 1 >= self.rules.dt_min
        rewards, dones = self._relabelled(here, achieved, subgoal, second == at[where], may_end)
        taken["rewards"][where, 0], taken["dones"][where, 0] = rewards, dones
        return at, taken

    def _timed(self, at: IntArray) -> tuple[IntArray, IntArray, IntArray]:
        """Rows to sample, which of them are relabelled, and the rows whose outcome becomes their subgoal."""
        share = self.n_hindsight_goals / (self.n_hindsight_goals + 1.0)
        where = np.flatnonzero(self.rng.random(len(at)) < share)
        position, length = (self.data[name][at[where], 0].astype(np.int64) for name in ("position", "length"))
        first, second = ordered_pairs(length, self.rng)
        begin = at[where] - position
        # rows of a window may have been overwritten by newer ones or lie across the ring's end: keep those as they are
        whole = self._intact(begin, length)
        where, first, second, begin = where[whole], first[whole], second[whole], begin[whole]
        at = at.copy()
        at[where] = (begin + first) % self.buffer_size
        return at, where, (begin + second) % self.buffer_size

    def _untimed(self, at: IntArray) -> tuple[IntArray, IntArray, IntArray]:
        """The same for goals without time: the rows stay, only their subgoals are drawn."""
        position, length = (self.data[name][at, 0].astype(np.int64) for name in ("position", "length"))
        begin = at - position
        start = position + 1 if self.hindsight == "future" else np.zeros_like(position)
        copies = np.minimum(self.n_hindsight_goals, length - start)
        chosen = (self.rng.random(len(at)) < copies / (copies + 1.0)) & self._intact(begin, length)
        where = np.flatnonzero(chosen)
        second = self.rng.integers(start[where], length[where])
        return at, where, (begin[where] + second) % self.buffer_size

    def _relabelled(
        self,
        here: Float32,
        achieved: Float32,
        subgoal: Float32,
        expired: BoolArray,
        may_end: BoolArray,
    ) -> tuple[FloatArray, BoolArray]:
        """Rewards and ends of relabelled steps."""
        if self.reward.kind == "sparse" and not self.rules.ends_when_reached:
            return expired.astype(np.float32), expired  # the point reached at the end is the subgoal
        return self.reward.rewards_and_ends(here, achieved, subgoal, expired, may_end)

    def _memory(self, at: IntArray, taken: dict[str, Float32]) -> tuple[Float32, Float32, Float32]:
        """Memory before and after the sampled steps, and the steps before them, as :class:`.LevelBatch` has these.

        :param taken: the sampled rows, with the subgoals and times that they are relabelled with
        """
        width = self.sequence_length - 1, 1 + self.views.low_space().shape[0]
        earlier = np.zeros((len(at), *width), dtype=np.float32)
        position, length = (taken[name][:, 0].astype(np.int64) for name in ("position", "length"))
        back = np.minimum(position, self.sequence_length - 1)
        back[~self._intact(at - position, length)] = 0
        for column, steps in enumerate(range(self.sequence_length - 1, 0, -1)):
            rows = np.flatnonzero(back >= steps)
            before = (at[rows] - steps) % self.buffer_size
            left = np.clip((taken["time_left"][rows] + steps) / np.float32(self.rules.dt_max), 0.0, 1.0)
            local, here = self.data["local"][before], self.data["here"][before]
            earlier[rows, column, 0] = 1.0
            earlier[rows, column, 1:] = self.views.low_from(local, here, taken["subgoal"][rows], left)
        states = self.data["states"][(at - back) % self.buffer_size]
        return states, taken["next_states"], earlier.reshape(len(at), -1)

    def _intact(self, begin: IntArray, length: IntArray) -> BoolArray:
        """Which windows still have all their rows; the one at the write position is partly overwritten.

        :param begin: their first rows; below 0 where a window ran across the end of a ring, or its first rows were
            overwritten before what is left of it was loaded into a larger one
        """
        if not self.full:
            return np.asarray(begin >= 0)
        offset = (begin - self.pos) % self.buffer_size  # rows between the oldest row and the window's first
        return np.asarray(offset + length <= self.buffer_size)
