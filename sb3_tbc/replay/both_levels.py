"""The replay buffers of both levels as one, and their file of plain arrays."""

from __future__ import annotations

import io
import pathlib
from collections.abc import Mapping
from typing import NamedTuple, NoReturn

from sb3_tbc.arrays import AnyArray, Arrays, put_under, taken_from
from sb3_tbc.files import write_arrays
from sb3_tbc.reading import read_arrays
from sb3_tbc.replay.buffers import OptionReplayBuffer, SubgoalReplayBuffer

MORE = "running"
"""Prefix of arrays in the file that belong to neither buffer."""


class Replay(NamedTuple):
    """The replay buffers of both levels."""

    high: OptionReplayBuffer
    low: SubgoalReplayBuffer

    def __getattr__(self, name: str) -> NoReturn:
        """Say where to look: agents of SB3 have one buffer."""
        raise AttributeError(
            f"{name!r} belongs to a replay buffer, and there are two: replay_buffer.high and replay_buffer.low"
        )

    def save(self, path: str | pathlib.Path | io.BufferedIOBase, more: Mapping[str, AnyArray]) -> None:
        """Write both buffers to one file of plain arrays, atomically.

        :param more: arrays to write into the same file
        """
        high, low = (put_under(name, buffer.get_state()) for name, buffer in self._asdict().items())
        write_arrays(path, high | low | put_under(MORE, more))

    def load(self, path: str | pathlib.Path | io.BufferedIOBase) -> Arrays:
        """Read what :meth:`save` wrote; only plain arrays are read, never pickled objects.

        :return: the further arrays of the file
        :raises ValueError: if the file was written for other spaces or sizes
        """
        arrays = read_arrays(path)
        try:
            for name, buffer in self._asdict().items():
                buffer.set_state(taken_from(name, arrays))
        except (KeyError, TypeError, IndexError) as error:
            raise ValueError(f"{path} is no saved replay buffer of such an agent: {error!r}") from error
        return taken_from(MORE, arrays)
