"""How long runs will take, from the speeds of those that are finished."""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Callable, Sequence
from pathlib import Path
from statistics import median

from sb3_tbc.aliases import Plain
from sb3_tbc.campaign.jobs import Job
from sb3_tbc.zoo.environments import resolve_env
from sb3_tbc.zoo.ledger import finished_runs

Speeds = dict[tuple[str, str], float]
"""Task and algorithm, or task and an empty text for all of its algorithms -> environment steps per second."""


def measured_speeds(ledger: Path) -> Speeds:
    """Median environment steps per second of finished runs, per task and algorithm and per task."""
    found: dict[tuple[str, str], list[float]] = defaultdict(list)
    for folder in finished_runs(ledger):
        final: Plain = folder.read_final()
        speed = final.get("steps_per_second")
        if isinstance(speed, int | float) and speed > 0:
            for key in ((str(final["task"]), str(final["algo"])), (str(final["task"]), "")):
                found[key].append(float(speed))
    return {key: median(speeds) for key, speeds in found.items()}


def hours_of(job: Job, speeds: Speeds) -> float | None:
    """Hours that a run takes; ``None`` if the ledger has no run of its task."""
    task, _ = resolve_env(job.env)
    speed = speeds.get((task, job.algo)) or speeds.get((task, ""))
    return job.n_timesteps / speed / 3600 if speed else None


def plan(todo: Sequence[Job], workers: int, speeds: Speeds, name: Callable[[Job], str]) -> list[str]:
    """What ``--dry-run`` prints: every run with its hours, and the sum."""
    hours = [hours_of(job, speeds) for job in todo]
    lines = [
        f"to do   {name(job)}   {job.n_timesteps:,} steps, {'hours unknown' if h is None else f'{h:.2f} h'}"
        for job, h in zip(todo, hours, strict=True)
    ]
    known = [h for h in hours if h is not None]
    total = f"{len(todo)} runs, {sum(known):.1f} hours of one core at the speeds of the ledger's finished runs"
    total += f"; about {sum(known) / workers:.1f} hours with {workers} at a time" if workers > 1 else ""
    unknown = len(hours) - len(known)
    return [*lines, total + (f"; {unknown} runs of unknown length" if unknown else "")]
