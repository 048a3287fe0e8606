"""Conditions that should be the same for all methods of a task, and the rows that differ."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence

from sb3_tbc.report.runs import OURS, Results, Run, reference_of, shipped

TWO_LEVELS = ("tbc-hrl", "hits", "hac")


def _level(run: Run, level: str, key: str) -> object:
    """A setting of a level, or of the agent itself if it has only one level."""
    model = run.config.get("model") or {}
    return (model.get(level) or model).get(key)


def _high_updates(run: Run) -> object:
    """Updates of the high level per environment step, where they are not the agent's."""
    model = run.config.get("model") or {}
    own = (model.get("high") or {}).get("gradient_ratio")
    return None if own is None or own == model.get("gradient_ratio", 1.0) else own


def _averaging(run: Run) -> str:
    decays = [_level(run, level, "average_decay") for level in ("high", "low")]
    said = ["default" if decay is None else str(decay) for decay in decays]
    return said[0] if said == ["default", "default"] else " and ".join(said)


def _subgoal_view(run: Run) -> str | None:
    if run.final["algo"] not in TWO_LEVELS:
        return None
    return "relative" if (run.config.get("model") or {}).get("relative_subgoals") else "absolute"


CONDITIONS: dict[str, Callable[[Run], object]] = {
    "observation": lambda run: (run.config.get("env_kwargs") or {}).get("observation", "paper"),
    "subgoals seen": _subgoal_view,
    "training steps": lambda run: run.config.get("n_timesteps", run.final.get("n_timesteps")),
    "environments": lambda run: run.config.get("n_envs", 1),
    "updates per step": lambda run: (run.config.get("model") or {}).get("gradient_ratio", 1.0),
    "high level's updates per step": _high_updates,
    "weight averaging": _averaging,
    "settings": lambda run: run.final.get("config"),
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
    for name, values in condition_values(runs).items():
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


def notes_of_row(runs: Sequence[Run], reference: Mapping[str, Sequence[Run]]) -> list[str]:
    """Notes on a single row: unequal conditions, and code that differs from its commit.

    :param runs: runs of the row
    :param reference: all rows of the task; ours is the one to compare with, for ablations of the paper's settings that
        with these settings
    """
    other = reference_of(runs[0].method)
    notes = differences(runs, reference[other]) if other in reference else []
    if any(run.tuned_on for run in runs):
        notes.append("settings were chosen on the seed that is reported")
    dirty = [run.seed for run in runs if run.versions and run.dirty]
    if dirty:
        seeds = "all seeds" if len(dirty) == len(runs) else "seed " + ", ".join(map(str, dirty))
        notes.append(f"{seeds}: code with changes that were not committed")
    return notes
