"""Errors that name what went wrong inside a hierarchy; other user mistakes are ``ValueError`` or ``TypeError``."""

from __future__ import annotations

import difflib
from collections.abc import Iterable


class HierarchyError(RuntimeError):
    """The two levels were used out of order, e.g. stepping before a reset."""


class NonFiniteError(FloatingPointError):
    """A value became NaN or infinite; the message names level, layer and step."""


class ConfigError(ValueError):
    """A configuration names what does not exist or has the wrong type; the message names the nearest match."""


class WriteError(OSError):
    """A file or folder cannot be written; what was there before is untouched. The message says where, why, and what
    to do.
    """


class FolderInUseError(ConfigError):
    """Another process works in the folder."""


class EnvironmentFault(RuntimeError):
    """An environment raised an error, died or hangs; the message names it and the step."""


class DivergedError(ArithmeticError):
    """Learning left all sense: losses or weights grew without bound."""


class TrainingError(RuntimeError):
    """Training ended early; the message says why, and from where it can go on. The reason is the error's cause."""


def nearest(name: str, names: Iterable[str]) -> str:
    """A hint that names the closest valid name, or lists them all when none is close."""
    known = sorted(names)
    lowered = {k.lower(): k for k in known}
    close = difflib.get_close_matches(name.lower(), lowered, n=1, cutoff=0.5)
    return f"did you mean {lowered[close[0]]!r}?" if close else f"known: {', '.join(known)}"
