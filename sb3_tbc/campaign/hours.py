"""How long runs will take: from measured speeds of training and of evaluation, else from those of finished runs."""

from __future__ import annotations

import heapq
from collections import defaultdict
from collections.abc import Sequence
from pathlib import Path
from statistics import fmean, median
from typing import NamedTuple

from sb3_tbc.aliases import Plain
from sb3_tbc.campaign.jobs import Job
from sb3_tbc.errors import ConfigError
from sb3_tbc.reading import read_yaml
from sb3_tbc.zoo.config import OF_PAPER
from sb3_tbc.zoo.environments import resolve_env
from sb3_tbc.zoo.ledger import RunFolder, finished_runs

SPEEDS = "speeds.yml"
"""In the ledger: task -> method -> ``train`` and ``evaluate``, environment steps per second of one core without the
other; ``scripts/speeds.py`` measures them."""

Rows = dict[tuple[str, str], float]
"""Task and method, or task and an empty text for all of its methods -> a figure."""


class Speeds(NamedTuple):
    """What is known of the speed of each task and method."""

    train: Rows  # environment steps per second of training alone
    evaluate: Rows  # of evaluations alone
    episode: Rows  # mean steps of an evaluated episode
    whole: Rows  # of finished runs, evaluations included, in which other settings may have been in force


def read_speeds(ledger: Path) -> Speeds:
    """Measured speeds of a ledger.

    :raises ConfigError: if ``speeds.yml`` cannot be read
    """
    train: Rows = {}
    evaluate: Rows = {}
    path = ledger / SPEEDS
    try:
        for task, methods in (read_yaml(path) if path.is_file() else {}).items():
            for method, row in methods.items():
                train[task, method], evaluate[task, method] = float(row["train"]), float(row["evaluate"])
    except (AttributeError, KeyError, TypeError, ValueError) as error:
        raise ConfigError(f"{path} must have task: method: {{train: ..., evaluate: ...}}; got {error!r}") from error
    return Speeds(train, evaluate, *_of_finished_runs(ledger))


def _of_finished_runs(ledger: Path) -> tuple[Rows, Rows]:
    """Mean length of evaluated episodes, and median environment steps per second."""
    lengths: dict[tuple[str, str], list[float]] = defaultdict(list)
    speeds: dict[tuple[str, str], list[float]] = defaultdict(list)
    for folder in finished_runs(ledger):
        final = _result(folder)
        speed, length = final.get("steps_per_second"), _mean_length(folder)
        for key in ((str(final.get("task")), str(final.get("algo"))), (str(final.get("task")), "")):
            if isinstance(speed, int | float) and speed > 0:
                speeds[key].append(float(speed))
            if length is not None:
                lengths[key].append(length)
    return {key: fmean(found) for key, found in lengths.items()}, {key: median(found) for key, found in speeds.items()}


def _result(folder: RunFolder) -> Plain:
    """A run's result; one that cannot be read, which a report refuses, tells nothing."""
    try:
        return folder.read_final()
    except ConfigError:
        return {}


def _mean_length(folder: RunFolder) -> float | None:
    """Mean steps of a run's evaluated episodes; a curve that cannot be read, which a report refuses, counts as none."""
    try:
        rows = folder.read_evaluations()
    except ConfigError:
        return None
    return fmean(row.mean_length for row in rows) if rows else None


def hours_of(job: Job, speeds: Speeds) -> float | None:
    """Hours that a run still takes, see :func:`without_evaluations`; ``None`` if nothing is known of its task."""
    left = job.steps_left / job.n_timesteps if job.n_timesteps else 1.0
    key = _measured(job, speeds)
    if key is not None:
        evaluated = job.episodes_left * _episode(job, speeds) / speeds.evaluate[key]
        return (left * job.n_timesteps / speeds.train[key] + evaluated) / 3600
    speed = _of_task(job, speeds.whole)
    return left * job.n_timesteps / speed / 3600 if speed else None


def without_evaluations(job: Job, speeds: Speeds) -> bool:
    """Whether a run's hours lack its evaluations, because no finished run tells how long their episodes are."""
    return bool(job.n_episodes and _measured(job, speeds) and not _episode(job, speeds))


def _measured(job: Job, speeds: Speeds) -> tuple[str, str] | None:
    """The row of the measured speeds that is nearest to a run."""
    task, _ = resolve_env(job.env)
    of_paper = [f"{job.algo} full{OF_PAPER}"] if job.variant.endswith(OF_PAPER) else []
    methods = [f"{job.algo} {job.variant}", *of_paper, job.algo]
    return next(((task, method) for method in methods if (task, method) in speeds.train), None)


def _episode(job: Job, speeds: Speeds) -> float:
    """Mean steps of an evaluated episode, 0 if it is unknown."""
    return _of_task(job, speeds.episode) or 0.0


def _of_task(job: Job, rows: Rows) -> float | None:
    """A figure of the run's method, or else of its task."""
    task, _ = resolve_env(job.env)
    return rows.get((task, job.algo)) or rows.get((task, ""))


def hours_together(hours: Sequence[float], workers: int) -> float:
    """Hours until the last of several runs ends, of which ``workers`` are carried out at a time, in this order."""
    ends = [0.0] * workers
    for each in hours:
        heapq.heapreplace(ends, ends[0] + each)  # it begins when the first of those at work ends
    return max(ends)


def _steps(job: Job) -> str:
    whole = f"{job.n_timesteps:,} steps"
    return whole if job.steps_left == job.n_timesteps else f"{job.steps_left:,} of {whole} left"


def plan(todo: Sequence[Job], workers: int, speeds: Speeds) -> list[str]:
    """What ``--dry-run`` prints: every run with its hours, and the sum."""
    hours = [hours_of(job, speeds) for job in todo]
    lines = [
        f"to do   {job.name}   {_steps(job)}, {'hours unknown' if h is None else f'{h:.2f} h'}"
        for job, h in zip(todo, hours, strict=True)
    ]
    known = [h for h in hours if h is not None]
    if todo and not known:
        cure = f"no {SPEEDS} and no finished run of these tasks in the folder that --ledger names"
        return [*lines, f"{len(todo)} runs, hours unknown: {cure}"]
    bare = sum(without_evaluations(job, speeds) for job in todo)
    total = f"{len(todo)} runs, {sum(known):.1f} hours of one core at measured speeds, evaluations included"
    total += f" except those of {bare} runs, whose episodes' length is unknown" if bare else ""
    total += f"; about {hours_together(known, workers):.1f} hours with {workers} at a time" if workers > 1 else ""
    unknown = len(hours) - len(known)
    return [*lines, total + (f"; {unknown} runs of unknown length" if unknown else "")]
