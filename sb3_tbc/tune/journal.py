"""The journal file of a search: whole lines only, whatever a full disk or a killed process leaves behind."""

from __future__ import annotations

import os
from pathlib import Path
from typing import Any

from optuna.storages.journal import JournalFileBackend, JournalFileSymlinkLock
from optuna.storages.journal._file import get_lock_file

from sb3_tbc.files import explained

LONGEST_LINE = 2**24
"""Longest possible line of a journal, bytes; the settings of a study take about 100,000."""


class WholeLines(JournalFileBackend):
    """Optuna's journal file, in which no line is appended to the half of another: the two could not be read.

    :param path: the journal
    """

    def __init__(self, path: Path) -> None:
        super().__init__(str(path))
        self._path = path

    def append_logs(self, logs: list[dict[str, Any]]) -> None:
        """Append lines, after the half one that another worker may have left.

        :raises WriteError: if they cannot be written
        """
        with explained(self._path):
            if not _ends_whole(self._path):
                drop_half_line(self._path)
            super().append_logs(logs)


def _ends_whole(path: Path) -> bool:
    with path.open("rb") as file:
        if not file.seek(0, os.SEEK_END):
            return True
        file.seek(-1, os.SEEK_END)
        return file.read() == b"\n"


def drop_half_line(path: Path) -> None:
    """Remove an incomplete last line that a killed process or a full disk left in a journal.

    Optuna skips such a line, but would append the next one to it, and the two together could not be read.
    """
    if not path.is_file():
        return
    lock = JournalFileSymlinkLock(str(path))
    with get_lock_file(lock), path.open("rb+") as file:
        size = file.seek(0, os.SEEK_END)
        file.seek(max(size - LONGEST_LINE, 0))
        tail = file.read()
        if tail and not tail.endswith(b"\n"):
            file.truncate(size - len(tail) + tail.rfind(b"\n") + 1)
            file.flush()
            os.fsync(file.fileno())
