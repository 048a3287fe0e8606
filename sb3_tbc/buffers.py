"""Replay buffers of the two levels: preallocated float32 rings that give whole bursts of batches at once."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np
import torch as th
from gymnasium import spaces
from numpy.typing import NDArray
from stable_baselines3.common.buffers import BaseBuffer
from stable_baselines3.common.type_aliases import ReplayBufferSamples
from stable_baselines3.common.vec_env import VecNormalize

from sb3_tbc.hindsight import HighLevelSteps, LowLevelSteps, ordered_pairs
from sb3_tbc.layout import LevelLayout
from sb3_tbc.options import OptionRules
from sb3_tbc.type_aliases import LevelBatch

Float32 = NDArray[np.float32]


class RingBuffer(BaseBuffer):
    """A ring of rows, one array per quantity, that grows up to ``buffer_size`` as it fills.

    SB3's ``SAC.train`` can sample from it as from any replay buffer; :meth:`sample_burst` is the fast way.

    :param buffer_size: rows to keep; the oldest are overwritten
    :param seed: seed of the sampling
    """

    def __init__(
        self,
        buffer_size: int,
        observation_space: spaces.Space[Any],
        action_space: spaces.Space[Any],
        widths: Mapping[str, int],
        device: th.device | str = "cpu",
        seed: int | None = None,
    ) -> None:
        super().__init__(buffer_size, observation_space, action_space, device, n_envs=1)
        self.rng = np.random.default_rng(seed)
        self.data = {name: np.zeros((0, width), dtype=np.float32) for name, width in widths.items()}

    def size(self) -> int:
        """Number of rows stored."""
        return self.buffer_size if self.full else self.pos

    def add(self, *args: Any, **kwargs: Any) -> None:
        """Refused: rows come in whole episodes.

        :raises TypeError: always, naming the method to use
        """
        raise TypeError(f"{type(self).__name__} takes whole episodes: use extend(rows)")

    def _extend(self, rows: Mapping[str, NDArray[Any]]) -> None:
        count = len(next(iter(rows.values())))
        if count > self.buffer_size:
            raise ValueError(
                f"an episode of {count} rows does not fit a buffer of {self.buffer_size}; raise buffer_size"
            )
        self._reserve(min(self.pos + count, self.buffer_size))
        at = (self.pos + np.arange(count)) % self.buffer_size
        for name, array in self.data.items():
            array[at] = np.asarray(rows[name], dtype=np.float32).reshape(count, array.shape[1])
        self.full = self.full or self.pos + count >= self.buffer_size
        self.pos = (self.pos + count) % self.buffer_size

    def _reserve(self, rows: int) -> None:
        held = len(next(iter(self.data.values())))
        if rows > held:
            room = min(max(rows, 2 * held, 4096), self.buffer_size)
            for name, array in self.data.items():
                grown = np.zeros((room, array.shape[1]), dtype=np.float32)
                grown[:held] = array
                self.data[name] = grown

    def sample_burst(self, gradient_steps: int, batch_size: int) -> LevelBatch:
        """Independent uniform batches for ``gradient_steps`` updates, tensors ``(gradient_steps, batch_size, .)``."""
        flat = self._rows(self.rng.integers(0, self.size(), gradient_steps * batch_size))
        return LevelBatch(*(th.from_numpy(part).view(gradient_steps, batch_size, -1).to(self.device) for part in flat))

    def sample(self, batch_size: int, env: VecNormalize | None = None) -> ReplayBufferSamples:
        """One batch in SB3's form."""
        batch = LevelBatch(*(part[0] for part in self.sample_burst(1, batch_size)))
        return ReplayBufferSamples(
            batch.observations, batch.actions, batch.next_observations, batch.dones, batch.rewards, batch.discounts
        )

    def _get_samples(self, batch_inds: NDArray[np.intp], env: VecNormalize | None = None) -> ReplayBufferSamples:
        parts = LevelBatch(*(th.from_numpy(part).to(self.device) for part in self._rows(batch_inds)))
        return ReplayBufferSamples(
            parts.observations, parts.actions, parts.next_observations, parts.dones, parts.rewards, parts.discounts
        )

    def _rows(self, at: NDArray[np.int64]) -> tuple[Float32, ...]:
        raise NotImplementedError

    def get_state(self) -> dict[str, NDArray[Any]]:
        """The stored rows and the position, as plain arrays."""
        held = {name: array[: self.size()] for name, array in self.data.items()}
        return {**held, "pos": np.array(self.pos), "full": np.array(self.full)}

    def set_state(self, state: Mapping[str, NDArray[Any]]) -> None:
        """Take over rows saved by :meth:`get_state`.

        :raises ValueError: if they have other quantities or widths than this buffer
        """
        for name, array in self.data.items():
            if name not in state or state[name].shape[1:] != array.shape[1:]:
                got = state[name].shape if name in state else "nothing"
                raise ValueError(f"saved replay buffer does not fit: {name} has width {array.shape[1]}, got {got}")
        rows = len(state[next(iter(self.data))])
        if rows > self.buffer_size:
            raise ValueError(f"saved replay buffer has {rows} rows, this one has room for {self.buffer_size}")
        self._reserve(rows)
        for name, array in self.data.items():
            array[:rows] = state[name]
        self.full = bool(state["full"]) and rows == self.buffer_size
        self.pos = int(state["pos"]) if rows == self.buffer_size else rows % self.buffer_size


