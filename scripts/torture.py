"""Rerun the table of docs/reliability.md: runs that are killed, stopped or out of disk space, and damaged inputs.

    python scripts/torture.py changes            killed before every system call that changes the run's folder
    python scripts/torture.py kill --number 100  kill -9 at random moments
    python scripts/torture.py stop --number 50   SIGTERM, SIGINT and SIGHUP at random moments
    python scripts/torture.py disk               a full disk, at growing sizes of the largest file that can be written
    python scripts/torture.py twice              two runs of one seed
    python scripts/torture.py fuzz --number 1000 damaged agents, checkpoints, replay files and YAML
    python scripts/torture.py all

Each prints one line: what, tried, survived with nothing lost, and the command.
"""

from __future__ import annotations

import argparse
import contextlib
import logging
import os
import random
import resource
import shutil
import signal
import sys
import tempfile
import time
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

sys.path.insert(0, str(Path(__file__).parents[1] / "tests" / "reliability"))

from injection import (
    SMALL,
    SMALL_FLAT,
    WATCHED,
    die_before_change,
    differences,
    finish,
    run,
    spawn,
    wait,
)

from sb3_tbc.errors import ConfigError
from sb3_tbc.zoo.algorithms import load_model
from sb3_tbc.zoo.checkpoints import read_checkpoint
from sb3_tbc.zoo.config import parse_overrides, read_file

CASES = [(algo, n_envs) for algo in ("tbc-hrl", "hits", "hac") for n_envs in (1, 4)]
"""Algorithms and numbers of environments that take turns."""


