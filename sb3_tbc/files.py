"""Writing files so that neither a reader nor a crash ever meets half of one."""

from __future__ import annotations

import io
import os
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

import numpy as np


def write_atomic(path: Path, text: str) -> None:
    """Write a text file so that a reader or a crash never sees half of it."""
    path.parent.mkdir(parents=True, exist_ok=True)
    temporary = path.with_name(f".{path.name}.{os.getpid()}.tmp")
    temporary.write_text(text, encoding="utf-8")
    os.replace(temporary, path)


def save_atomic(save: Callable[[str], object], path: Path) -> None:
    """Let ``save`` write to a temporary file with the same suffix, then put that in place of ``path``."""
    path.parent.mkdir(parents=True, exist_ok=True)
    temporary = path.with_name(f".tmp{os.getpid()}-{path.name}")
    save(str(temporary))
    os.replace(temporary, path)


def write_arrays(path: str | Path | io.BufferedIOBase, arrays: Mapping[str, Any]) -> None:
    """Write plain arrays to one file, atomically where ``path`` is a path."""
    content: dict[str, Any] = dict(arrays)
    if not isinstance(path, (str, Path)):
        np.savez(path, **content)
        return
    target = Path(path)
    partial = target.with_name(target.name + ".partial")
    with open(partial, "wb") as file:
        np.savez(file, **content)
    os.replace(partial, target)
