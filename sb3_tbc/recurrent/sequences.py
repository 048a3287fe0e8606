"""Replay of sequences: pieces of episodes through which a memory is unrolled."""

from __future__ import annotations

import io
import pathlib
from typing import Any, NamedTuple

import numpy as np
import torch as th
from gymnasium import spaces
from stable_baselines3.common.buffers import ReplayBuffer
from stable_baselines3.common.type_aliases import ReplayBufferSamples
from stable_baselines3.common.vec_env import VecNormalize

from sb3_tbc.aliases import Space
from sb3_tbc.arrays import AnyArray, BoolArray, Float32
from sb3_tbc.errors import ConfigError, NonFiniteError
from sb3_tbc.files import write_arrays
from sb3_tbc.reading import read_arrays


class Sequences(NamedTuple):
    """What a network with memory sees in place of a batch of observations."""

    inputs: th.Tensor  # (n_sequences, time, n_inputs), observation and the action before it
    starts: th.Tensor  # (n_sequences, time), whether an episode begins with a step
    kept: th.Tensor  # (n_sequences, time), the steps that are learnt from; the others warm the memory up
    later: th.Tensor | None = None  # (n_kept, n_inputs): one more step from each of them, where the next state is meant


def flat_space(space: Space) -> spaces.Box:
    """The space of one flat vector that holds all of an observation.

    :raises ConfigError: if observations are no vectors
    """
    parts = space.spaces.values() if isinstance(space, spaces.Dict) else [space]
    boxes = [part for part in parts if isinstance(part, spaces.Box) and part.dtype != np.uint8]
    if not boxes or len(boxes) < len(list(parts)):
        raise ConfigError(
            f"NDBCSAC observes a Box of numbers or a Dict of them, neither images nor discrete values, got {space}"
        )
    low, high = (np.concatenate([getattr(box, end).ravel() for box in boxes]) for end in ("low", "high"))
    return spaces.Box(low.astype(np.float32), high.astype(np.float32))


def flat(observation: Any, space: Space) -> Float32:
    """Observations as flat vectors, ``(n, width)``; one observation without a leading dimension gives ``n = 1``.

    :raises ValueError: if they have other shapes than the space
    """
    is_dict = isinstance(space, spaces.Dict)
    pairs = [(observation[key], box) for key, box in space.spaces.items()] if is_dict else [(observation, space)]  # type: ignore[attr-defined]
    return np.concatenate([_rows(part, box.shape) for part, box in pairs], axis=1)


def refuse_non_finite(what: str, rows: AnyArray) -> None:
    """Refuse what is NaN or infinite: it would spread into all weights.

    :param rows: of every environment, ``(n_envs, width)``
    :raises NonFiniteError: naming the environment
    """
    if not np.isfinite(rows).all():
        index = int(np.flatnonzero(~np.isfinite(rows).all(axis=1))[0])
        raise NonFiniteError(f"environment {index}: its {what} is not finite: {rows[index].tolist()}")


def _rows(part: Any, shape: tuple[int, ...] | None) -> Float32:
    """One row for each environment.

    :raises ValueError: if a part of an observation has another shape
    """
    array, shape = np.asarray(part, dtype=np.float32), shape or ()
    lead = array.ndim - len(shape)
    if lead not in (0, 1) or array.shape[lead:] != shape:
        raise ValueError(f"it has shape {array.shape} where {shape} or (n, {str(shape)[1:-1].rstrip(',')}) is due")
    return array.reshape(-1, int(np.prod(shape)))