def arguments_of(algo: str, n_envs: int, seed: int = 0) -> list[Any]:
    """A short training run, with all that is watched."""
    steps = 900 * n_envs
    watched = ["--n-timesteps", steps, "--eval-freq", steps // 2, "--n-envs", n_envs, "--seed", seed]
    return ["--env", "Pendulum", "--algo", algo, *watched, *WATCHED, *(SMALL_FLAT if algo == "sac" else SMALL)]


class Undisturbed:
    """Undisturbed runs, each made once."""

    def __init__(self, root: Path) -> None:
        self.root = root
        self._seconds: dict[tuple[str, int], float] = {}

    def get(self, algo: str, n_envs: int) -> tuple[Path, float]:
        """Folder and duration of the undisturbed run."""
        root = self.root / f"whole-{algo}-{n_envs}"
        begun = time.monotonic()
        if (algo, n_envs) not in self._seconds:
            arguments = [*arguments_of(algo, n_envs), "--log-folder", root / "runs"]
            root.mkdir(parents=True)
            if run(arguments, root / "log") != 0:
                raise RuntimeError((root / "log").read_text()[-2000:])
            self._seconds[algo, n_envs] = time.monotonic() - begun
        return next((root / "runs").glob("*/*/*/seed_*")), self._seconds[algo, n_envs]


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


def torture_changes(root: Path, number: int) -> tuple[int, int]:
    """Killed before every system call that changes the folder; ``number`` limits how many are tried, 0 for all."""
    whole, _ = Undisturbed(root).get("tbc-hrl", 1)
    arguments = arguments_of("tbc-hrl", 1)
    (root / "counted").mkdir()
    counted = [*arguments, "--log-folder", root / "counted" / "runs"]
    run(counted, root / "counted" / "log", die_before_change(0, root / "counted" / "runs", root / "count"))
    changes = (root / "count").stat().st_size
    chosen = range(1, changes + 1)
    good = 0
    for change in list(chosen)[:: max(1, changes // number) if number else 1]:
        folder = root / f"change-{change}"
        folder.mkdir()
        full = [*arguments, "--log-folder", folder / "runs"]
        run(full, folder / "log", die_before_change(change, folder / "runs"))
        good += compare(whole, folder, full, f"killed before change {change} of {changes}")
    return len(list(chosen)[:: max(1, changes // number) if number else 1]), good


def _struck(root: Path, number: int, signals: Sequence[int], allowed: Sequence[int]) -> tuple[int, int]:
    undisturbed, good = Undisturbed(root), 0
    rng = random.Random(0)
    for k in range(number):
        algo, n_envs = CASES[k % len(CASES)]
        whole, seconds = undisturbed.get(algo, n_envs)
        folder = root / f"struck-{k}"
        folder.mkdir()
        arguments = [*arguments_of(algo, n_envs), "--log-folder", folder / "runs"]
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


def torture_kill(root: Path, number: int) -> tuple[int, int]:
    """``kill -9`` at random moments."""
    return _struck(root, number or 100, [signal.SIGKILL], [-signal.SIGKILL, 0])


def torture_stop(root: Path, number: int) -> tuple[int, int]:
    """Stopped at random moments; a signal before the command handles signals ends it like any program."""
    stops = [signal.SIGTERM, signal.SIGINT, signal.SIGHUP]
    return _struck(root, number or 50, stops, [130, 0, 1, 99, *(-stop for stop in stops)])


def torture_disk(root: Path, number: int) -> tuple[int, int]:
    """Limit the size of files: the run ends with one line, keeps its checkpoint, and resumes when there is room."""
    whole, _ = Undisturbed(root).get("tbc-hrl", 1)
    limits = [500, 5_000, 50_000, 90_000, 120_000, 150_000, 180_000, 220_000, 260_000, 300_000][: number or None]
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
    return len(limits), good


def _starved(limit: int) -> Callable[[], None]:
    def begin() -> None:
        signal.signal(signal.SIGXFSZ, signal.SIG_IGN)
        _, most = resource.getrlimit(resource.RLIMIT_FSIZE)
        resource.setrlimit(resource.RLIMIT_FSIZE, (limit, most))

    return begin


def torture_twice(root: Path, number: int) -> tuple[int, int]:
    """Two runs of one seed, all algorithms."""
    cases = [*CASES, ("sac", 1), ("sac", 4)][: number or None]
    first, second = Undisturbed(root / "first"), Undisturbed(root / "second")
    good = 0
    for algo, n_envs in cases:
        found = differences(first.get(algo, n_envs)[0], second.get(algo, n_envs)[0])
        good += not found
        if found:
            print(f"   {algo}, {n_envs} environments: {found[:5]}", flush=True)
    return len(cases), good


def torture_fuzz(root: Path, number: int) -> tuple[int, int]:
    """Truncated, altered and invented files: they are refused with one line or read."""
    whole, _ = Undisturbed(root).get("tbc-hrl", 1)
    rng, good, number = random.Random(0), 0, number or 1000
    model, checkpoint = whole / "model.zip", whole / "checkpoint"
    config = (whole / "config.yml").read_bytes()
    (root / "broken").mkdir()
    for k in range(number):
        target = root / "broken" / "file"
        kind = ("agent", "checkpoint", "yaml", "override")[k % 4]
        try:
            if kind == "agent":
                target.write_bytes(_damaged(model.read_bytes(), rng))
                load_model(target)
            elif kind == "checkpoint":
                copy = root / "broken" / "checkpoint"
                shutil.rmtree(copy, ignore_errors=True)
                shutil.copytree(checkpoint, copy)
                victim = rng.choice(sorted(copy.iterdir()))
                victim.write_bytes(_damaged(victim.read_bytes(), rng))
                read_checkpoint(copy)
                raise RuntimeError(f"damage of {victim.name} was not noticed")
            elif kind == "yaml":
                target.write_bytes(_damaged(config, rng))
                read_file(target)
            else:
                parse_overrides([_damaged(b"low.gamma:0.9 {a: [1, 2]} &x *x !!python/x", rng).decode(errors="replace")])
        except ConfigError:
            pass
        except Exception as error:
            print(f"   {kind}: {type(error).__name__}: {error}"[:300], flush=True)
            continue
        good += 1
    return number, good


def _damaged(content: bytes, rng: random.Random) -> bytes:
    """A damaged copy of a file: truncated, with flipped bits, or with a piece moved; never equal to the file."""
    changed = bytearray(content)
    way = rng.randrange(3)
    if way == 0:
        return content[: rng.randrange(len(content))]
    if way == 1:
        for _ in range(rng.randint(1, 8)):
            changed[rng.randrange(len(changed))] ^= 1 << rng.randrange(8)
    else:
        begin, length = rng.randrange(len(content)), rng.randint(1, 200)
        place = rng.randrange(len(content))
        changed[place:place] = content[begin : begin + length]
    return bytes(changed) if bytes(changed) != content else content[:-1]


TORTURES = {
    "changes": torture_changes,
    "kill": torture_kill,
    "stop": torture_stop,
    "disk": torture_disk,
    "twice": torture_twice,
    "fuzz": torture_fuzz,
}


def main() -> int:
    """Run the requested tests; return 0 if all passed."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("what", choices=[*TORTURES, "all"])
    parser.add_argument("--number", type=int, default=0, help="how many; by default as the table says")
    parser.add_argument("--folder", type=Path, help="for the runs; by default a temporary one")
    args = parser.parse_args()
    logging.disable(logging.WARNING)
    all_good = True
    for what in TORTURES if args.what == "all" else [args.what]:
        root = Path(tempfile.mkdtemp(prefix=f"torture-{what}-", dir=args.folder))
        tried, survived = TORTURES[what](root, args.number)
        all_good &= tried == survived
        number = f" --number {args.number}" if args.number else ""
        print(f"| {what} | {tried} | {survived} | `python scripts/torture.py {what}{number}` |", flush=True)
        if tried == survived:
            shutil.rmtree(root)
    return 0 if all_good else 1


if __name__ == "__main__":
    sys.exit(main())
