"""The replay buffers of both levels as one, and their file of plain arrays."""

from __future__ import annotations

import io
import os
import pathlib
from typing import Any, NamedTuple

import numpy as np

from sb3_tbc.buffers import OptionReplayBuffer, SubgoalReplayBuffer


class Replay(NamedTuple):
    """The replay buffers of both levels."""

    high: OptionReplayBuffer
    low: SubgoalReplayBuffer

    def save(self, path: str | pathlib.Path | io.BufferedIOBase) -> None:
        """Write both buffers to one file of plain arrays, atomically."""
        arrays: dict[str, Any] = {
            f"{name}.{key}": array
            for name, buffer in self._asdict().items()
            for key, array in buffer.get_state().items()
        }
        if not isinstance(path, (str, pathlib.Path)):
            np.savez(path, **arrays)
            return
        target = pathlib.Path(path)
        partial = target.with_name(target.name + ".partial")
        with open(partial, "wb") as file:
            np.savez(file, **arrays)
        os.replace(partial, target)

    def load(self, path: str | pathlib.Path | io.BufferedIOBase) -> None:
        """Read what :meth:`save` wrote; only plain arrays are read, never pickled objects.

        :raises ValueError: if the file was written for other spaces or sizes
        """
        with np.load(path, allow_pickle=False) as arrays:
            for name, buffer in self._asdict().items():
                names = [key for key in arrays.files if key.startswith(f"{name}.")]
                buffer.set_state({key.removeprefix(f"{name}."): arrays[key] for key in names})
