"""Run folders and the ledger: what is written, what is refused, what survives."""

from __future__ import annotations

import errno
import json
import os
import stat
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from sb3_tbc.errors import ConfigError, WriteError
from sb3_tbc.files import write_atomic
from sb3_tbc.zoo import ledger
from sb3_tbc.zoo.callbacks import EvaluationRow, read_evaluations, write_evaluations
from sb3_tbc.zoo.ledger import RunFolder, curve_summary, finished_runs, summarise, to_json

ROW = EvaluationRow(1000, 0.5, 20, 312.25, 0.25, 21.5, 12.5)


def episodes(successes: list[bool], lengths: list[int]) -> Any:
    n = len(successes)
    share, window = np.full(n, 0.25), np.full(n, np.nan)
    return SimpleNamespace(
        successes=np.array(successes), lengths=np.array(lengths), subgoal_success=share, mean_window=window
    )


def test_summary_has_the_pinned_keys_and_no_nan() -> None:
    summary = summarise(episodes([True, False, True, True], [100, 1000, 200, 300]))
    assert summary["n_episodes"] == 4
    assert summary["success_rate"] == 0.75
    assert summary["mean_length"] == 400.0
    assert summary["mean_length_success"] == 200.0
    assert summary["subgoal_success"] == 0.25
    assert summary["mean_window"] is None
    low, high = summary["success_ci95"]
    assert 0.0 < low < 0.75 < high < 1.0
    assert json.loads(to_json(summary)) == summary
    assert summarise(episodes([False], [9]))["mean_length_success"] is None
    with pytest.raises(ValueError, match="not JSON compliant"):
        to_json({"x": float("nan")})


def test_folder_layout(tmp_path: Path) -> None:
    folder = RunFolder.for_run(tmp_path, "Pendulum", "tbc-hrl", "full", 3)
    assert folder.path == tmp_path / "Pendulum" / "tbc-hrl" / "full" / "seed_3"
    foreign = RunFolder.for_run(tmp_path, "my_module:ns/Env-v0", "hits", "full", 0)
    assert foreign.path.relative_to(tmp_path).parts[0] == "my_module_ns_Env-v0"


def test_life_of_a_run(tmp_path: Path) -> None:
    folder = RunFolder.for_run(tmp_path / "runs", "T", "a", "full", 0)
    assert not folder.exists
    folder.start({"algo": "a", "model": {"gamma": 0.9}}, "python -m x")
    write_evaluations(folder.evaluations, [ROW, ROW._replace(timesteps=2000)])
    assert folder.exists
    assert not folder.finished
    assert folder.read_config() == {"algo": "a", "model": {"gamma": 0.9}}
    folder.start({"algo": "a", "model": {"gamma": 0.9}}, "")  # a resumed run keeps its curve
    assert folder.read_evaluations()[0] == ROW
    folder.drop_evaluations_after(1500)
    assert folder.read_evaluations() == [ROW]
    folder.finish({"task": "T", "success_rate": 1.0})
    assert [f.path for f in finished_runs(tmp_path / "runs")] == [folder.path]
    (folder.path / "model.zip").write_bytes(b"large")

    target = RunFolder.for_run(tmp_path / "results", "T", "a", "full", 0)
    folder.copy_to(target)
    assert sorted(p.name for p in target.path.iterdir()) == sorted(ledger.LEDGER_FILES)
    with pytest.raises(ConfigError, match="already holds a result"):
        folder.copy_to(target)

    (folder.path / "notes.txt").write_text("mine")
    (folder.path / "events.out.tfevents.1.machine.2.0").write_bytes(b"curves of the earlier run")
    folder.clear()
    assert [p.name for p in folder.path.iterdir()] == ["notes.txt"]


def test_a_run_without_evaluations_is_copied_whole_or_not_at_all(tmp_path: Path) -> None:
    folder, target = (RunFolder.for_run(tmp_path / root, "T", "a", "full", 0) for root in ("runs", "results"))
    folder.start({"algo": "a"}, "python -m x")
    folder.finish({"success_rate": 1.0})
    folder.copy_to(target)
    assert target.read_evaluations() == []
    other = RunFolder.for_run(tmp_path / "results", "T", "a", "full", 1)
    folder.evaluations.unlink()
    with pytest.raises(ConfigError, match=r"lacks evaluations\.csv and cannot be copied"):
        folder.copy_to(other)
    assert not other.path.exists()


@pytest.mark.parametrize("name", ["final.json", "config.yml"])
def test_half_a_file_is_not_copied(name: str, tmp_path: Path) -> None:
    folder, target = (RunFolder.for_run(tmp_path / root, "T", "a", "full", 0) for root in ("runs", "results"))
    folder.start({"algo": "a"}, "python -m x")
    folder.finish({"success_rate": 1.0})
    (folder.path / name).write_text('{"success_')
    with pytest.raises(ConfigError, match=rf"{name}: it is no .*; nothing was copied\. Train the run again"):
        folder.copy_to(target)
    assert not target.path.exists()


