"""A storage that is damaged is told of in one line, whatever was damaged."""

from __future__ import annotations

import random
import sqlite3
from pathlib import Path

import pytest

from sb3_tbc.tune import command, study, worker

SMALL = ["--env", "Pendulum", "--n-timesteps", "200", "--eval-freq", "200", "--n-seeds", "1", "--n-eval-episodes", "1"]
SMALL += ["--n-final-episodes", "1", "--n-trials", "1", "--hyperparams", "compile:false", "gradient_ratio:0.01"]


@pytest.fixture(scope="module")
def begun(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder with a journal and a database of one trial each."""
    folder = tmp_path_factory.mktemp("begun")
    for storage in (str(folder / "study.log"), f"sqlite:///{folder}/study.db"):
        runs = str(folder / storage[-2:])
        assert command.main(["--log-folder", runs, "--storage", storage, *SMALL]) == 0
    with sqlite3.connect(folder / "study.db") as database:  # all of it in the one file
        database.execute("PRAGMA wal_checkpoint(TRUNCATE)")
    return folder


@pytest.mark.parametrize("name", ["study.log", "study.db"])
def test_one_line_or_read(
    name: str, begun: Path, tmp_path: Path, capfd: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(study, "LONGEST_WAIT", 0.1)  # no other machine is about to write what is missing
    whole = (begun / name).read_bytes()
    told = 0
    for k in range(25):
        rng = random.Random(k)
        path = tmp_path / f"{k}-{name}"
        content = bytearray(whole)
        if k % 2:
            place = rng.randrange(len(content))
            place -= place % 4096 if name.endswith(".db") else 0
            content[place : place + 200] = rng.randbytes(200)
        else:
            content = content[: rng.randrange(1, len(content))]
        path.write_bytes(content)
        storage = f"sqlite:///{path}" if name.endswith(".db") else str(path)
        capfd.readouterr()
        where = ["--log-folder", str(tmp_path / str(k)), "--storage", storage, "--minutes", "1e-9"]
        status = command.main([*where, *SMALL])
        said = capfd.readouterr().err.strip()
        assert status in (0, 2), said
        assert "Traceback" not in said
        if status == 2:
            told += 1
            assert said.count("\n") == 0, said
            assert str(path) in said or "'tbc-hrl-Pendulum'" in said  # the storage, or the study
    assert told > 3


@pytest.mark.parametrize("storage", ["sqlite://", "sqlite:///:memory:", "sqlite+pysqlite:///"])
def test_a_database_in_memory_is_refused(storage: str, tmp_path: Path, capfd: pytest.CaptureFixture[str]) -> None:
    assert command.main(["--log-folder", str(tmp_path), "--storage", storage, *SMALL]) == 2
    said = capfd.readouterr().err.strip()
    assert f"storage {storage} lives in the memory of one connection" in said
    assert said.count("\n") == 0


def test_a_database_that_fails_during_a_search_is_told_in_one_line(
    tmp_path: Path, capfd: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    path = tmp_path / "study.db"

    def lose(*_: object) -> int:
        with sqlite3.connect(path) as database:
            database.execute("DROP TABLE trials")
        return 0

    monkeypatch.setattr(worker, "run_workers", lose)
    assert command.main(["--log-folder", str(tmp_path), "--storage", f"sqlite:///{path}", *SMALL]) == 2
    said = capfd.readouterr().err.strip()
    assert "has failed: (sqlite3.OperationalError) no such table: trials" in said
    assert said.count("\n") == 0
