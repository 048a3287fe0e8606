"""Results of a search: the best trial as a configuration file, a table of trials, plots."""

from __future__ import annotations

import csv
import io
import math
import warnings
from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING

import optuna
from optuna.study import Study, StudyDirection
from optuna.trial import FrozenTrial, TrialState

from sb3_tbc.aliases import Plain, PlainMapping
from sb3_tbc.errors import ConfigError
from sb3_tbc.files import save_atomic, write_atomic
from sb3_tbc.reading import settings_yaml
from sb3_tbc.settings import merge
from sb3_tbc.tune.pruning import SEED_VALUES
from sb3_tbc.tune.study import ORIGIN, REASON, WORKER, StudySettings
from sb3_tbc.zoo.config import RunConfig

if TYPE_CHECKING:
    from matplotlib.figure import Figure


def find_trial(study: Study, which: str) -> FrozenTrial:
    """The trial with a number (from 0), or the best one.

    :raises ConfigError: if there is no such trial
    """
    if which == "best":
        try:
            return study.best_trial
        except ValueError as error:
            raise ConfigError(f"study {study.study_name!r} has no complete trial yet") from error
    trials = study.get_trials()
    if not which.isdecimal() or int(which) >= len(trials):
        there = f"0 to {len(trials) - 1}" if trials else "none yet"
        raise ConfigError(f"--trial must be 'best' or a trial's number ({there}), got {which!r}")
    trial = trials[int(which)]
    if trial.state == TrialState.WAITING:
        raise ConfigError(f"trial {which} has not begun yet")
    if not trial.params and not trial.user_attrs.get(ORIGIN):  # it would be the settings that are not searched
        raise ConfigError(
            f"trial {which} has chosen no settings: it was dropped, or has just begun; trials.csv lists all"
        )
    return trial


def difference(base: PlainMapping, other: PlainMapping) -> Plain:
    """The changes that turn ``base`` into ``other``, which has at least the same keys."""
    found: Plain = {}
    for key, value in other.items():
        old = base.get(key)
        if isinstance(old, Mapping) and isinstance(value, Mapping):
            inner = difference(old, value)
            found.update({key: inner} if inner else {})
        elif key not in base or old != value or type(old) is not type(value):
            found[key] = value
    return found


def as_section(run: RunConfig) -> Plain:
    """A configuration as a section of ``zoo_configs``."""
    data = run.to_dict()
    return {**{key: data[key] for key in ("n_timesteps", "n_envs", "env_kwargs")}, **data["model"]}


def trial_file(settings: StudySettings, trial: FrozenTrial, study_name: str) -> str:
    """A configuration file with one section, for ``train --config``: the first baseline, and the trial as ``tuned``."""
    run = settings.config_of(trial)
    paper = as_section(RunConfig.from_dict(next(iter(settings.baselines.values()))))
    tuned = difference(paper, as_section(run))
    if merge(paper, tuned) != as_section(run):  # a key of the base is missing in the trial
        paper, tuned = as_section(run), {}
    section = {**paper, **({"tuned": tuned} if tuned else {})}
    seeds = ", ".join(f"{seed}: {float(value):.4g}" for seed, value in trial.user_attrs.get(SEED_VALUES, {}).items())
    value = "none" if trial.value is None else f"{trial.value:.4g}"
    lines = [
        f"# {settings.algo} on {settings.task}: study {study_name}, trial {trial.number} ({trial.state.name.lower()}).",
        f"# Objective {settings.objective}: {value} ({settings.across_seeds} over seeds {seeds or 'none finished'}),",
        f"# {run.n_timesteps} steps, evaluated every {settings.eval_freq} on {settings.n_eval_episodes} episodes.",
    ]
    return "\n".join(lines) + "\n" + settings_yaml({settings.task: section})


def write_trial(settings: StudySettings, trial: FrozenTrial, study_name: str, path: Path) -> Path:
    """Write :func:`trial_file` and return its path."""
    write_atomic(path, trial_file(settings, trial, study_name))
    return path


