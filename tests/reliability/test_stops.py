"""A run that is stopped by a signal, or ended by a fault, saves a point from which it goes on as if undisturbed."""

from __future__ import annotations

import os
import re
import signal
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
from injection import SMALL, SMALL_FLAT, differences, finish, run, spawn, the_run, wait

from sb3_tbc.errors import ConfigError, FolderInUseError
from sb3_tbc.files import locked
from sb3_tbc.zoo import callbacks
from sb3_tbc.zoo.checkpoints import find_checkpoint

ARGUMENTS = ["--env", "Pendulum", "--n-timesteps", 1500, "--eval-freq", 500, "--trace", "--keep-checkpoint", *SMALL]


@pytest.fixture(scope="module")
def undisturbed(tmp_path_factory: pytest.TempPathFactory) -> Path:
    root = tmp_path_factory.mktemp("undisturbed")
    assert run([*ARGUMENTS, "--log-folder", root / "runs"], root / "log") == 0, (root / "log").read_text()
    folder = the_run(root / "runs")
    assert folder is not None
    return folder


@pytest.mark.parametrize("number", [signal.SIGTERM, signal.SIGHUP])
def test_stopped_by_a_signal(number: int, undisturbed: Path, tmp_path: Path) -> None:
    """A second signal does not lose what the first one saves; --checkpoint-minutes inf saves when stopped."""
    arguments = [*ARGUMENTS, "--log-folder", tmp_path / "runs", "--checkpoint-minutes", "inf"]
    child = spawn(arguments, tmp_path / "log")
    until = time.monotonic() + 100
    curve = "runs/*/*/*/seed_*/evaluations.csv"  # its first line is the header
    while not any(len(p.read_text().splitlines()) > 1 for p in tmp_path.glob(curve)) and time.monotonic() < until:
        time.sleep(0.01)
    os.kill(child, number)
    time.sleep(0.02)
    os.kill(child, signal.SIGINT)
    assert wait(child) == 130
    text = (tmp_path / "log").read_text()
    line = r"continue with: \S*python -m sb3_tbc.train --resume \S+seed_0 --trace --checkpoint-minutes inf\n"
    assert re.search(line, text)
    folder = the_run(tmp_path / "runs")
    assert folder is not None
    stopped = find_checkpoint(folder)
    assert stopped is not None
    assert 500 <= stopped.timesteps < 1500
    assert not differences(undisturbed, finish(tmp_path / "runs", arguments, tmp_path / "log"))


def stop_in_evaluation(number: int) -> Callable[[], None]:
    """For ``before``: ask for a stop while the ``number``-th evaluation within training begins its episodes."""

    def install() -> None:
        evaluate, seen = callbacks.evaluate_agent, 0

        def watched(*arguments: Any, **options: Any) -> Any:
            nonlocal seen
            seen += 1
            if seen == number:
                os.kill(os.getpid(), signal.SIGTERM)
            return evaluate(*arguments, **options)

        callbacks.evaluate_agent = watched  # type: ignore[assignment]

    return install


@pytest.mark.parametrize("algo", ["tbc-hrl", "sac"])
def test_an_evaluation_is_given_up_and_done_by_the_resumed_run(algo: str, tmp_path: Path) -> None:
    """At the first and the last, and again where the resumed run makes up for it: nothing is left out or changed."""
    small = SMALL_FLAT if algo == "sac" else SMALL
    arguments = ["--algo", algo, "--env", "faulty:FaultyCorridor-v0", "--n-timesteps", 400, "--eval-freq", 200, *small]
    arguments += ["--trace", "--keep-checkpoint", "--log-folder"]
    log = tmp_path / "log"
    assert run([*arguments, tmp_path / "whole"], log) == 0, log.read_text()
    assert run([*arguments, tmp_path / "runs"], log, stop_in_evaluation(1)) == 130
    whole, folder = the_run(tmp_path / "whole"), the_run(tmp_path / "runs")
    assert whole is not None
    assert folder is not None
    assert len((folder / "evaluations.csv").read_text().splitlines()) == 1
    resume = ["--resume", folder, "--trace", "--keep-checkpoint", "--no-progress"]
    for number, rows in ((2, 1), (1, 1)):
        assert run(resume, log, stop_in_evaluation(number)) == 130
        assert len((folder / "evaluations.csv").read_text().splitlines()) == 1 + rows
    assert run(resume, log) == 0, log.read_text()
    assert not differences(whole, folder)


def test_a_damaged_checkpoint_is_named_and_the_one_before_is_taken(
    undisturbed: Path, tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    arguments = [*ARGUMENTS, "--log-folder", tmp_path / "runs", "--checkpoint-minutes", 0]
    assert run(arguments, tmp_path / "log") == 0
    folder = the_run(tmp_path / "runs")
    assert folder is not None
    (folder / "final.json").unlink()
    (folder / "model.zip").unlink()
    replay = folder / "checkpoint" / "replay_buffer.pkl"
    content = bytearray(replay.read_bytes())
    content[len(content) // 2] ^= 1
    replay.write_bytes(content)
    before = find_checkpoint(folder)
    assert "replay_buffer.pkl is damaged: it fails its checksum; resuming from the previous checkpoint" in caplog.text
    assert before is not None
    assert before.path.name == "checkpoint.old"
    assert not differences(undisturbed, finish(tmp_path / "runs", arguments, tmp_path / "log"))
    for path in (*folder.glob("checkpoint*/state.json"),):
        path.write_text("{}")
    with pytest.raises(ConfigError, match=r"no undamaged checkpoint: .*state.json is damaged"):
        find_checkpoint(folder)


def test_a_run_is_the_only_one_in_its_folder(tmp_path: Path) -> None:
    """The lock ends with the process that holds it, however that ends."""
    child = os.fork()
    if not child:
        with locked(tmp_path):
            (tmp_path / "held").touch()
            time.sleep(60)
        os._exit(0)
    while not (tmp_path / "held").exists():
        time.sleep(0.01)
    with pytest.raises(FolderInUseError, match=f"is in use by process {child}"), locked(tmp_path):
        pass
    os.kill(child, signal.SIGKILL)
    os.waitpid(child, 0)
    with locked(tmp_path):
        assert (tmp_path / ".lock").read_text() == f"{os.getpid()}\n"
    assert not (tmp_path / ".lock").exists()
