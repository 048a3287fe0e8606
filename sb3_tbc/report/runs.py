"""Finished runs of a folder, grouped into the rows of the tables."""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Collection, Mapping, Sequence
from functools import cache
from pathlib import Path
from types import MappingProxyType
from typing import NamedTuple

import numpy as np

from sb3_tbc.aliases import Plain, PlainMapping
from sb3_tbc.arrays import FloatArray
from sb3_tbc.errors import ConfigError
from sb3_tbc.outside import one_line
from sb3_tbc.reading import read_json, read_text, read_yaml
from sb3_tbc.report.checked import check_curve, check_final, check_place, check_sections
from sb3_tbc.settings import merge
from sb3_tbc.zoo.callbacks import EvaluationRow
from sb3_tbc.zoo.config import OF_PAPER
from sb3_tbc.zoo.ledger import COMMAND, RESUMED, VERSIONS, RunFolder, finished_runs, run_folders
from sb3_tbc.zoo.schema import CONFIG_CLASSES

OURS = "tbc-hrl"
SHIPPED = "full"
"""Variant of runs with the shipped settings; runs of any other variant are never a baseline."""
DESCRIPTIONS = "descriptions.yml"
"""File in the folder of results: task -> method -> one line; under ``default``: variant -> one line."""
TUNING_SEEDS = "tuning_seeds.yml"
"""File in the folder of results: task -> method -> seeds on which the row's settings were chosen."""
TUNING_TRIALS = "tuning_trials.yml"
"""File in the folder of results: task -> method -> how many settings were tried to choose the row's."""
REFERENCES = "references.yml"
"""File in the folder of results: task -> a row of ours -> rows that are compared with it, not with the shipped one."""

BEGIN_ALIKE = ("Drawbridge",)
"""Tasks in which nothing is random: a deterministic agent repeats its first episode, so others tell nothing more."""


class Curve(NamedTuple):
    """Success rate against environment steps of one seed."""

    timesteps: Sequence[float]
    success_rate: Sequence[float]


class Run(NamedTuple):
    """A finished run: its ``final.json``, learning curve, configuration, command and versions."""

    final: Plain
    rows: list[EvaluationRow]
    config: PlainMapping = MappingProxyType({})
    command: str = ""
    versions: PlainMapping = MappingProxyType({})
    folder: Path = Path()
    tuned_on: bool = False  # settings of its row were chosen on this seed
    tuning_trials: int | None = None  # settings tried to choose those of its row; unknown if not counted
    compared_with: str | None = None  # the row of ours that its row is compared with, if not the usual one

    @property
    def method(self) -> str:
        """The algorithm, with the variant if it is not the shipped one."""
        return method_name(str(self.final["algo"]), str(self.final["variant"]))

    @property
    def settings(self) -> Plain:
        """Settings of the agent, with the defaults of those that the run did not give."""
        return with_defaults(str(self.final["algo"]), self.config.get("model") or {})

    @property
    def curve(self) -> Curve:
        """Success rate against steps."""
        return Curve([row.timesteps for row in self.rows], [row.success_rate for row in self.rows])

    @property
    def seed(self) -> int:
        """The training seed."""
        return int(self.final.get("seed", 0))

    @property
    def episodes(self) -> int:
        """Episodes of the final evaluation that differ from each other, 0 if they were not recorded."""
        count = int(self.final.get("n_episodes") or 0)
        return min(count, 1) if self.final["task"] in BEGIN_ALIKE else count

    @property
    def outcomes(self) -> list[int] | None:
        """Success of each episode of the final evaluation in order; ``None`` if it was not recorded."""
        text = self.final.get("outcomes")
        return [int(digit) for digit in text] if isinstance(text, str) and text else None

    @property
    def commits(self) -> list[str]:
        """Commits of the code, first the beginning's, then those of parts that went on with other versions.

        A ``+`` says that files had been changed; ``unknown`` stands for code outside of a checkout.
        """
        return [str(part.get("commit") or "unknown") for part in (self.versions, *self.versions.get(RESUMED, []))]

    @property
    def dirty(self) -> bool:
        """Whether the commits do not determine the code."""
        return any(commit.endswith("+") or commit == "unknown" for commit in self.commits)


def method_name(algo: str, variant: str) -> str:
    """The algorithm, with the variant if it is not the shipped one."""
    return algo if variant == SHIPPED else f"{algo} {variant}"


def row_of(folder: Path) -> tuple[str, str]:
    """Task and method of a run's folder."""
    task, algo, variant, _ = folder.parts[-4:]
    return task, method_name(algo, variant)


