"""A run that is killed at any change of its folder, resumed, is the run that was not disturbed."""

from __future__ import annotations

from pathlib import Path

import pytest
from injection import SMALL, die_before_change, differences, finish, run

ARGUMENTS = ["--env", "Pendulum", "--n-timesteps", 900, "--eval-freq", 450, "--checkpoint-minutes", 0, "--trace"]
ARGUMENTS += ["--keep-checkpoint", *SMALL]
EVERY = 13
"""Of so many changes one is tried; ``make torture`` tries all."""


@pytest.fixture(scope="module")
def undisturbed(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, int]:
    """A run, and how many system calls changed its folder."""
    root = tmp_path_factory.mktemp("undisturbed")
    arguments = [*ARGUMENTS, "--log-folder", root / "runs"]
    count = root / "count"
    assert run(arguments, root / "log", die_before_change(0, root / "runs", count)) == 0, (root / "log").read_text()
    folder = finish(root / "runs", arguments, root / "log")
    return folder, count.stat().st_size


def test_killed_before_a_change_of_the_folder(undisturbed: tuple[Path, int], tmp_path: Path) -> None:
    whole, changes = undisturbed
    assert changes > 60
    for number in range(4, changes + 1, EVERY):
        root = tmp_path / str(number)
        arguments = [*ARGUMENTS, "--log-folder", root / "runs"]
        root.mkdir()
        run(arguments, root / "log", die_before_change(number, root / "runs"))
        folder = finish(root / "runs", arguments, root / "log")
        assert not differences(whole, folder), f"killed before change {number}"
        left = [path.name for path in folder.iterdir() if path.name.startswith((".", "checkpoint.new"))]
        assert not left, f"killed before change {number}"
