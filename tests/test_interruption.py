"""Ctrl-C while a command loads its packages."""

from __future__ import annotations

import subprocess
import sys

import pytest

from sb3_tbc import interruption


def ended_by(error: str, program: str) -> str:
    """What a program prints that imports the package and then ends by an error."""
    code = f"import sys; sys.argv[0] = {program!r}; import sb3_tbc; raise {error}"
    return subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=False).stderr


@pytest.mark.slow
def test_a_command_says_so_in_one_line_and_a_program_of_the_users_is_left_alone() -> None:
    assert ended_by("KeyboardInterrupt", "-m") == "sb3_tbc: interrupted\n"
    assert "Traceback" in ended_by("ValueError", "-m")
    assert "Traceback" in ended_by("KeyboardInterrupt", "mine.py")


def test_which_errors_are_told_in_one_line(monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]) -> None:
    seen = []
    monkeypatch.setattr(sys, "excepthook", lambda *error: seen.append(error))
    interruption.say_it_in_one_line()
    others = ValueError("no"), SystemExit(3)
    for error in (*others, KeyboardInterrupt()):
        sys.excepthook(type(error), error, None)
    assert [error for _, error, _ in seen] == list(others)
    assert capsys.readouterr().err == "sb3_tbc: interrupted\n"


def test_programs() -> None:
    assert interruption.is_command("-m")
    assert interruption.is_command("/usr/bin/sb3-tbc")
    assert not interruption.is_command("/home/me/train.py")
    assert not interruption.is_command("")