def with_defaults(algo: str, model: PlainMapping) -> Plain:
    """Settings with the defaults of those that are not given. They are not checked: names may have gone since."""
    return merge(_defaults(algo), {name: value for name, value in model.items() if name != "policy"})


@cache
def _defaults(algo: str) -> Plain:
    return CONFIG_CLASSES[algo]().to_dict() if algo in CONFIG_CLASSES else {}


Results = dict[str, dict[str, list[Run]]]
"""Task -> method -> runs, one per seed."""


def load_results(root: Path) -> Results:
    """All finished runs below a folder.

    Seeds on which settings were chosen are left out if their row has other seeds, because they would bias it.

    :raises ConfigError: if there is no run, or if one cannot be read, or a table of seeds, trials or references
    """
    if not root.is_dir():
        raise ConfigError(f"{root} is no folder; name the folder of the runs, e.g. runs, or the ledger, results")
    results: Results = defaultdict(lambda: defaultdict(list))
    for folder in finished_runs(root):
        try:
            run = _load(folder)
            results[str(run.final["task"])][run.method].append(run)
        except (KeyError, ValueError, TypeError) as error:
            raise ConfigError(f"cannot read the run in {folder.path}: {error}") from error
    if not results and (failed := failed_runs(root)):
        raise ConfigError(f"no finished runs below {root}, and {len(failed)} that failed, e.g. {failed[0]}/failed.json")
    if not results:
        raise ConfigError(f"no finished runs below {root}: expected <task>/<algo>/<variant>/seed_<n>/final.json")
    tuned, trials = _tuning_seeds(root / TUNING_SEEDS), _tuning_trials(root / TUNING_TRIALS)
    references = _references(root / REFERENCES, results)

    def reported(task: str, method: str) -> list[Run]:
        row = (task, method)
        runs = _reported(results[task][method], tuned.get(row, ()))
        return [run._replace(tuning_trials=trials.get(row), compared_with=references.get(row)) for run in runs]

    return {
        task: {method: reported(task, method) for method in sorted(methods, key=_rank)}
        for task, methods in sorted(results.items())
    }


def _tuning_seeds(path: Path) -> dict[tuple[str, str], list[int]]:
    for task, rows in (table := read_table(path)).items():
        for method, seeds in rows.items():
            if not isinstance(seeds, list) or not all(type(seed) is int for seed in seeds):
                raise ConfigError(
                    f"{path}: {task}, {method} must be a list of seeds, as [0, 10], got {one_line(repr(seeds))}"
                )
    return {(task, method): seeds for task, rows in table.items() for method, seeds in rows.items()}


def _tuning_trials(path: Path) -> dict[tuple[str, str], int]:
    for task, rows in (table := read_table(path)).items():
        for method, count in rows.items():
            if type(count) is not int or count < 0:
                raise ConfigError(
                    f"{path}: {task}, {method} must be the number of settings tried, 0 or more, "
                    f"got {one_line(repr(count))}"
                )
    return {(task, method): count for task, rows in table.items() for method, count in rows.items()}


def _references(path: Path, results: Mapping[str, Mapping[str, object]]) -> dict[tuple[str, str], str]:
    """Task and row -> the row of ours that it is compared with."""
    found = {}
    for task, references in read_table(path).items():
        rows = results.get(task, {})
        for reference, others in references.items():
            if not isinstance(others, list):
                raise ConfigError(
                    f"{path}: {task}, {reference} must be a list of rows, as [tbc-hrl no-ts], "
                    f"got {one_line(repr(others))}"
                )
            if missing := [str(row) for row in (reference, *others) if row not in rows]:
                raise ConfigError(f"{path}: {task} has no row {', '.join(missing)}; it has {', '.join(sorted(rows))}")
            found.update({(task, str(row)): reference for row in others})
    return found


def _reported(runs: Sequence[Run], chosen: Collection[int]) -> list[Run]:
    """Runs of a row in order of their seeds; seeds on which settings were chosen only if there are no others."""
    marked = [run._replace(tuned_on=run.seed in chosen) for run in sorted(runs, key=lambda run: run.seed)]
    return [run for run in marked if not run.tuned_on] or marked


