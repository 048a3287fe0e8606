"""Ctrl-C while a command is still loading its packages, which takes seconds: one line instead of a traceback."""

from __future__ import annotations

import sys
from pathlib import Path
from types import TracebackType


def is_command(program: str) -> bool:
    """Whether a program's name is ``-m``, as with ``python -m`` while the package is loaded, or ``sb3-tbc``."""
    return program == "-m" or Path(program).stem == "sb3-tbc"


def say_it_in_one_line() -> None:
    """Print one line for an interruption that nothing catches; other errors are shown as before.

    Python then ends by the signal itself, which a shell shows as exit status 130.
    """
    before = sys.excepthook

    def show(kind: type[BaseException], error: BaseException, where: TracebackType | None) -> None:
        if issubclass(kind, KeyboardInterrupt):
            print("sb3_tbc: interrupted", file=sys.stderr)
        else:
            before(kind, error, where)

    sys.excepthook = show


if is_command(sys.argv[0] if sys.argv else ""):  # a user's own program keeps its tracebacks
    say_it_in_one_line()
