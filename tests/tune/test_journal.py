"""A journal on a full disk: what is written later can be read."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

import pytest

from sb3_tbc.tune.study import names, open_storage

FULL = """
import resource, sys
from pathlib import Path
import optuna
from sb3_tbc.errors import WriteError
from sb3_tbc.tune.study import open_storage

path = Path(sys.argv[1])
begun, other = (open_storage(str(path)) for _ in range(2))
study = optuna.create_study(storage=begun, study_name="kept", direction="maximize")
size, (_, hard) = path.stat().st_size, resource.getrlimit(resource.RLIMIT_FSIZE)
resource.setrlimit(resource.RLIMIT_FSIZE, (size + 20, hard))  # room for a part of a line
try:
    study.set_user_attr("lost", 1)
except WriteError as error:
    print(error)
resource.setrlimit(resource.RLIMIT_FSIZE, (hard, hard))
assert not path.read_bytes().endswith(b"\\n")
optuna.create_study(storage=other, study_name="later", direction="maximize")  # another worker goes on
"""


@pytest.mark.skipif(sys.platform == "win32", reason="Windows has no limit of a file's size")
def test_the_half_line_of_a_full_disk_spoils_no_other(tmp_path: Path) -> None:
    path = tmp_path / "study.log"
    done = subprocess.run([sys.executable, "-c", FULL, str(path)], capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
    assert done.stdout == f"cannot write {path}: File too large; make room, then go on\n"
    assert names(open_storage(str(path))) == {"kept", "later"}
