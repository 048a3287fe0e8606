"""Power may go at any moment: a file's content is on the disk before it gets its name, and then so is the name."""

from __future__ import annotations

import os
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from injection import SMALL, SMALL_FLAT

from sb3_tbc import train
from sb3_tbc.files import save_atomic, write_arrays, write_atomic
from sb3_tbc.zoo.callbacks import write_evaluations
from sb3_tbc.zoo.checkpoints import save_checkpoint

SCRATCH = ("progress.csv", ".lock", "events.out")
"""Files that nothing is read from again: SB3's log, the lock."""


class Disk:
    """Records what is synced and what is renamed, in order."""

    def __init__(self, patch: pytest.MonkeyPatch) -> None:
        self.calls: list[tuple[str, str]] = []
        for name in ("fsync", "rename", "replace"):
            patch.setattr(os, name, self._recorded(name, getattr(os, name)))

    def _recorded(self, name: str, call: Callable[..., Any]) -> Callable[..., Any]:
        def recorded(first: Any, *rest: Any, **more: Any) -> Any:
            if name == "fsync":
                self.calls.append(("sync", os.readlink(f"/proc/self/fd/{first}")))
            else:
                self.calls += [("from", os.fspath(first)), ("to", os.fspath(rest[0]))]
            return call(first, *rest, **more)

        return recorded

    def problems(self) -> list[str]:
        """Renames whose content was not synced before, or whose folder was not synced after."""
        found = []
        for at, (what, path) in enumerate(self.calls):
            if what != "to" or "_until_" in path:  # logs of earlier parts, which nothing reads
                continue
            source = self.calls[at - 1][1]
            before = [p for w, p in self.calls[: at - 1] if w == "sync"]
            aside = path.endswith((".old", ".broken"))  # was on the disk already
            if not aside and not any(p == source or p.startswith(source + "/") for p in before):
                found.append(f"{source} got its name {path} before its content was on the disk")
            if str(Path(path).parent) not in [p for w, p in self.calls[at:] if w == "sync"]:
                found.append(f"the name {path} was not put on the disk")
        return found


@pytest.fixture
def disk(monkeypatch: pytest.MonkeyPatch) -> Disk:
    return Disk(monkeypatch)


def test_single_writers(disk: Disk, tmp_path: Path) -> None:
    writers: list[Callable[[], object]] = [
        lambda: write_atomic(tmp_path / "a.txt", "a"),
        lambda: save_atomic(lambda name: Path(name).write_text("b"), tmp_path / "b.zip"),
        lambda: write_arrays(tmp_path / "c.npz", {"x": np.zeros(3)}),
        lambda: write_evaluations(tmp_path / "evaluations.csv", []),
        lambda: save_checkpoint(tmp_path, 1, 1.0, lambda p: p.write_text("m"), lambda p: p.write_text("r")),
        lambda: save_checkpoint(tmp_path, 2, 1.0, lambda p: p.write_text("m"), lambda p: p.write_text("r")),
    ]
    for write in writers:
        disk.calls.clear()
        write()
        assert [what for what, _ in disk.calls].count("to") >= 1
        assert not disk.problems()


@pytest.mark.parametrize("algo", ["tbc-hrl", "sac"])
def test_a_whole_run(algo: str, disk: Disk, tmp_path: Path) -> None:
    """Every file that it leaves was put on the disk before it got its name."""
    arguments = ["--env", "Pendulum", "--algo", algo, "--n-timesteps", "300", "--eval-freq", "150", "--trace"]
    arguments += ["--checkpoint-minutes", "0", "--keep-checkpoint", "--log-folder", str(tmp_path / "runs")]
    arguments += ["--ledger", str(tmp_path / "ledger"), *(SMALL_FLAT if algo == "sac" else SMALL)]
    assert train.main(arguments) == 0
    assert not disk.problems()
    named = {path for what, path in disk.calls if what == "to"}
    for path in tmp_path.rglob("*"):
        if path.is_file() and not path.name.startswith(SCRATCH):
            inside = any(str(path).startswith(f"{folder}/") for folder in named)
            assert str(path) in named or inside, f"{path.name} was written in place"


def test_the_test_sees_what_is_missing(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    monkeypatch.setattr("sb3_tbc.files.sync", lambda path: None)
    disk = Disk(monkeypatch)
    write_atomic(tmp_path / "a.txt", "a")
    assert len(disk.problems()) == 2
