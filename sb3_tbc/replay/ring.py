"""Preallocated float32 rings of rows that give whole bursts of batches at once."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np
import torch as th
from stable_baselines3.common.buffers import BaseBuffer
from stable_baselines3.common.type_aliases import ReplayBufferSamples
from stable_baselines3.common.vec_env import VecNormalize

from sb3_tbc.aliases import Space
from sb3_tbc.arrays import AnyArray, Arrays, Float32, Indices, IntArray
from sb3_tbc.replay.batch import LevelBatch


class RingBuffer(BaseBuffer):
    """A ring of rows. A row's quantities lie side by side: a draw reads one place of the memory, not a dozen.

    The memory is reserved at once; the system assigns it as rows are written. SB3's ``SAC.train`` can sample from it
    as from any replay buffer; :meth:`sample_burst` is the fast way.

    :param buffer_size: rows to keep; the oldest are overwritten
    :param observation_space: flat observations of the level
    :param action_space: its unit actions
    :param widths: entries of each quantity of a row, by name
    :param device: of the samples
    :param seed: seed of the sampling
    """

    def __init__(
        self,
        buffer_size: int,
        observation_space: Space,
        action_space: Space,
        widths: Mapping[str, int],
        device: th.device | str = "cpu",
        seed: int | None = None,
    ) -> None:
        super().__init__(buffer_size, observation_space, action_space, device, n_envs=1)
        self.rng = np.random.default_rng(seed)
        ends = np.cumsum(list(widths.values())).tolist()
        self._columns = {name: slice(end - widths[name], end) for name, end in zip(widths, ends, strict=True)}
        self._table = np.zeros((buffer_size, ends[-1]), dtype=np.float32)

    @property
    def data(self) -> dict[str, Float32]:
        """Views of all rows, by quantity."""
        return self._split(self._table)

    def _split(self, rows: Float32) -> dict[str, Float32]:
        """Views of whole rows ``(n, .)``, one per quantity."""
        return {name: rows[:, columns] for name, columns in self._columns.items()}

    def _take(self, at: IntArray) -> dict[str, Float32]:
        """Copies of rows, by quantity."""
        return self._split(self._table.take(at, axis=0))

    def size(self) -> int:
        """Number of rows stored."""
        return self.buffer_size if self.full else self.pos

    def add(self, *args: object, **kwargs: object) -> None:
        """Refused: rows come in whole episodes.

        :raises TypeError: always, naming the method to use
        """
        raise TypeError(f"{type(self).__name__} takes whole episodes: use extend(rows)")

    def _extend(self, rows: Mapping[str, AnyArray]) -> None:
        count = len(next(iter(rows.values())))
        if count > self.buffer_size:
            raise ValueError(
                f"an episode of {count} rows does not fit a buffer of {self.buffer_size}; raise buffer_size"
            )
        parts = [np.asarray(rows[name]).reshape(count, c.stop - c.start) for name, c in self._columns.items()]
        block = np.concatenate(parts, axis=1, dtype=np.float32)
        first = min(count, self.buffer_size - self.pos)  # rows before the ring's end
        self._table[self.pos : self.pos + first] = block[:first]
        self._table[: count - first] = block[first:]
        self.full = self.full or self.pos + count >= self.buffer_size
        self.pos = (self.pos + count) % self.buffer_size

    def sample_burst(self, gradient_steps: int, batch_size: int) -> LevelBatch:
        """Independent uniform batches for ``gradient_steps`` updates, tensors ``(gradient_steps, batch_size, .)``."""
        flat = self._rows(self.rng.integers(0, self.size(), gradient_steps * batch_size))
        return LevelBatch(*(th.from_numpy(part).view(gradient_steps, batch_size, -1).to(self.device) for part in flat))

    def sample(self, batch_size: int, env: VecNormalize | None = None) -> ReplayBufferSamples:
        """One batch in SB3's form."""
        return self._get_samples(self.rng.integers(0, self.size(), batch_size))

    def _get_samples(self, batch_inds: Indices, env: VecNormalize | None = None) -> ReplayBufferSamples:
        parts = LevelBatch(*(th.from_numpy(part).to(self.device) for part in self._rows(batch_inds)))
        return ReplayBufferSamples(
            parts.observations, parts.actions, parts.next_observations, parts.dones, parts.rewards, parts.discounts
        )

    def _rows(self, at: IntArray) -> tuple[Float32, ...]:
        raise NotImplementedError

    def get_state(self) -> Arrays:
        """The stored rows and the position, as plain arrays."""
        held = {name: array[: self.size()] for name, array in self.data.items()}
        return {**held, "pos": np.array(self.pos), "full": np.array(self.full)}

    def set_state(self, state: Mapping[str, AnyArray]) -> None:
        """Load rows saved by :meth:`get_state`.

        :raises ValueError: if they have other quantities or widths than this buffer
        """
        for name, array in self.data.items():
            if name not in state or state[name].shape[1:] != array.shape[1:]:
                got = state[name].shape if name in state else "nothing"
                raise ValueError(f"saved replay buffer does not fit: {name} has width {array.shape[1]}, got {got}")
        rows = len(state[next(iter(self.data))])
        if rows > self.buffer_size:
            raise ValueError(f"saved replay buffer has {rows} rows, this one has room for {self.buffer_size}")
        self.full = rows == self.buffer_size  # what was not full may fill a smaller buffer
        self.pos = int(state["pos"]) % self.buffer_size if self.full else rows
        # what was a full ring begins at its oldest row in a larger buffer, so that windows lie in one piece again
        oldest = int(state["pos"]) if state["full"] and not self.full else 0
        for name, array in self.data.items():
            array[:rows] = np.roll(state[name], -oldest, axis=0)
