"""Text files that grow by a row at a time while an agent learns, and are whole lines whatever happens."""

from __future__ import annotations

import csv
import io
import os
from collections.abc import Iterable
from pathlib import Path

from stable_baselines3.common.callbacks import BaseCallback

from sb3_tbc.files import explained, replacing


class RowsCallback(BaseCallback):
    """Writes rows to a CSV whose first column is the environment step.

    :param path: the file; what it holds of the steps before training begins is kept, as a resumed run needs it
    """

    def __init__(self, path: Path, verbose: int = 0) -> None:
        super().__init__(verbose)
        self.path = path
        self._file: io.TextIOWrapper | None = None

    def head(self) -> str:
        """What the file begins with, up to the first row."""
        raise NotImplementedError

    def _on_training_start(self) -> None:
        keep_rows(self.path, self.head(), self.num_timesteps)
        with explained(self.path):
            self._file = self.path.open("a", encoding="utf-8", newline="")

    def write(self, row: Iterable[object]) -> None:
        """Add a row, the step before it.

        :raises WriteError: if it cannot be written
        """
        if self._file is not None:
            with explained(self.path):
                csv.writer(self._file, lineterminator="\n").writerow([self.num_timesteps, *row])

    def flush(self) -> None:
        """Put what was written on the disk: a checkpoint that is to be resumed from needs the rows before it."""
        if self._file is not None:
            with explained(self.path):
                self._file.flush()
                os.fsync(self._file.fileno())

    def _on_training_end(self) -> None:
        if self._file is not None:
            self._file.close()
            self._file = None


def keep_rows(path: Path, head: str, timesteps: int) -> None:
    """Leave in a file what happened up to a step, whole lines only; without a file, begin one."""
    with replacing(path) as temporary, temporary.open("w", encoding="utf-8", newline="") as kept:
        kept.write(head)
        if not timesteps or not path.is_file():
            return
        with path.open(encoding="utf-8", errors="replace", newline="") as earlier:
            for line in earlier:
                steps = line.partition(",")[0]
                if line.endswith("\n") and steps.isdecimal() and int(steps) <= timesteps:
                    kept.write(line)
