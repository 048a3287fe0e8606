"""Runs of the commands in child processes that can be killed at a chosen moment, and what such a run leaves behind."""

from __future__ import annotations

import csv
import io
import json
import os
import signal
import sys
import time
import zipfile
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import torch as th

from sb3_tbc import train

KILLED = 137
CHANGES = ("os.rename", "os.remove", "os.rmdir", "os.mkdir", "os.truncate", "os.link", "os.symlink")
WRITING = os.O_WRONLY | os.O_RDWR | os.O_CREAT | os.O_TRUNC | os.O_APPEND

SMALL = ["--no-progress", "--n-eval-episodes", "1", "--n-final-episodes", "1", "--hyperparams", "gradient_ratio:0.05"]
SMALL += ["low.batch_size:16", "high.batch_size:8", "compile:false"]
SMALL_FLAT = [*SMALL[:6], "gradient_ratio:0.05", "batch_size:16", "learning_starts:100"]
WATCHED = ["--no-progress", "--trace", "--keep-checkpoint", "--checkpoint-minutes", "0"]
NEVER_THE_SAME = ("wall_time", "steps_per_second")


def spawn(arguments: list[Any], log: Path, before: Callable[[], None] | None = None) -> int:
    """Begin ``train`` in a child process and return its id.

    :param before: called in the child first
    """
    child = os.fork()
    if child:
        return child
    status = 99
    try:
        output = os.open(log, os.O_WRONLY | os.O_CREAT | os.O_APPEND)
        os.dup2(output, 1)
        os.dup2(output, 2)
        sys.stdout, sys.stderr = os.fdopen(1, "w"), os.fdopen(2, "w")
        signal.signal(signal.SIGINT, signal.default_int_handler)
        th.set_num_threads(1)
        if before is not None:
            before()
        status = train.main([str(argument) for argument in arguments])
    except SystemExit as end:
        status = end.code if isinstance(end.code, int) else 1
    except BaseException:  # the log is all that is left of it
        import traceback

        traceback.print_exc()
    finally:
        sys.stdout.flush()
        sys.stderr.flush()
        os._exit(status)


def wait(child: int, seconds: float = 240.0) -> int:
    """Exit status of a child; minus the signal that killed it. One that hangs is killed, and that is an error."""
    until = time.monotonic() + seconds
    while time.monotonic() < until:
        done, status = os.waitpid(child, os.WNOHANG)
        if done:
            return os.waitstatus_to_exitcode(status)
        time.sleep(0.01)
    os.kill(child, signal.SIGKILL)
    os.waitpid(child, 0)
    raise TimeoutError(f"process {child} did not end within {seconds} s")


def run(arguments: list[Any], log: Path, before: Callable[[], None] | None = None) -> int:
    """Exit status of a ``train`` in a child process."""
    return wait(spawn(arguments, log, before))


def die_before_change(number: int, folder: Path, count: Path | None = None) -> Callable[[], None]:
    """For ``before``: die just before the ``number``-th system call that changes a folder, as ``kill -9`` does.

    :param number: counted from 1; 0 never dies
    :param count: where the number of changes is kept, one character each
    """

    def install() -> None:
        seen = 0
        counter = None if count is None else os.open(count, os.O_WRONLY | os.O_CREAT | os.O_APPEND)

        def hook(event: str, arguments: tuple[Any, ...]) -> None:
            nonlocal seen
            if not _changes(event, arguments, str(folder)):
                return
            seen += 1
            if counter is not None:
                os.write(counter, b".")
            if seen == number:
                os._exit(KILLED)

        sys.addaudithook(hook)

    return install


def _changes(event: str, arguments: tuple[Any, ...], folder: str) -> bool:
    if event == "open":
        path, _, flags = arguments
        return isinstance(path, str | Path) and str(path).startswith(folder) and bool((flags or 0) & WRITING)
    if event not in CHANGES:
        return False
    path = os.fsdecode(arguments[0]) if not isinstance(arguments[0], int) else ""
    return not os.path.isabs(path) or path.startswith(folder)  # relative: within a tree that is being removed


def the_run(root: Path) -> Path | None:
    """The only run below a log folder; None before there is one."""
    return next(iter(root.glob("*/*/*/seed_*")), None)


def finish(root: Path, arguments: list[Any], log: Path) -> Path:
    """Resume a run until it ends, or begin it again where nothing was saved yet, and return its folder."""
    folder = the_run(root)
    if folder is None or run(["--resume", folder, *WATCHED], log) != 0:
        status = run([*arguments, "--overwrite"], log)
        assert status == 0, log.read_text()[-2000:]
    folder = the_run(root)
    assert folder is not None
    return folder


def tensors(value: Any, name: str = "") -> dict[str, Any]:
    """All tensors and numbers of nested containers by their path."""
    found: dict[str, Any] = {}
    if isinstance(value, dict):
        for key, inner in value.items():
            found |= tensors(inner, f"{name}.{key}")
    elif isinstance(value, list | tuple):
        for index, inner in enumerate(value):
            found |= tensors(inner, f"{name}.{index}")
    elif isinstance(value, th.Tensor):
        found[name] = value.detach().numpy().tobytes()
    elif isinstance(value, int | float):
        found[name] = value
    return found


def recorded(name: str, array: Any, steps: Any) -> Any:
    """An array of a saved run without what lies behind the steps done in each environment, left of earlier episodes.

    :param steps: of the running episodes, ``(n_envs,)``
    """
    if ".recorder." not in name or array.ndim < 2 or name.endswith(".options"):
        return array
    done = np.arange(array.shape[1]) < np.asarray(steps)[:, None]
    return array[done]


def contents(folder: Path) -> dict[str, Any]:
    """All that must be the same in two runs of one seed: weights, optimisers, curves, result, options."""
    found: dict[str, Any] = {}
    for name in ("model.zip", "best_model.zip"):
        with zipfile.ZipFile(folder / name) as archive:
            for member in archive.namelist():
                if member.endswith(".pth"):
                    data = th.load(io.BytesIO(archive.read(member)), weights_only=True)
                    found |= {f"{name}:{member}{key}": value for key, value in tensors(data).items()}
    replay = folder / "checkpoint" / "replay_buffer.pkl"
    if replay.is_file():
        with np.load(replay, allow_pickle=False) as arrays:
            done = arrays.get("running.collector.recorder.steps", np.zeros(0, int))
            found |= {f"replay:{name}": recorded(name, arrays[name], done).tobytes() for name in arrays.files}
    with (folder / "evaluations.csv").open() as file:
        found["evaluations"] = [{k: v for k, v in row.items() if k != "wall_time"} for row in csv.DictReader(file)]
    result = json.loads((folder / "final.json").read_text())
    found["final"] = {key: value for key, value in result.items() if key not in NEVER_THE_SAME}
    if (folder / "options.csv").is_file():
        found["options"] = (folder / "options.csv").read_text()
    return found


def differences(one: Path, other: Path) -> list[str]:
    """Names of what is not the same in two runs."""
    a, b = contents(one), contents(other)
    return sorted(name for name in a.keys() | b.keys() if a.get(name) != b.get(name))