def write_table(study: Study, path: Path) -> None:
    """Write ``trials.csv``: number, state, origin, value, seeds, duration in seconds, worker, reason, parameters."""
    trials = study.get_trials(deepcopy=False)
    names = sorted({name for trial in trials for name in trial.params})
    text = io.StringIO()
    writer = csv.writer(text, lineterminator="\n")
    writer.writerow(["number", "state", "origin", "value", "seeds", "seconds", "worker", "reason", *names])
    for t in trials:
        attrs = t.user_attrs
        seeds = " ".join(f"{seed}:{value:.4g}" for seed, value in attrs.get(SEED_VALUES, {}).items())
        seconds = "" if t.duration is None else f"{t.duration.total_seconds():.0f}"
        value = "" if t.state != TrialState.COMPLETE or t.value is None else f"{t.value:.6g}"
        row = [t.number, t.state.name, attrs.get(ORIGIN, ""), value, seeds, seconds]
        row += [attrs.get(WORKER, ""), attrs.get(REASON, "")]
        writer.writerow(row + [t.params.get(name, "") for name in names])
    write_atomic(path, text.getvalue())


def complete_trials(study: Study) -> list[FrozenTrial]:
    """Trials with a value."""
    return study.get_trials(deepcopy=False, states=(TrialState.COMPLETE,))


def importances(study: Study) -> dict[str, float]:
    """Share of each parameter in the difference between good and bad trials (PED-ANOVA); empty with too few trials."""
    values = {trial.value for trial in complete_trials(study)}
    if len(complete_trials(study)) < 4 or len(values) == 1:
        return {}
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")  # it warns that few trials make it inaccurate
            evaluator = optuna.importance.PedAnovaImportanceEvaluator()
            found = optuna.importance.get_param_importances(study, evaluator=evaluator)
    except (ValueError, RuntimeError):
        return {}  # e.g. no parameter that all trials have
    return {name: share for name, share in found.items() if math.isfinite(share)}


def plot_history(study: Study, path: Path) -> None:
    """Every trial's value, the best so far, and the baselines as lines."""
    from matplotlib.figure import Figure

    trials = complete_trials(study)
    figure = Figure(figsize=(7, 4), layout="constrained")
    axes = figure.add_subplot()
    numbers = [t.number for t in trials]
    values = [float(t.value or 0.0) for t in trials]
    better = max if study.direction == StudyDirection.MAXIMIZE else min
    axes.plot(numbers, values, "o", label="trial")
    axes.step(numbers, [better(values[: k + 1]) for k in range(len(values))], where="post", label="best so far")
    for k, trial in enumerate(t for t in trials if t.user_attrs.get(ORIGIN)):
        axes.axhline(float(trial.value or 0.0), ls="--", color=f"C{k + 2}", label=trial.user_attrs[ORIGIN])
    axes.set(xlabel="trial", ylabel=str(study.user_attrs["settings"]["objective"]), title=study.study_name)
    axes.legend()
    _save(figure, path)


def plot_importances(study: Study, path: Path) -> None:
    """Parameters by importance, the greatest on top."""
    from matplotlib.figure import Figure

    shares = sorted(importances(study).items(), key=lambda item: item[1])
    figure = Figure(figsize=(7, 1.2 + 0.25 * len(shares)), layout="constrained")
    axes = figure.add_subplot()
    axes.barh([name for name, _ in shares], [share for _, share in shares])
    axes.set(xlabel="importance (PED-ANOVA)", title=f"{study.study_name}, {len(complete_trials(study))} trials")
    _save(figure, path)


def _save(figure: Figure, path: Path) -> None:
    save_atomic(lambda name: figure.savefig(name, dpi=120), path)


def write_plots(study: Study, folder: Path) -> list[Path]:
    """Write ``history.png`` and, with enough trials, ``importances.png``; nothing without matplotlib."""
    try:
        import matplotlib  # noqa: F401
    except ImportError:
        return []
    written = []
    if complete_trials(study):
        plot_history(study, folder / "history.png")
        written.append(folder / "history.png")
    if importances(study):
        plot_importances(study, folder / "importances.png")
        written.append(folder / "importances.png")
    return written
