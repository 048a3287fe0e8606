"""Replay of the flat baseline: SB3's hindsight buffer for tasks that end on success, which can be wound back."""

from __future__ import annotations

from typing import Any

import numpy as np
import torch as th
from stable_baselines3 import HerReplayBuffer
from stable_baselines3.common.type_aliases import DictReplayBufferSamples
from stable_baselines3.common.vec_env import VecNormalize

from sb3_tbc.aliases import Plain
from sb3_tbc.arrays import AnyArray, Arrays
from sb3_tbc.smdp.goal_spaces import GOAL_KEYS
from sb3_tbc.smdp.goal_test import RewardComparison, goal_test_of
from sb3_tbc.smdp.shapes import BAD_STEP
from sb3_tbc.tbc_hrl.environment import attribute_of

ARRAYS = ("actions", "rewards", "dones", "timeouts", "ep_start", "ep_length")
"""What SB3's hindsight buffer holds besides observations, each ``(buffer_size, n_envs, ...)``."""


class TerminatingHerReplayBuffer(HerReplayBuffer):
    """SB3's hindsight replay for tasks that end on success: a relabelled transition that meets its goal is terminal.

    So is one that ended its episode in failure, as a fall does. SB3 keeps the flag that was stored, under which the
    value of standing on a relabelled goal never stops to grow. A transition that keeps its goal keeps its reward, too.

    :param event_goals: take the goal from the step of the task's event (:attr:`SubgoalSpace.event`) for all transitions
        of an episode in which it happened, and leave those of the others as they are
    :param kwargs: see SB3
    """

    def __init__(self, *args: Any, event_goals: bool = False, **kwargs: Any) -> None:
        super().__init__(*args, **kwargs)
        self.event_goals = event_goals
        self._compare = RewardComparison()

    def _sample_goals(self, batch_indices: AnyArray, env_indices: AnyArray) -> AnyArray:
        if not self.event_goals or self.env is None:
            return super()._sample_goals(batch_indices, env_indices)
        event = attribute_of(self.env, "subgoals").event
        starts, lengths = (a[batch_indices, env_indices, None] for a in (self.ep_start, self.ep_length))
        ahead = np.arange(lengths.max())
        rows = (starts + ahead) % self.buffer_size
        happened = (self.next_observations["observation"][rows, env_indices[:, None], event] > 0.5) & (ahead < lengths)
        first = rows[np.arange(len(rows)), happened.argmax(axis=1)]
        goals: AnyArray = np.where(
            happened.any(axis=1, keepdims=True),
            self.next_observations["achieved_goal"][first, env_indices],
            self.observations["desired_goal"][batch_indices, env_indices],
        )
        return goals

    def _get_virtual_samples(
        self, batch_indices: AnyArray, env_indices: AnyArray, env: VecNormalize | None = None
    ) -> DictReplayBufferSamples:
        samples = super()._get_virtual_samples(batch_indices, env_indices, env)
        if self.env is None:
            raise ValueError("hindsight replay needs the environment's goal test; pass env when loading")
        reached = samples.next_observations["achieved_goal"].cpu().numpy()
        wanted = samples.observations["desired_goal"].cpu().numpy()
        ended = np.flatnonzero(samples.dones.cpu().numpy())
        given = self.observations["desired_goal"][batch_indices, env_indices]
        pairs = np.concatenate([reached, reached[ended]]), np.concatenate([wanted, given[ended]])
        met, met_first = np.split(goal_test_of(self.env).terminated(*pairs), [len(reached)])
        met[ended] |= ~met_first  # a failure ends with any goal
        dones = met.astype(np.float32)
        same = np.flatnonzero((wanted == given).all(axis=1))  # the task's own reward may pay for more than the goal
        rewards = samples.rewards.clone()
        rewards[same] = self.to_torch(self.rewards[batch_indices[same], env_indices[same]].reshape(-1, 1))
        return samples._replace(dones=th.from_numpy(dones).reshape(-1, 1).to(self.device), rewards=rewards)

    def add(
        self,
        obs: Any,
        next_obs: Any,
        action: AnyArray,
        reward: AnyArray,
        done: AnyArray,
        infos: list[Plain],
    ) -> None:
        """Store a step of every environment, see SB3; a bad one ends its episode with the step before.

        All environments share a row. That of a bad step belongs to no episode, so that it is never sampled.
        """
        bad = [index for index, info in enumerate(infos) if BAD_STEP in info]
        for index in bad:
            if self._current_ep_start[index] != self.pos:
                self.dones[self.pos - 1, index] = self.timeouts[self.pos - 1, index] = True
                self._compute_episode_length(index)
        if bad:
            done = np.array(done)
            done[bad] = False
        super().add(obs, next_obs, action, reward, done, infos)
        self._current_ep_start[bad] = self.pos

    def _compute_episode_length(self, env_idx: int) -> None:
        """Note a finished episode, see SB3, which takes one that just fills the buffer for an empty one."""
        start = int(self._current_ep_start[env_idx])
        fills = start == self.pos
        rows = (start + np.arange((self.pos - start - 1) % self.buffer_size + 1)) % self.buffer_size
        if self.env is not None:
            achieved, desired = (self.next_observations[key][rows, env_idx] for key in GOAL_KEYS[1:])
            self._compare(goal_test_of(self.env), achieved, desired, self.rewards[rows, env_idx])
        super()._compute_episode_length(env_idx)
        if fills:
            self.ep_length[:, env_idx] = self.buffer_size

    def parts(self) -> Arrays:
        """All that is stored, by name: views of whole arrays, ``(buffer_size, n_envs, ...)``."""
        held: Arrays = {name: getattr(self, name) for name in ARRAYS}
        for part in ("observations", "next_observations"):
            held |= {f"{part}.{key}": array for key, array in getattr(self, part).items()}
        return held

    def take_over(self, saved: Arrays) -> None:
        """Hold what another buffer held, and nothing else.

        :param saved: rows of its :meth:`parts` that were written, and its ``pos``, ``full`` and ``_start``, the rows
            ``(n_envs,)`` in which the running episodes began
        :raises ValueError: if it was of other spaces or environments, or larger
        """
        rows = len(saved["actions"])
        for name, held in self.parts().items():
            if len(saved[name]) != rows or rows > len(held) or held.shape[1:] != saved[name].shape[1:]:
                raise ValueError(f"saved replay buffer does not fit: {name} has shape {saved[name].shape}")
        pos, start = int(saved["pos"]), np.asarray(saved["_start"])
        running = np.where(start > pos, pos - start + rows, pos - start)
        # Rows are counted modulo the size: in a larger buffer, what was a full ring begins at its oldest row.
        shift = pos if saved["full"] and rows < self.buffer_size else 0
        for name, held in self.parts().items():
            held[:rows] = np.roll(saved[name], -shift, axis=0)
        self.ep_start[:rows] = (self.ep_start[:rows] - shift) % max(rows, 1)
        self.ep_length[rows:] = 0
        self.full = rows == self.buffer_size
        self.pos = (pos if self.full else rows) % self.buffer_size
        self._current_ep_start[:] = (self.pos - running) % self.buffer_size

    def steps(self) -> AnyArray:
        """Steps of the running episodes so far, ``(n_envs,)``."""
        return np.asarray((self.pos - self._current_ep_start) % self.buffer_size)


class Rewind:
    """Puts a buffer back to where it is now, after so many further steps at most.

    :param buffer: to be put back
    :param steps: rows that may be written before that
    """

    def __init__(self, buffer: TerminatingHerReplayBuffer, steps: int) -> None:
        self._buffer = buffer
        self._place = buffer.pos, buffer.full, buffer._current_ep_start.copy()
        written = np.arange(buffer.pos - 1, buffer.pos + steps) % buffer.buffer_size  # and the end of a cut episode
        self._rows = written, {name: array[written].copy() for name, array in buffer.parts().items()}
        self._lengths = buffer.ep_length[: buffer.buffer_size if buffer.full else buffer.pos].copy()

    def __call__(self) -> None:
        """Put it back."""
        buffer, (written, rows) = self._buffer, self._rows
        buffer.pos, buffer.full, buffer._current_ep_start = self._place[0], self._place[1], self._place[2].copy()
        for name, array in buffer.parts().items():
            array[written] = rows[name]
        buffer.ep_length[: len(self._lengths)] = self._lengths
