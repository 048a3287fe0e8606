"""Conditions that should be the same for all methods of a task, and the rows that differ."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from functools import cache
from pathlib import Path

from sb3_tbc.aliases import Plain
from sb3_tbc.report.runs import BEGIN_ALIKE, OURS, Results, Run, reference_of, row_of, shipped, with_defaults
from sb3_tbc.settings import flat
from sb3_tbc.tasks import TASKS
from sb3_tbc.zoo.config import load_config
from sb3_tbc.zoo.schema import CONFIG_CLASSES

CUTS = "hindsight cuts"
TWO_LEVELS = ("tbc-hrl", "hits", "hac")


def _of_level(run: Run, level: str, name: str) -> object:
    """A setting of a level, or of the agent where a level has none of its own."""
    own = (run.settings.get(level) or {}).get(name)
    return run.settings.get(name) if own is None else own


def _low(name: str) -> Callable[[Run], object]:
    """A setting of the low level, or of an agent of one level."""
    return lambda run: _of_level(run, "low", name)


def _high(name: str) -> Callable[[Run], object]:
    """The same setting of the high level, if there is one."""

    def value(run: Run) -> object:
        high, low = (_of_level(run, level, name) for level in ("high", "low"))
        return None if run.final["algo"] not in TWO_LEVELS else "as the low level's" if high == low else high

    return value


def _subgoal_view(run: Run) -> str | None:
    if run.final["algo"] not in TWO_LEVELS:
        return None
    return "relative" if run.settings.get("relative_subgoals") else "absolute"


def _cuts(run: Run) -> str | None:
    """A part of our agent, and not of the others."""
    if run.final["algo"] != OURS or run.final.get("config") == "paper":
        return None
    cuts, share = int(run.settings.get("n_hindsight_cuts") or 0), run.settings.get("hindsight_cuts_fraction", 1.0)
    return f"{cuts}" if share == 1.0 or not cuts else f"{cuts} in the first {share:.0%}"


CONDITIONS: dict[str, Callable[[Run], object]] = {
    "observation": lambda run: (run.config.get("env_kwargs") or {}).get("observation", "paper"),
    "subgoals seen": _subgoal_view,
    "training steps": lambda run: run.config.get("n_timesteps", run.final.get("n_timesteps")),
    "environments": lambda run: run.config.get("n_envs", 1),
    "updates per step": _low("gradient_ratio"),
    "high level's updates per step": _high("gradient_ratio"),
    "weight averaging": _low("average_decay"),
    "high level's weight averaging": _high("average_decay"),
    CUTS: _cuts,
    "settings": lambda run: run.final.get("config"),
    "settings tried": lambda run: run.tuning_trials,
    "steps between evaluations": lambda run: run.config.get("eval_freq"),
    "episodes per evaluation": lambda run: run.config.get("n_eval_episodes"),
    "final episodes": lambda run: run.config.get("n_final_episodes", run.final.get("n_episodes")),
}
"""Name of a condition -> its value for a run; ``None`` if it does not apply."""


def condition_values(runs: Sequence[Run]) -> dict[str, list[object]]:
    """Values of each condition over the seeds of a row, each once, in order of appearance."""
    return {
        name: list(dict.fromkeys(_plain(v) for run in runs if run.config and (v := value(run)) is not None))
        for name, value in CONDITIONS.items()
    }


def _plain(value: object) -> object:
    return value if isinstance(value, str | int | float) else str(value)


def differences(runs: Sequence[Run], reference: Sequence[Run]) -> list[str]:
    """Conditions in which a row differs from another, or its seeds from each other: ``name: value (other value)``."""
    found = []
    other = condition_values(reference)
    own_part = "cuts" in str(runs[0].final.get("variant"))  # what takes them out or puts them in is to differ in them
    for name, values in condition_values(runs).items():
        if name == CUTS and own_part:
            continue
        if len(values) > 1:
            found.append(f"{name}: {' or '.join(map(_said, values))}, depending on the seed")
        elif values and other[name] and values != other[name]:
            found.append(f"{name}: {_said(values[0])} ({' or '.join(map(_said, other[name]))})")
    return found


def _said(value: object) -> str:
    return f"{value:,}" if isinstance(value, int) and not isinstance(value, bool) else str(value)


def unequal_conditions(results: Results) -> dict[str, dict[str, list[str]]]:
    """Task -> baseline -> conditions in which it differs from our row; equal rows are left out."""
    found: dict[str, dict[str, list[str]]] = {}
    for task, methods in results.items():
        rows = shipped(methods)
        if OURS not in rows:
            continue
        lines = {method: differences(runs, rows[OURS]) for method, runs in rows.items()}
        found[task] = {method: said for method, said in lines.items() if said}
    return {task: rows for task, rows in found.items() if rows}


@cache
def _shipped_settings(algo: str, task: str) -> Plain:
    return flat(with_defaults(algo, load_config(algo, task).model))


def _settings_notes(runs: Sequence[Run]) -> list[str]:
    """Whether a row's settings differ between its seeds, and from those shipped now where its name says it has them."""
    seeds = [flat(run.settings) for run in runs if run.config.get("model")]
    algo, task = runs[0].method, str(runs[0].final["task"])
    notes = {"settings differ between seeds": _changed(seeds[0], seeds) if seeds else []}
    if algo in CONFIG_CLASSES and task in TASKS:
        notes["not the shipped settings"] = _changed(_shipped_settings(algo, task), seeds)
    return [f"{said}: {_few(names)}" for said, names in notes.items() if names]


def _changed(first: Plain, others: Sequence[Plain]) -> list[str]:
    return sorted({name for other in others for name in first | other if first.get(name) != other.get(name)})


def _few(names: Sequence[str], most: int = 3) -> str:
    return ", ".join(names[:most]) + (f" and {len(names) - most} more" if len(names) > most else "")


def notes_of_row(runs: Sequence[Run], reference: Mapping[str, Sequence[Run]], failed: Sequence[Path] = ()) -> list[str]:
    """Notes on a single row: unequal conditions, other settings than its name says, code that differs from its commit.

    :param runs: runs of the row
    :param reference: all rows of the task; ours is the one to compare with, for ablations of the paper's settings that
        with these settings
    :param failed: folders of failed runs of all rows
    """
    other = reference_of(runs)
    notes = differences(runs, reference[other]) if other in reference else []
    notes += _settings_notes(runs)
    if runs[0].final["task"] in BEGIN_ALIKE:
        notes.append("all episodes begin alike: one counts per seed")
    if count := sum(row_of(path) == (runs[0].final["task"], runs[0].method) for path in failed):
        notes.append(f"{count} failed")
    if any(run.tuned_on for run in runs):
        notes.append("settings were chosen on the seed that is reported")
    dirty = [run.seed for run in runs if run.versions and run.dirty]
    if dirty:
        seeds = "all seeds" if len(dirty) == len(runs) else "seed " + ", ".join(map(str, dirty))
        notes.append(f"{seeds}: code with changes that were not committed")
    return notes