def test_a_resumed_run_keeps_its_first_versions_and_command(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    folder = RunFolder(tmp_path)
    commits = iter(("one", "one", "two", "two", "one"))
    monkeypatch.setattr(ledger, "_commit", lambda: next(commits))
    for command in ("python -m x", "", "python -m x --resume", "", ""):
        folder.start({}, command)
    versions = json.loads((tmp_path / "versions.json").read_text())
    assert versions["commit"] == "one"
    assert [later["commit"] for later in versions["resumed"]] == ["two", "one"]
    assert (tmp_path / "command.txt").read_text() == "python -m x\npython -m x --resume\n"
    (tmp_path / "versions.json").write_text(to_json({**versions, "resumed": 3}))
    commits = iter(["one"])
    with pytest.raises(ConfigError, match="resumed must be a list, got int"):
        folder.start({}, "")


def test_versions_name_what_matters() -> None:
    versions = ledger.versions()
    assert {"stable_baselines3", "torch", "numpy"} <= set(versions["packages"])
    assert versions["cpu"]
    assert versions["torch_threads"] == 1


def test_broken_files_are_named(tmp_path: Path) -> None:
    folder = RunFolder(tmp_path)
    with pytest.raises(ConfigError, match=r"holds no run: config\.yml is missing"):
        folder.read_config()
    (tmp_path / "final.json").write_text("{")
    with pytest.raises(ConfigError, match=r"cannot read .*final\.json"):
        folder.read_final()
    (tmp_path / "final.json").write_text("[]")
    with pytest.raises(ConfigError, match="must hold named values"):
        folder.read_final()


@pytest.mark.parametrize("named", ["runs", "runs/Pendulum/tbc-hrl", "runs/Pendulum/tbc-hrl/full/seed_3/model.zip"])
def test_the_folder_of_the_run_that_was_meant_is_named(named: str, tmp_path: Path) -> None:
    run = RunFolder.for_run(tmp_path / "runs", "Pendulum", "tbc-hrl", "full", 3)
    run.start({"seed": 3}, "train")
    run.model.write_bytes(b"")
    with pytest.raises(ConfigError, match=f"name the folder of a run, e.g. {run.path}$"):
        RunFolder(tmp_path / named).read_config()


def test_evaluations_round_trip(tmp_path: Path) -> None:
    path = tmp_path / "evaluations.csv"
    assert read_evaluations(path) == []
    rows = [ROW, ROW._replace(timesteps=2000, subgoal_success=float("nan"))]
    write_evaluations(path, rows)
    assert path.read_text().splitlines()[0] == (
        "timesteps,success_rate,episodes,mean_length,subgoal_success,mean_window,wall_time"
    )
    back = read_evaluations(path)
    assert back[0] == ROW
    assert np.isnan(back[1].subgoal_success)
    path.write_text("steps,rate\n1,2\n")
    with pytest.raises(ValueError, match="must have the columns"):
        read_evaluations(path)


def test_an_interrupted_write_leaves_the_old_file(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    path = tmp_path / "final.json"
    write_atomic(path, "old")

    def fail(*_: Any, **__: Any) -> None:
        raise OSError(errno.ENOSPC, "No space left on device")

    monkeypatch.setattr(Path, "write_bytes", fail)
    with pytest.raises(WriteError, match=r"cannot write .*final.json: No space left on device; make room"):
        write_atomic(path, "new")
    assert path.read_text() == "old"


def test_a_folder_is_no_file_to_write(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    (tmp_path / "pages").mkdir()
    for path in (Path(), Path(".."), tmp_path / "pages", Path("/")):
        with pytest.raises(WriteError, match="it is a folder; name a file"):
            write_atomic(path, "page")
    assert [p.name for p in tmp_path.rglob("*")] == ["pages"]


def test_a_link_stays_one_when_its_file_is_replaced(tmp_path: Path) -> None:
    real, link, missing = tmp_path / "real" / "page.md", tmp_path / "page.md", tmp_path / "missing.md"
    real.parent.mkdir()
    real.write_text("old")
    link.symlink_to(Path("real") / "page.md")
    missing.symlink_to(Path("other") / "page.md")
    for path in (link, missing):
        write_atomic(path, "new")
        assert path.is_symlink()
    assert real.read_text() == (tmp_path / "other" / "page.md").read_text() == "new"
    assert [p.name for p in real.parent.iterdir()] == ["page.md"]


def test_what_is_synced_is_open_for_writing(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Windows syncs no file that is open for reading alone, and opens no folder; some file systems sync no folder."""
    fsync, synced = os.fsync, []

    def windows(handle: int) -> None:
        if stat.S_ISDIR(os.fstat(handle).st_mode):
            raise OSError(errno.EINVAL, "Invalid argument")
        os.write(handle, b"")  # fails on a handle for reading
        synced.append(handle)
        fsync(handle)

    monkeypatch.setattr(os, "fsync", windows)
    write_atomic(tmp_path / "a.txt", "a")
    assert len(synced) == 1

    def broken(handle: int) -> None:
        if stat.S_ISDIR(os.fstat(handle).st_mode):
            raise OSError(errno.EIO, "Input/output error")

    monkeypatch.setattr(os, "fsync", broken)
    with pytest.raises(WriteError, match="Input/output error"):
        write_atomic(tmp_path / "a.txt", "a")


def test_curve_summary() -> None:
    rows = [ROW._replace(success_rate=rate) for rate in (0.1, 0.95, 0.8, 1.0)]
    assert curve_summary(rows) == {
        "best_success_rate": 1.0,
        "stable_share": pytest.approx(2 / 3),
        "worst_after_first_90": 0.8,
    }
    assert curve_summary([])["best_success_rate"] is None


def test_two_writers_of_one_file_do_not_meet(tmp_path: Path) -> None:
    """Each of two threads replaces the file many times; every reader finds what one of them wrote."""
    path = tmp_path / "trials.csv"
    with ThreadPoolExecutor(2) as pool:
        list(pool.map(lambda text: [write_atomic(path, text * 20_000) for _ in range(100)], "ab"))
    assert path.read_text() in ("a" * 20_000, "b" * 20_000)
    assert [p.name for p in tmp_path.iterdir()] == ["trials.csv"]
