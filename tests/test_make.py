"""What ``make`` does on machines that are not as it expects them; the Pythons here are shell scripts."""

from __future__ import annotations

import os
import subprocess
from pathlib import Path

import pytest

SCRIPT = Path(__file__).parents[1] / "scripts" / "venv.sh"
pytestmark = pytest.mark.skipif(os.name != "posix", reason="needs a shell")


def python(path: Path, new: bool = True, pip: bool = True) -> str:
    """A Python that is new enough or not, has pip or not, and only says that it makes an environment."""
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_text(f"""#!/bin/sh
case "$1 $2" in
  --version*) echo Python 3.{12 if new else 10}.0;;
  -c*) exit {int(not new)};;
  "-m pip") exit {int(not pip)};;
  "-m venv") echo "made $3";;
esac
""")
    path.chmod(0o755)
    return str(path)


def venv(folder: Path, name: str) -> tuple[int, str]:
    done = subprocess.run([SCRIPT, folder, name], capture_output=True, text=True, timeout=60)
    return done.returncode, done.stdout + done.stderr


def test_an_environment_is_made_once_and_completed_after_an_interrupt(tmp_path: Path) -> None:
    folder, newer = tmp_path / "my venv", python(tmp_path / "python3")
    assert venv(folder, newer) == (0, f"{newer} -m venv {folder}\nmade {folder}\n")
    python(folder / "bin" / "python", pip=False)  # ended between the interpreter and pip
    assert f"made {folder}" in venv(folder, newer)[1]
    python(folder / "bin" / "python")
    assert venv(folder, newer) == (0, "")


def test_an_old_python_is_refused_with_the_cure(tmp_path: Path) -> None:
    folder, old, newer = tmp_path / "venv", python(tmp_path / "old", new=False), python(tmp_path / "python3")
    status, text = venv(folder, old)
    assert status != 0
    assert "is Python 3.10.0, Python 3.11 or later is needed: name one, e.g. make PYTHON=python3.12 train" in text
    status, text = venv(folder, "python-that-is-not-here")
    assert status != 0
    assert "no Python called python-that-is-not-here here: name one" in text
    python(folder / "bin" / "python", new=False)  # made by an earlier attempt
    status, text = venv(folder, newer)
    assert status != 0
    assert f"remove {folder} and name one" in text
