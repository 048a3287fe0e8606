"""Runs that are killed, stopped, starved, cut in halves: each must end as one that nothing happened to."""

from __future__ import annotations

import contextlib
import os
import random
import resource
import shutil
import signal
import subprocess
import time
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

from halves import by_command, by_python
from injection import SMALL, SMALL_FLAT, WATCHED, die_before_change, differences, finish, run, spawn, wait

CASES = [(algo, n_envs) for algo in ("tbc-hrl", "hits", "hac", "sac") for n_envs in (1, 4)]
"""Algorithms and numbers of environments that take turns."""


def arguments_of(algo: str, n_envs: int, compile: bool = False, task: str = "Pendulum") -> list[Any]:
    """A short training run, with all that is watched; on the corridor, shorter and with more checkpoints."""
    steps = (900 if task == "Pendulum" else 150) * n_envs
    watched = ["--n-timesteps", steps, "--eval-freq", steps // 2, "--n-envs", n_envs, *WATCHED]
    small = (
        SMALL_FLAT if algo == "sac" else [s.replace("compile:false", f"compile:{str(compile).lower()}") for s in SMALL]
    )
    small = [*small, "buffer_size:5000"] if algo == "sac" else small
    return ["--env", task, "--algo", algo, *watched, *small]


CORRIDOR = "faulty:FaultyCorridor-v0"
"""A task whose episodes take a dozen steps; nothing fails in it here."""


class Undisturbed:
    """Runs that nothing happens to, each made once."""

    def __init__(self, root: Path) -> None:
        self.root = root
        self._seconds: dict[Path, float] = {}

    def get(self, algo: str, n_envs: int, compile: bool = False, task: str = "Pendulum") -> tuple[Path, float]:
        """Its folder, and how long it took."""
        root = self.root / f"whole-{algo}-{n_envs}-{'compiled' if compile else 'eager'}-{task[:5]}"
        begun = time.monotonic()
        if root not in self._seconds:
            arguments = [*arguments_of(algo, n_envs, compile, task), "--log-folder", root / "runs"]
            root.mkdir(parents=True)
            if run(arguments, root / "log") != 0:
                raise RuntimeError((root / "log").read_text()[-2000:])
            self._seconds[root] = time.monotonic() - begun
        return next((root / "runs").glob("*/*/*/seed_*")), self._seconds[root]


def compare(whole: Path, root: Path, arguments: list[Any], name: str) -> bool:
    """Finish a disturbed run and compare it with the undisturbed one."""
    try:
        found = differences(whole, finish(root / "runs", arguments, root / "log"))
    except (AssertionError, TimeoutError, OSError, KeyError, ValueError) as error:
        found = [f"{type(error).__name__}: {error}"]
    if found:
        print(f"   {name}: {found[:5]}   ({root})", flush=True)
    else:
        shutil.rmtree(root)
    return not found


def torture_changes(root: Path, number: int, first: int) -> tuple[int, int]:
    """Killed before every system call that changes the folder, beginning with the ``first``; at most ``number``."""
    whole, _ = Undisturbed(root).get("tbc-hrl", 1)
    arguments = arguments_of("tbc-hrl", 1)
    (root / "counted").mkdir()
    counted = [*arguments, "--log-folder", root / "counted" / "runs"]
    run(counted, root / "counted" / "log", die_before_change(0, root / "counted" / "runs", root / "count"))
    changes = (root / "count").stat().st_size
    chosen = range(first + 1, min(changes, first + number if number else changes) + 1)
    good = 0
    for change in chosen:
        folder = root / f"change-{change}"
        folder.mkdir()
        full = [*arguments, "--log-folder", folder / "runs"]
        run(full, folder / "log", die_before_change(change, folder / "runs"))
        good += compare(whole, folder, full, f"killed before change {change} of {changes}")
    print(f"   changes {chosen.start} to {chosen.stop - 1} of {changes}", flush=True)
    return len(chosen), good


def _struck(root: Path, number: int, first: int, signals: Sequence[int], allowed: Sequence[int]) -> tuple[int, int]:
    undisturbed, good = Undisturbed(root), 0
    for k in range(first, first + number):
        rng = random.Random(k)
        algo, n_envs = CASES[k % len(CASES)]
        whole, seconds = undisturbed.get(algo, n_envs, task=CORRIDOR)
        folder = root / f"struck-{k}"
        folder.mkdir()
        arguments = [*arguments_of(algo, n_envs, task=CORRIDOR), "--log-folder", folder / "runs"]
        child = spawn(arguments, folder / "log")
        time.sleep(rng.uniform(0.0, seconds))
        number_of_signal = signals[k % len(signals)]
        with contextlib.suppress(ProcessLookupError):
            os.kill(child, number_of_signal)
        status = wait(child)
        name = f"{algo}, {n_envs} environments, signal {number_of_signal}, exit status {status}"
        same = compare(whole, folder, arguments, name)
        good += same and status in allowed
    return number, good


def torture_kill(root: Path, number: int, first: int) -> tuple[int, int]:
    """``kill -9`` at random moments."""
    return _struck(root, number or 100, first, [signal.SIGKILL], [-signal.SIGKILL, 0])


def torture_stop(root: Path, number: int, first: int) -> tuple[int, int]:
    """Stopped at random moments; those that come before the command listens end it as any program."""
    stops = [signal.SIGTERM, signal.SIGINT, signal.SIGHUP]
    return _struck(root, number or 50, first, stops, [130, 0, 1, 99, *(-stop for stop in stops)])


def torture_disk(root: Path, number: int, first: int) -> tuple[int, int]:
    """No file may grow beyond a limit: one line, the earlier checkpoint whole, and it goes on where there is room."""
    whole, _ = Undisturbed(root).get("tbc-hrl", 1)
    whole_size = sum(path.stat().st_size for path in whole.rglob("*") if path.is_file())
    largest = max(path.stat().st_size for path in whole.rglob("*") if path.is_file())
    limits = [int(largest * (k + 1) / STEPS_OF_LIMITS) for k in range(STEPS_OF_LIMITS)][first:][: number or None]
    good = 0
    for limit in limits:
        folder = root / f"disk-{limit}"
        folder.mkdir()
        arguments = [*arguments_of("tbc-hrl", 1), "--log-folder", folder / "runs"]
        status = run(arguments, folder / "log", _starved(limit))
        text = (folder / "log").read_text()
        told = status == 0 or (status == 2 and "Traceback" not in text and "cannot write" in text)
        if not told:
            print(f"   limit {limit}: exit status {status}, {text[-300:]}", flush=True)
        good += compare(whole, folder, arguments, f"limit {limit}, exit status {status}") and told
    rooms = [int(1.2 * whole_size * (k + 1) / STEPS_OF_LIMITS) for k in range(STEPS_OF_LIMITS)] if number == 0 else []
    return len(limits) + len(rooms), good + sum(_in_a_small_place(whole, root, room) for room in rooms)


STEPS_OF_LIMITS = 30
"""So many sizes of the largest file, and of the whole disk, from nothing to more than enough."""


def _in_a_small_place(whole: Path, root: Path, room: int) -> bool:
    """A file system of so many bytes: full, then made larger."""
    place, log = root / f"room-{room}", root / f"room-{room}.log"
    place.mkdir()
    if subprocess.run(["mount", "-t", "tmpfs", "-o", f"size={room}", "none", place], capture_output=True).returncode:
        print("   file systems cannot be mounted here", flush=True)
        return False
    try:
        arguments = [*arguments_of("tbc-hrl", 1), "--log-folder", place / "runs"]
        status = run(arguments, log)
        text = log.read_text()
        told = status == 0 or (status == 2 and "Traceback" not in text and "cannot write" in text)
        subprocess.run(["mount", "-o", f"remount,size={room + 50_000_000}", place], check=True, capture_output=True)
        found = differences(whole, finish(place / "runs", arguments, log))
        if found or not told:
            print(f"   {room} bytes: exit status {status}, {text[-300:]}, {found[:3]}", flush=True)
        return told and not found
    finally:
        subprocess.run(["umount", place], capture_output=True)


def _starved(limit: int) -> Callable[[], None]:
    def begin() -> None:
        signal.signal(signal.SIGXFSZ, signal.SIG_IGN)
        _, most = resource.getrlimit(resource.RLIMIT_FSIZE)
        resource.setrlimit(resource.RLIMIT_FSIZE, (limit, most))

    return begin


def torture_twice(root: Path, number: int, first: int) -> tuple[int, int]:
    """Two runs of one seed: all algorithms, 1 and 4 environments, eager and compiled."""
    cases = [(*case, compile) for compile in (False, True) for case in CASES][first:][: number or None]
    one, other = Undisturbed(root / "first"), Undisturbed(root / "second")
    good = 0
    for case in cases:
        found = differences(one.get(*case)[0], other.get(*case)[0])
        good += not found
        if found:
            print(f"   {case}: {found[:5]}", flush=True)
    return len(cases), good


def torture_halves(root: Path, number: int, first: int) -> tuple[int, int]:
    """2N = N + resume + N: all algorithms, 1 and 4 environments, eager and compiled, by command and by Python."""
    ways = {"command": by_command, "Python": by_python}
    cases = [(way, *case, compile) for compile in (False, True) for way in ways for case in CASES]
    cases, good = cases[first:][: number or None], 0
    for way, algo, n_envs, compile in cases:
        found = ways[way](root / f"{way}-{algo}-{n_envs}-{compile}", algo, n_envs, compile)
        good += not found
        print(f"   by {way}: {algo}, {n_envs} environments, compile={compile}: {found[:5] or 'equal'}", flush=True)
    return len(cases), good