def _load(folder: RunFolder) -> Run:
    final = folder.read_final()
    check_final(final)
    check_place(folder.path, final)
    config = folder.read_config() if folder.exists else {}
    command = _text(folder.path / COMMAND).strip()
    versions = read_json(folder.path / VERSIONS) if (folder.path / VERSIONS).is_file() else {}
    if not isinstance(versions, dict):
        raise ValueError(f"{VERSIONS} must hold named values, got {type(versions).__name__}")
    check_sections(config, "model", "env_kwargs", "model.high", "model.low")
    check_sections(versions, "packages")
    later = versions.get(RESUMED, [])
    if not isinstance(later, list):
        raise ConfigError(f"{VERSIONS}: {RESUMED} must be a list, got {type(later).__name__}")
    for part in later:
        check_sections({RESUMED: part}, RESUMED)
    rows = folder.read_evaluations()
    check_curve(rows, final)
    return Run(final, rows, config, command, versions, folder.path)


def _text(path: Path) -> str:
    return read_text(path) if path.is_file() else ""


def _rank(method: str) -> tuple[bool, str]:
    return not method.startswith(OURS), method


def failed_runs(root: Path) -> list[Path]:
    """Folders of runs that ended in an error, as ``reproduce`` marks them, and that have not been repeated since."""
    return [folder.path for folder in run_folders(root, "failed.json") if not folder.finished]


def is_shipped(method: str) -> bool:
    """Whether a row has the shipped settings of its algorithm."""
    return " " not in method


def shipped(methods: Mapping[str, Sequence[Run]]) -> dict[str, Sequence[Run]]:
    """The rows with shipped settings: ours and the baselines, no variant and no ablation."""
    return {method: runs for method, runs in methods.items() if is_shipped(method)}


def reference_of(runs: Sequence[Run]) -> str:
    """The row of ours that a row is to be compared with: an ablation of the paper's settings with those settings.

    :data:`REFERENCES` names others, for rows that were run before a setting of ours was changed.
    """
    if runs[0].compared_with is not None:
        return runs[0].compared_with
    method = runs[0].method
    algo, _, variant = method.partition(" ")
    of_paper = algo == OURS and variant.endswith(OF_PAPER)
    return f"{OURS} {SHIPPED}{OF_PAPER}" if of_paper and variant != SHIPPED + OF_PAPER else OURS


def successes(runs: Sequence[Run]) -> list[float]:
    """Final success rate of each seed."""
    return [float(run.final["success_rate"]) for run in runs]


def stable_shares(runs: Sequence[Run]) -> list[float]:
    """Share of evaluations at 0.9 or more from the first of them on, of each seed that was evaluated; 0 without one."""
    return [float(run.final.get("stable_share") or 0.0) for run in runs if run.rows]


def load_descriptions(root: Path) -> dict[str, dict[str, str]]:
    """Descriptions of the rows, one line each; empty if the folder has no such file.

    :raises ConfigError: if the file cannot be read
    """
    return {task: {k: str(v) for k, v in lines.items()} for task, lines in read_table(root / DESCRIPTIONS).items()}


def read_table(path: Path) -> dict[str, Plain]:
    """Read a YAML file of two levels; empty if there is no such file.

    :raises ConfigError: if it cannot be read
    """
    if not path.is_file():
        return {}
    try:
        table = read_yaml(path) or {}  # of comments alone
        return {str(task): {str(k): v for k, v in lines.items()} for task, lines in table.items()}
    except AttributeError as error:
        raise ConfigError(f"{path} must hold two levels of names: {one_line(error)}") from error


def describe(descriptions: Mapping[str, Mapping[str, str]], task: str, method: str) -> str:
    """The description of a row: that of the task, else the general one of the method or variant, else empty."""
    general = descriptions.get("default", {})
    variant = method.partition(" ")[2]
    return descriptions.get(task, {}).get(method) or general.get(method) or general.get(variant) or ""


def on_union_of_steps(curves: Sequence[Curve]) -> tuple[FloatArray, FloatArray]:
    """Curves at all steps at which any of them was evaluated, in the range that all of them cover.

    A curve is interpolated linearly between its own points. All measured values in the range are kept, so no extreme is
    lost, even if seeds were evaluated at different steps.

    :param curves: one per seed, each with at least one point
    :return: steps ``(n_points,)`` and values ``(n_seeds, n_points)``
    :raises ValueError: if there is no curve or one is empty
    """
    if not curves or any(len(c.timesteps) == 0 for c in curves):
        raise ValueError(f"need curves with points, got lengths {[len(c.timesteps) for c in curves]}")
    first, last = max(c.timesteps[0] for c in curves), min(c.timesteps[-1] for c in curves)
    steps = np.unique(np.concatenate([np.asarray(c.timesteps, dtype=np.float64) for c in curves]))
    steps = steps[(steps >= first) & (steps <= last)]
    return steps, np.stack([np.interp(steps, c.timesteps, c.success_rate) for c in curves])