class SequenceReplayBuffer(ReplayBuffer):
    """SB3's replay buffer, which gives sequences. A sequence begins anywhere, with a blank memory.

    Sequences run across the ends of episodes; the memory is blank again where one begins.

    :param buffer_size: environment steps to keep, those of all environments together
    :param observation_space: vectors, or dictionaries of them, which are joined
    :param action_space: a Box
    :param sequence_length: steps of a sequence
    :param burn_in: first steps of a sequence that warm its memory up and are not learnt from, unless an episode has
        begun in between
    :param kwargs: see SB3
    :raises ConfigError: if the numbers do not fit together, or observations are no vectors
    """

    arrays = ("observations", "next_observations", "actions", "rewards", "dones", "timeouts", "starts")
    """What it holds, each ``(buffer_size, n_envs, ...)``."""

    def __init__(
        self,
        buffer_size: int,
        observation_space: Space,
        action_space: spaces.Box,
        *args: Any,
        sequence_length: int = 16,
        burn_in: int = 8,
        **kwargs: Any,
    ) -> None:
        if not all(isinstance(number, int | np.integer) for number in (burn_in, sequence_length)):
            raise ConfigError(f"burn_in and sequence_length are whole numbers, got {burn_in!r} and {sequence_length!r}")
        if not 0 <= burn_in < sequence_length:
            raise ConfigError(f"need 0 <= burn_in < sequence_length, got {burn_in} and {sequence_length}")
        self.given_space = observation_space
        super().__init__(buffer_size, flat_space(observation_space), action_space, *args, **kwargs)
        if self.buffer_size <= sequence_length:
            raise ConfigError(
                f"buffer_size={buffer_size} holds {self.buffer_size} steps of each environment, too few for sequences "
                f"of {sequence_length}; raise buffer_size"
            )
        self.sequence_length, self.burn_in = sequence_length, burn_in
        self.starts = np.zeros((self.buffer_size, self.n_envs), dtype=bool)

    def note_starts(self, starts: BoolArray) -> None:
        """Say in which environments the transition that is added next begins an episode, ``(n_envs,)``."""
        self.starts[self.pos] = starts

    def add(self, obs: Any, next_obs: Any, action: AnyArray, reward: AnyArray, *args: Any) -> None:
        """Add a transition of every environment, see SB3; :meth:`note_starts` comes before it.

        :raises NonFiniteError: if the environments gave what is not finite; nothing is added then
        """
        seen, then = (flat(part, self.given_space) for part in (obs, next_obs))
        refuse_non_finite("observation", seen)
        refuse_non_finite("observation", then)
        refuse_non_finite("reward", np.asarray(reward).reshape(-1, 1))
        super().add(seen, then, action, reward, *args)

    def sample(self, batch_size: int, env: VecNormalize | None = None) -> ReplayBufferSamples:
        """Uniformly drawn sequences; all but the observations is of the steps that are learnt from, one after another.

        :param batch_size: number of sequences
        :param env: normalises observations and rewards
        :return: ``observations`` and ``next_observations`` are :class:`Sequences`
        """
        rows, envs = self._drawn(batch_size)
        starts = self.starts[rows, envs]
        kept = np.logical_or.accumulate(starts, axis=1)
        kept[:, self.burn_in :] = True
        if not kept.any():  # only while fewer steps are stored than the burn-in takes
            kept[:, -1] = True
        actions = self.actions[rows, envs]
        unknown = rows == self._oldest  # drawn only where it is all there is
        before = np.where((starts | unknown)[..., None], 0.0, self.actions[rows - 1, envs])
        seen = self._normalized(self.observations[rows, envs], env)
        then = self._normalized(self.next_observations[rows, envs][kept], env)
        dones = (self.dones * (1 - self.timeouts))[rows, envs][kept]
        rewards = self._normalize_reward(self.rewards[rows, envs][kept].reshape(-1, 1), env)
        inputs, begun, learnt = (th.as_tensor(x, device=self.device) for x in (_joined(seen, before), starts, kept))
        later = th.as_tensor(_joined(then, actions[kept]), device=self.device)
        return ReplayBufferSamples(
            observations=Sequences(inputs, begun, learnt),  # type: ignore[arg-type]
            actions=self.to_torch(actions[kept]),
            next_observations=Sequences(inputs, begun, learnt, later),  # type: ignore[arg-type]
            dones=self.to_torch(dones.reshape(-1, 1)),
            rewards=self.to_torch(rewards.astype(np.float32)),
        )

    def _normalized(self, rows: AnyArray, env: VecNormalize | None) -> AnyArray:
        """Flat observations ``(..., width)`` by the statistics that ``env`` keeps in the observations' own shape."""
        if env is None:
            return rows
        given: Any = self._normalize_obs(rows.reshape(*rows.shape[:-1], *(self.given_space.shape or ())), env)
        return np.asarray(given.reshape(rows.shape))

    def _drawn(self, n: int) -> tuple[AnyArray, AnyArray]:
        """Rows ``(n, time)`` and environments ``(n, 1)`` of sequences that do not run across the newest row."""
        # the action before the oldest row of a ring is gone, also where it was loaded into a larger one
        left_out = int(self.size() > 1 and (self.full or not self.starts[0].all()))
        length = min(self.sequence_length, self.size() - left_out)
        first = np.random.randint(left_out, self.size() - length + 1, size=(n, 1))  # noqa: NPY002, as SB3 draws
        envs = np.random.randint(0, self.n_envs, size=(n, 1))  # noqa: NPY002
        return (self._oldest + first + np.arange(length)) % self.buffer_size, envs

    @property
    def _oldest(self) -> int:
        """Row of the oldest step."""
        return self.pos if self.full else 0

    def save(self, path: str | pathlib.Path | io.BufferedIOBase) -> None:
        """Write what is stored to one file of plain arrays."""
        held = {name: getattr(self, name)[: self.size()] for name in self.arrays}
        write_arrays(path, {**held, "pos": np.array(self.pos), "full": np.array(self.full)})

    def load(self, path: str | pathlib.Path | io.BufferedIOBase) -> None:
        """Read what :meth:`save` wrote.

        :raises ValueError: if it was written for other spaces, another size, or other environments
        """
        found = read_arrays(path)
        rows = len(found.get("dones", ()))
        for name in self.arrays:
            wanted = (rows, *getattr(self, name).shape[1:])
            if name not in found or found[name].shape != wanted or rows > self.buffer_size:
                got = f"shape {found[name].shape}" if name in found else "nothing"
                raise ValueError(
                    f"{path} does not fit: {name} has shape {getattr(self, name).shape} here, got {got}; load it into "
                    "an agent with the same environments and at least the same buffer_size"
                )
            getattr(self, name)[:rows] = found[name]
        # in a larger buffer, what was a full ring begins at its oldest row
        self.full = rows == self.buffer_size
        if bool(found["full"]) and not self.full:
            for name in self.arrays:
                getattr(self, name)[:rows] = np.roll(found[name], -int(found["pos"]), axis=0)
        self.pos = int(found["pos"]) % self.buffer_size if self.full else rows


def _joined(observations: Any, actions: AnyArray) -> Float32:
    """Inputs of a memory: observations, and the actions before them."""
    return np.concatenate([observations, actions], axis=-1, dtype=np.float32)
