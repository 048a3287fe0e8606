"""Errors that name what went wrong inside a hierarchy; other user mistakes are ``ValueError`` or ``TypeError``."""

from __future__ import annotations

import difflib
from collections.abc import Iterable


class HierarchyError(RuntimeError):
    """The two levels were used out of order, e.g. stepping before a reset."""


class NonFiniteError(FloatingPointError):
    """A value became NaN or infinite; the message names level, layer and step."""


class ConfigError(ValueError):
    """A name is unknown or a value is not allowed; the message says what is allowed, or names the nearest match."""


class WriteError(OSError):
    """A file or folder cannot be written; what was there before is untouched. The message says where, why, and what
    to do.
    """


class FolderInUseError(ConfigError):
    """Another process is using the folder."""


class EnvironmentFault(RuntimeError):
    """An environment raised an error, died or hangs; the message names it and the step."""


class DivergedError(ArithmeticError):
    """Learning diverged: losses or weights grew without bound."""


class TrainingError(RuntimeError):
    """Training ended early; the message says why and how to continue. The original error is the ``__cause__``."""


def nearest(name: str, names: Iterable[str]) -> str:
    """A hint that names the closest valid name, or lists them all when none is close."""
    known = sorted(names)
    lowered = {k.lower(): k for k in known}
    close = difflib.get_close_matches(name.lower(), lowered, n=1, cutoff=0.5)
    return f"did you mean {lowered[close[0]]!r}?" if close else f"known: {', '.join(known)}"
