"""Where commands write: closed, full and broken standard output, files that are named twice, and what is no file."""

from __future__ import annotations

import argparse
import io
import os
import subprocess
import sys
from importlib import import_module
from pathlib import Path
from typing import Any

import pytest
from made_up_runs import fake_run
from test_cli import said

from sb3_tbc import evaluate
from sb3_tbc.commands import COMMANDS, output_file, run_command
from sb3_tbc.errors import WriteError
from sb3_tbc.files import write_atomic


class Broken(io.StringIO):
    """Standard output whose reader has ended."""

    def write(self, text: str) -> int:
        raise BrokenPipeError(32, "Broken pipe")


@pytest.mark.parametrize(("given", "status"), [("--list", 0), ("--env Pendulm", 2)])
def test_standard_streams_may_be_closed(given: str, status: int) -> None:
    line = f'exec "$0" -m sb3_tbc.train {given} <&- >&-'
    done = subprocess.run(["sh", "-c", line, sys.executable], capture_output=True, text=True, timeout=120)
    assert (done.returncode, done.stderr.count("\n")) == (status, 1 if status else 0), done.stderr


@pytest.mark.skipif(not Path("/dev/full").exists(), reason="needs /dev/full")
def test_a_full_standard_output_is_one_line() -> None:
    with open("/dev/full", "w") as full:
        arguments = [sys.executable, "-m", "sb3_tbc.train", "--list"]
        done = subprocess.run(arguments, stdout=full, stderr=subprocess.PIPE, text=True, timeout=120)
    assert done.returncode == 2
    said = "sb3_tbc.train: error: cannot write the output: No space left on device; make room, then go on\n"
    assert done.stderr == said


def test_files_are_written_before_what_nobody_may_read(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(sys, "stdout", Broken())
    page = tmp_path / "report.html"
    fake_run(tmp_path, "Pendulum", "sac", 0, 0.5)
    assert import_module(COMMANDS["report"].module).main([str(tmp_path), "--html", str(page)]) == 1
    assert page.is_file()
    figures = {"algo": "sac", "variant": "full", "n_timesteps": 1, "task": "Pendulum", "success_rate": 1.0,
               "success_ci95": [0.2, 1.0], "n_episodes": 1, **dict.fromkeys(evaluate.FIGURES)}  # fmt: skip
    with pytest.raises(BrokenPipeError):
        evaluate._tell(figures, tmp_path / "figures.json")
    assert (tmp_path / "figures.json").is_file()


TWICE = [
    (["evaluate", "pretrained:Pendulum", "--json", "x.mp4", "--video", "./x.mp4"], "--json and --video"),
    (["evaluate", "model.zip", "--json", "model.zip"], "MODEL.zip and --json"),
    (["interpret", "pretrained:Pendulum", "--html", "link", "--png", "real"], "--png and --html"),
    (["report", "--update", "page.md", "--html", "page.md"], "--update and --html"),
    (["benchmark", "record", "model.zip", "--json", "x.npz", "--out", "x.npz"], "--out and --json"),
]


@pytest.mark.parametrize(("command", "named"), TWICE)
def test_two_outputs_are_two_files(
    command: list[str], named: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: Any
) -> None:
    monkeypatch.chdir(tmp_path)
    Path("model.zip").touch()
    Path("link").symlink_to("real")
    with pytest.raises(SystemExit) as stop:
        import_module(COMMANDS[command[0]].module).main(command[1:])
    assert stop.value.code == 2
    assert f"{named} name the same file" in said(capsys)
    assert sorted(path.name for path in tmp_path.iterdir()) == ["link", "model.zip"]


@pytest.mark.skipif(not hasattr(os, "mkfifo"), reason="needs pipes with names")
def test_a_device_or_a_pipe_is_not_replaced(tmp_path: Path) -> None:
    pipe = tmp_path / "pipe"
    os.mkfifo(pipe)
    (tmp_path / "link").symlink_to(pipe)
    for path in (pipe, tmp_path / "link"):
        with pytest.raises(argparse.ArgumentTypeError, match="it is a device or a pipe"):
            output_file(str(path))
        with pytest.raises(WriteError, match="it is a device or a pipe"):
            write_atomic(path, "text")
    assert pipe.is_fifo()


def test_a_name_that_is_no_text_is_one_line(capsys: pytest.CaptureFixture[str]) -> None:
    def refused(argv: object) -> int:
        os.fsdecode(b"l\xe4uf").encode()  # as TensorBoard does
        return 0

    assert run_command(refused, "sb3_tbc.train", []) == 2
    assert r"error: 'l\udce4uf' is no text, perhaps the name of a file; rename it, or set LC_ALL" in said(capsys)
