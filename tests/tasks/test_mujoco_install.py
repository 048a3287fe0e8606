"""A half upgraded MuJoCo is told in one line."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

import pytest

MAKE = "import sb3_tbc, gymnasium; gymnasium.make('sb3_tbc/UR5Reacher-v0')"


MISMATCH = "Version mismatch between 'mujoco' (4.0.0) and 'mujoco-core' (3.9)\\nUpgrade"


@pytest.mark.parametrize(
    ("left", "words"),
    [(f'raise ImportError("{MISMATCH}")', "(Version mismatch"), ("", "installed are")],
    ids=["two versions", "an empty module"],
)
def test_is_told_in_one_line(left: str, words: str, tmp_path: Path) -> None:
    (tmp_path / "mujoco").mkdir()
    (tmp_path / "mujoco" / "__init__.py").write_text(left)
    code = f"import sys; sys.path.insert(0, {str(tmp_path)!r}); {MAKE}"
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, timeout=120)
    last = done.stderr.strip().splitlines()[-1]
    assert done.returncode == 1
    assert last.startswith("ImportError: MuJoCo cannot be used")
    assert words in last
    assert "pip install --upgrade --force-reinstall mujoco" in last
