"""In what the shipped agent departs from the paper, setting by setting, and what each departure is worth."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import NamedTuple

from sb3_tbc.aliases import Plain, PlainMapping
from sb3_tbc.errors import ConfigError
from sb3_tbc.outside import one_line
from sb3_tbc.report.comparisons import common_threshold, convergence_gain, difference_of
from sb3_tbc.report.conditions import differences
from sb3_tbc.report.runs import OURS, Results, Run, read_table, reference_of
from sb3_tbc.settings import flat
from sb3_tbc.zoo.config import load_config

MEASUREMENTS = "measurements.yml"
"""In the folder of results: task -> row -> settings of the shipped agent that the row has at the paper's value; under
``default``: rows of all tasks."""
NOT_MEASURED = "not measured"


class Departure(NamedTuple):
    """A setting that differs, where, and what measurements say."""

    setting: str
    paper: str
    shipped: str
    tasks: tuple[str, ...]
    measured: tuple[str, ...]


def departures_of(task: str) -> dict[str, tuple[str, str]]:
    """Setting -> the paper's value and the shipped one, where they differ; ``default`` where a section is silent."""
    paper, shipped = (load_config(OURS, task, config) for config in ("paper", "tuned"))
    values = [
        flat({**run.model, "n_timesteps": run.n_timesteps, "n_envs": run.n_envs, "env": run.env_kwargs})
        for run in (paper, shipped)
    ]
    both = {name: (_text(values[0], name), _text(values[1], name)) for name in sorted(values[0] | values[1])}
    return {name: pair for name, pair in both.items() if pair[0] != pair[1]}


def _text(values: PlainMapping, name: str) -> str:
    value = values.get(name, "default")
    return "none" if value is None else str(value)


def departures(root: Path, results: Results) -> list[Departure]:
    """All departures of the shipped agent, each once, with the tasks that have it.

    :param root: folder of the results, for the table of what each row measures
    :raises ConfigError: if that table cannot be read
    """
    table = _measured_settings(root / MEASUREMENTS)
    tasks: dict[tuple[str, str, str], list[str]] = {}
    for task in results:
        for setting, (paper, shipped) in departures_of(task).items():
            tasks.setdefault((setting, paper, shipped), []).append(task)
    found = []
    for (setting, paper, shipped), names in sorted(tasks.items()):
        measured = [said for task in names for said in _measurements(setting, task, table, results)]
        found.append(Departure(setting, paper, shipped, tuple(names), tuple(measured)))
    return found


def _measured_settings(path: Path) -> dict[str, Plain]:
    """The table of what each row measures; in a text, which is no list, any part of a setting's name would be found."""
    table = read_table(path)
    for task, rows in table.items():
        for row, settings in rows.items():
            if not isinstance(settings, list):
                raise ConfigError(
                    f"{path}: {task}, {row} must be a list of settings, as [gamma], got {one_line(repr(settings))}"
                )
    return table


def _measurements(setting: str, task: str, table: Mapping[str, PlainMapping], results: Results) -> list[str]:
    """What the rows of a task say that take a setting back to the paper's value."""
    rows = {**table.get("default", {}), **table.get(task, {})}
    methods = results[task]
    return [
        _said(task, row, results)
        for row, settings in rows.items()
        if setting in settings and row in methods and OURS in methods
    ]


def _said(task: str, row: str, results: Results) -> str:
    reference = reference_of(results[task][row])
    ours, theirs = _with_equal_seeds(results[task][reference], results[task][row])
    gained, unequal = difference_of(ours, theirs), differences(theirs, ours)
    sooner = convergence_gain(ours, theirs, common_threshold(results[task]))
    steps = "" if sooner is None else f", steps saved: {sooner},"
    said = f"{task}: {gained.mean:+.3f} ({gained.low:+.3f} to {gained.high:+.3f}){steps} against {row}"
    said += "" if reference == OURS else f" (ours: {reference})"
    return f"{said}, which differs in {'; '.join(unequal)}" if unequal else said


def _with_equal_seeds(first: Sequence[Run], second: Sequence[Run]) -> tuple[list[Run], list[Run]]:
    """Runs of the seeds that both rows have, since slow seeds are often slow in both; all runs if they share none."""
    common = {run.seed for run in first} & {run.seed for run in second}
    chosen = [[run for run in runs if run.seed in common or not common] for runs in (first, second)]
    return chosen[0], chosen[1]


def departures_table(root: Path, results: Results) -> list[list[str]]:
    """The departures as cells."""
    table = [["setting", "paper", "shipped", "tasks", "what it is worth"]]
    for row in departures(root, results):
        measured = "; ".join(row.measured) or NOT_MEASURED
        everywhere = len(row.tasks) == len(results) > 1
        table.append([row.setting, row.paper, row.shipped, "all" if everywhere else ", ".join(row.tasks), measured])
    return table