class OptionReplayBuffer(RingBuffer):
    """The high level's SMDP transitions; ``discounts`` carries ``gamma ** duration`` (SB3 reads it per sample)."""

    def __init__(
        self,
        buffer_size: int,
        observation_space: spaces.Box,
        action_space: spaces.Box,
        device: th.device | str = "cpu",
        seed: int | None = None,
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
        super().__init__(buffer_size, observation_space, action_space, widths, device, seed)

    def extend(self, steps: HighLevelSteps) -> None:
        """Add the transitions of an episode."""
        self._extend({name: getattr(steps, name) for name in self.data})

    def _rows(self, at: NDArray[np.int64]) -> tuple[Float32, ...]:
        no_state = np.zeros((len(at), 0), dtype=np.float32)
        return (*(array[at] for array in self.data.values()), no_state, no_state)


class SubgoalReplayBuffer(RingBuffer):
    """The low level's transitions with timed hindsight subgoals drawn when sampling (HiTS: ``future``).

    Of the samples, a share ``n / (n + 1)`` is relabelled: a step and a later-or-equal step of the same window are
    drawn uniformly, the point reached at the later one becomes the subgoal, and the remaining time is what was left
    until then (less a uniform fraction of a step, as time budgets are real-valued). Nothing is stored twice.

    :param gamma: discount per environment step
    :param n_hindsight_goals: n above, relabelled samples per plain one
    """

    def __init__(
        self,
        buffer_size: int,
        observation_space: spaces.Box,
        action_space: spaces.Box,
        layout: LevelLayout,
        rules: OptionRules,
        state_dim: int,
        gamma: float,
        n_hindsight_goals: float,
        device: th.device | str = "cpu",
        seed: int | None = None,
    ) -> None:
        subgoals = layout.subgoals
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
        super().__init__(buffer_size, observation_space, action_space, widths, device, seed)
        self.layout, self.rules, self.gamma = layout, rules, gamma
        self.relabelled_share = n_hindsight_goals / (n_hindsight_goals + 1.0)

    def extend(self, steps: LowLevelSteps) -> None:
        """Add the transitions of an episode, in the order they happened."""
        self._extend(steps._asdict())

    def _rows(self, at: NDArray[np.int64]) -> tuple[Float32, ...]:
        data = self.data
        hindsight = self.rng.random(len(at)) < self.relabelled_share
        where = np.flatnonzero(hindsight)
        position, length = (data[name][at[where], 0].astype(np.int64) for name in ("position", "length"))
        first, second = ordered_pairs(length, self.rng)
        begin = at[where] - position
        # rows of a window may have been overwritten by newer ones or lie across the ring's end: keep those as they are
        whole = self._intact(begin, length)
        where, first, second, begin = where[whole], first[whole], second[whole], begin[whole]
        at = at.copy()
        at[where] = (begin + first) % self.buffer_size
        subgoal, time_left = data["subgoal"][at], data["time_left"][at]
        rewards, dones = data["rewards"][at], data["dones"][at]
        subgoal[where] = data["achieved"][(begin + second) % self.buffer_size]
        time_left[where, 0] = second - first + 1 - self.rng.random(len(where), dtype=np.float32)
        expired = (second == first)[:, None]
        if self.rules.window_end == "reached":
            reached = self.layout.subgoals.reached(data["achieved"][at[where]], subgoal[where])[:, None]
            rewards[where], dones[where] = reached, reached | expired
        else:
            rewards[where] = dones[where] = expired
        scale = np.float32(1.0 / self.rules.dt_max)
        now, later = (np.clip(t * scale, 0.0, 1.0) for t in (time_left, time_left - 1.0))
        return (
            self.layout.low_from(data["local"][at], data["here"][at], subgoal, now),
            data["actions"][at],
            self.layout.low_from(data["next_local"][at], data["achieved"][at], subgoal, later),
            rewards,
            dones,
            np.full_like(rewards, self.gamma),
            data["states"][at],
            data["next_states"][at],
        )

    def _intact(self, begin: NDArray[np.int64], length: NDArray[np.int64]) -> NDArray[np.bool_]:
        """Which windows still have all their rows: the one being overwritten at the write position has not."""
        if not self.full:
            return np.ones(len(begin), dtype=bool)
        offset = (begin - self.pos) % self.buffer_size  # rows between the oldest row and the window's first
        return np.asarray(offset + length <= self.buffer_size)
