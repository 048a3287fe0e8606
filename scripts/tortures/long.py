"""One very long run with all that can be logged: does it grow, does it slow down, do its files?"""

from __future__ import annotations

import csv
import os
import time
from collections.abc import Sequence
from pathlib import Path
from typing import NamedTuple

from injection import spawn

STEPS = 5_000_000
SETTINGS = ["gradient_ratio:0.01", "high.buffer_size:100000", "low.buffer_size:100000"]
"""Few updates make five million steps affordable; buffers that are full after a fiftieth of them show what grows."""
SETTLED = 0.1
"""Share of the steps after which buffers are full and updates compiled: memory and speed are compared from there on."""
MEMORY, SPEED = 0.05, 0.10
"""Largest growth of memory, and largest loss of speed, that passes."""
FILES = 200e6
"""Bytes that a run's folder may hold, checkpoints included."""


class Sample(NamedTuple):
    """The process and its folder at one moment; memory and files in bytes, the rest in seconds."""

    steps: int
    wall: float
    cpu: float
    memory: int
    files: int


def torture_long(root: Path, number: int, first: int = 0) -> tuple[int, int]:
    """Five million steps on Drawbridge, or ``number``; there is but one trial."""
    steps = number or STEPS
    arguments = [
        *("--env", "Drawbridge", "--n-envs", 4, "--n-timesteps", steps, "--eval-freq", max(steps // 25, 1)),
        *("--n-eval-episodes", 4, "--n-final-episodes", 20, "--trace", "--tensorboard", "--no-progress"),
        *("--checkpoint-minutes", 2, "--keep-checkpoint", "--log-folder", root / "runs", "--hyperparams", *SETTINGS),
    ]
    samples = _watch(spawn(arguments, root / "log"), root)
    with (root / "samples.csv").open("w", newline="") as file:
        csv.writer(file).writerows([Sample._fields, *samples])
    return 1, int(_judge(samples, steps))


def _watch(child: int, root: Path) -> list[Sample]:
    samples: list[Sample] = []
    begun = time.monotonic()
    while True:
        done, status = os.waitpid(child, os.WNOHANG)
        if done:
            if status:
                print(f"   ended with status {status}: {(root / 'log').read_text()[-500:]}", flush=True)
                return []
            return samples
        folder = next((root / "runs").glob("*/*/*/seed_*"), None)
        steps = _steps(folder / "progress.csv") if folder else 0
        if steps > (samples[-1].steps if samples else 0):
            samples.append(Sample(steps, time.monotonic() - begun, *_process(child), _size(folder or root)))
            if len(samples) % 20 == 1:
                print(f"   {samples[-1]}", flush=True)
        time.sleep(5.0)


def _steps(path: Path) -> int:
    """The last step that was logged."""
    try:
        with path.open(newline="") as file:
            return max((int(row["time/total_timesteps"] or 0) for row in csv.DictReader(file)), default=0)
    except (OSError, KeyError, ValueError, TypeError):  # not there yet, or just being written
        return 0


def _process(child: int) -> tuple[float, int]:
    """CPU seconds and resident memory of a process."""
    fields = Path(f"/proc/{child}/stat").read_text().rpartition(")")[2].split()
    ticks, pages = int(fields[11]) + int(fields[12]), int(fields[21])
    return ticks / os.sysconf("SC_CLK_TCK"), pages * os.sysconf("SC_PAGE_SIZE")


def _size(folder: Path) -> int:
    total = 0
    for path in folder.rglob("*"):
        try:
            total += path.stat().st_size
        except FileNotFoundError:  # a checkpoint that has just been replaced
            continue
    return total


def _judge(samples: Sequence[Sample], steps: int) -> bool:
    """Compare the beginning and the end of what comes after :data:`SETTLED`, a quarter of it each."""
    settled = [s for s in samples if s.steps > SETTLED * steps]
    if len(settled) < 8:
        print(f"   only {len(settled)} samples", flush=True)
        return False
    quarter = len(settled) // 4
    first, last = settled[: quarter + 1], settled[-quarter - 1 :]
    grown = max(s.memory for s in last) / max(s.memory for s in first) - 1.0
    speed = _per_cpu_second(last) / _per_cpu_second(first) - 1.0
    wall = (last[-1].steps - last[0].steps) / (last[-1].wall - last[0].wall)
    half = settled[len(settled) // 2]  # both checkpoints are there
    per_million = (settled[-1].files - half.files) / (settled[-1].steps - half.steps) * 1e6
    megabytes = f"{first[0].memory / 1e6:.0f} to {last[-1].memory / 1e6:.0f} MB"
    print(
        f"   {len(samples)} samples: memory {megabytes}, {grown:+.1%}; "
        f"steps per CPU second {speed:+.1%} (now {_per_cpu_second(last):.0f}; {wall:.0f} per second of the clock), "
        f"folder {settled[-1].files / 1e6:.1f} MB, {per_million / 1e6:+.2f} MB per million steps",
        flush=True,
    )
    return abs(grown) < MEMORY and speed > -SPEED and settled[-1].files < FILES


def _per_cpu_second(samples: Sequence[Sample]) -> float:
    return (samples[-1].steps - samples[0].steps) / (samples[-1].cpu - samples[0].cpu)
