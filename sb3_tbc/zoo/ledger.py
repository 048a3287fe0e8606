"""Run folders and the results ledger: small text files with the settings, command, versions and result of each run."""

from __future__ import annotations

import json
import math
import platform
import re
import shutil
import subprocess
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from importlib import metadata
from pathlib import Path
from typing import Protocol

import numpy as np
import torch as th
import yaml

from sb3_tbc.aliases import Plain, PlainMapping
from sb3_tbc.arrays import AnyArray
from sb3_tbc.errors import ConfigError
from sb3_tbc.files import remove, remove_temporary, save_atomic, write_atomic
from sb3_tbc.outside import flat_name, folder_name
from sb3_tbc.reading import read_json, read_yaml
from sb3_tbc.stats import stability, wilson_interval
from sb3_tbc.zoo.callbacks import EvaluationRow, finite_mean, read_evaluations, write_evaluations
from sb3_tbc.zoo.checkpoints import BEST, NEWEST, Checkpoint, has_checkpoint, remove_checkpoints, remove_unfinished
from sb3_tbc.zoo.curves import EVALUATION_EPISODES, MONITOR

CONFIG, COMMAND, VERSIONS, EVALUATIONS, FINAL = (
    "config.yml",
    "command.txt",
    "versions.json",
    "evaluations.csv",
    "final.json",
)
RESUMED = "resumed"
"""In ``versions.json``: the versions of a run's later parts, where they are not those before."""
SEED_FOLDER = re.compile("seed_[0-9]+")
TENSORBOARD = "events.out.tfevents.*"
LEDGER_FILES = (CONFIG, COMMAND, VERSIONS, EVALUATIONS, FINAL)
SOURCES = (":/sb3_tbc", ":/tasks", ":/zoo_configs")
PACKAGES = (
    "sb3_tbc",
    "stable_baselines3",
    "torch",
    "numpy",
    "scipy",
    "gymnasium",
    "gymnasium_robotics",
    "mujoco",
    "box2d",
    "pybullet",
)


class Episodes(Protocol):
    """Per-episode arrays of an evaluation, each ``(n_episodes,)``; lengths and windows in environment steps."""

    @property
    def successes(self) -> AnyArray:
        """Whether the episode succeeded."""

    @property
    def lengths(self) -> AnyArray:
        """Steps."""

    @property
    def subgoal_success(self) -> AnyArray:
        """Share of the episode's windows that reached their subgoal."""

    @property
    def mean_window(self) -> AnyArray:
        """Mean executed window of the episode."""


def summarise(result: Episodes) -> Plain:
    """Summary of an evaluation for ``evaluate --json`` and ``final.json``; undefined means are ``None``, never NaN.

    ``outcomes`` has one digit per episode, in order, 1 for a success: the report pairs the episodes of two methods.
    """
    successes = np.asarray(result.successes, dtype=bool)
    lengths = np.asarray(result.lengths, dtype=np.float64)
    low, high = wilson_interval(int(successes.sum()), len(successes))
    return {
        "n_episodes": len(successes),
        "success_rate": float(successes.mean()),
        "success_ci95": [low, high],
        "mean_length": _number(finite_mean(lengths)),
        "mean_length_success": _number(finite_mean(lengths[successes])),
        "subgoal_success": _number(finite_mean(result.subgoal_success)),
        "mean_window": _number(finite_mean(result.mean_window)),
        "outcomes": "".join("1" if success else "0" for success in successes),
    }


def _number(value: float) -> float | None:
    return value if math.isfinite(value) else None


def to_json(data: PlainMapping) -> str:
    """JSON with a final newline; refuses NaN, which other readers do not understand."""
    return json.dumps(data, indent=2, allow_nan=False) + "\n"


def versions() -> Plain:
    """Packages, commit, Python and processor that a result depends on."""
    packages = {}
    for name in PACKAGES:
        try:
            packages[name] = metadata.version(name)
        except metadata.PackageNotFoundError:
            continue
    return {
        "packages": packages,
        "commit": _commit(),
        "python": platform.python_version(),
        "platform": platform.platform(),
        "cpu": _cpu(),
        "torch_threads": th.get_num_threads(),
    }


def _commit() -> str | None:
    """Commit of the checkout of the package, with ``+`` if files have changed; ``None`` outside a checkout."""
    folder = Path(__file__).parent
    try:
        where = ["git", "-C", str(folder)]
        tracked = subprocess.run([*where, "ls-files", "--error-unmatch", __file__], capture_output=True, timeout=10)
        if tracked.returncode != 0:
            return None
        commit = subprocess.run([*where, "rev-parse", "HEAD"], capture_output=True, text=True, timeout=10)
        changed = subprocess.run([*where, "diff", "--quiet", "HEAD", "--", *SOURCES], timeout=30)
    except (OSError, subprocess.TimeoutExpired):
        return None
    return commit.stdout.strip() + ("+" if changed.returncode else "")


def _cpu() -> str:
    try:
        for line in Path("/proc/cpuinfo").read_text().splitlines():
            if line.startswith("model name"):
                return line.partition(":")[2].strip()
    except OSError:
        pass
    return platform.processor() or platform.machine()


@dataclass(frozen=True)
class RunFolder:
    """The files of one run: ``<root>/<task>/<algo>/<variant>/seed_<n>/``."""

    path: Path

    @classmethod
    def for_run(cls, root: Path, task: str, algo: str, variant: str, seed: int) -> RunFolder:
        """The folder of a run; slashes and colons of environment ids become underscores.

        :raises ConfigError: if a name would lead out of ``root`` or cannot name a folder
        """
        names = flat_name(task, "the task"), folder_name(algo, "the algorithm"), folder_name(variant, "the variant")
        return cls(root.joinpath(*names, folder_name(f"seed_{seed}", "the seed")))

    @property
    def model(self) -> Path:
        """The agent at the end of training."""
        return self.path / "model.zip"

    @property
    def best_model(self) -> Path:
        """The agent with the best evaluation."""
        return self.path / BEST

    @property
    def checkpoint(self) -> Path:
        """Folder of the checkpoint for ``--resume``; the previous one lies beside it, see :mod:`.checkpoints`."""
        return self.path / NEWEST

    @property
    def evaluations(self) -> Path:
        """The learning curve."""
        return self.path / EVALUATIONS

    @property
    def exists(self) -> bool:
        """Whether a run has been started here."""
        return (self.path / CONFIG).is_file()

    @property
    def finished(self) -> bool:
        """Whether a run has ended here."""
        return (self.path / FINAL).is_file()

    @property
    def resumable(self) -> bool:
        """Whether there is an unfinished run that ``--resume`` can continue."""
        return self.exists and not self.finished and (has_checkpoint(self.path) or self.model.is_file())

    def start(self, config: PlainMapping, command: str) -> None:
        """Write versions, command, an empty curve where there is none, and last the configuration: it makes a run.

        Of a run that goes on, the first versions and command stay; others follow, under ``resumed`` and in a new line.

        :raises ConfigError: if the versions of a run that goes on cannot be read
        """
        if not self.evaluations.is_file():
            write_evaluations(self.evaluations, [])
        write_atomic(self.path / VERSIONS, to_json(self._all_versions()))
        write_atomic(self.path / COMMAND, "".join(f"{line}\n" for line in (*self._commands(), command) if line))
        write_atomic(self.path / CONFIG, yaml.safe_dump(dict(config), sort_keys=False))

    def clear(self) -> None:
        """Remove the files of an earlier run, but nothing else in the folder.

        The result goes first, then the configuration, so that remains are never taken for a run.
        """
        for name in (FINAL, CONFIG):
            (self.path / name).unlink(missing_ok=True)
        remove_checkpoints(self.path)
        self.tidy()
        rest = (COMMAND, VERSIONS, EVALUATIONS, EVALUATION_EPISODES, MONITOR, self.model.name, self.best_model.name,
                "progress.csv", "options.csv")  # fmt: skip
        logs = (path for pattern in ("*_until_*", TENSORBOARD) for path in self.path.glob(pattern))
        for path in (*(self.path / name for name in rest), *logs):
            remove(path)

    def tidy(self) -> None:
        """Remove half-written files that killed processes left behind."""
        remove_unfinished(self.path)
        remove_temporary(self.path)

    def read_config(self) -> Plain:
        """The configuration with which the run was started.

        :raises ConfigError: if there is none or it cannot be read
        """
        return _read(self.path / CONFIG, read_yaml)

    def read_final(self) -> Plain:
        """The result.

        :raises ConfigError: if there is none or it cannot be read
        """
        return _read(self.path / FINAL, read_json)

    def read_evaluations(self) -> list[EvaluationRow]:
        """The learning curve, empty before the first evaluation."""
        return read_evaluations(self.evaluations)

    def _commands(self) -> list[str]:
        path = self.path / COMMAND
        return path.read_text(encoding="utf-8", errors="replace").strip().split("\n") if path.is_file() else []

    def _all_versions(self) -> Plain:
        """The versions with which the run was begun, and under ``resumed`` those of later parts where they changed."""
        now, path = versions(), self.path / VERSIONS
        first = _read(path, read_json) if path.is_file() else now
        later = first.pop(RESUMED, [])
        if not isinstance(later, list):
            raise ConfigError(f"{path}: {RESUMED} must be a list, got {type(later).__name__}")
        later += [now] if now != [first, *later][-1] else []
        return {**first, RESUMED: later} if later else first

    def reopen(self, checkpoint: Checkpoint) -> None:
        """Rename files that a run resumed from there writes anew; an earlier result keeps its step in its name.

        Learning curve and best agent go back to what they were.
        """
        timesteps = checkpoint.timesteps
        if checkpoint.best_model.is_file():  # before the curve: if this fails, the next attempt finds all as it was
            save_atomic(lambda name: shutil.copyfile(checkpoint.best_model, name), self.best_model)
        if self.finished:
            self._put_aside(FINAL, timesteps)
        self.drop_evaluations_after(timesteps)
        self._put_aside("progress.csv", timesteps)  # SB3 starts a new one

    def _put_aside(self, name: str, timesteps: int) -> None:
        stem, _, suffix = name.partition(".")
        aside = self.path / f"{stem}_until_{timesteps}.{suffix}"
        for k in range(2, 10_000):
            if not aside.exists():
                break
            aside = self.path / f"{stem}_until_{timesteps}_{k}.{suffix}"  # an earlier part ended at the same step
        if (self.path / name).is_file():
            (self.path / name).rename(aside)

    def drop_evaluations_after(self, timesteps: int) -> None:
        """Remove evaluations that a resumed run will repeat."""
        rows = self.read_evaluations()
        if any(row.timesteps > timesteps for row in rows):
            write_evaluations(self.evaluations, [row for row in rows if row.timesteps <= timesteps])

    def finish(self, result: PlainMapping) -> None:
        """Write the result, which marks the run as done."""
        write_atomic(self.path / FINAL, to_json(result))

    def require_empty(self) -> None:
        """Refuse a folder that holds a result.

        :raises ConfigError: if it does
        """
        if self.finished:
            raise ConfigError(f"{self.path} already holds a result; remove it first or use --variant")

    def copy_to(self, target: RunFolder) -> None:
        """Copy the small text files, e.g. into the committed ledger.

        :raises ConfigError: if it already holds a result, or one of the files is missing here or cannot be read
        """
        target.require_empty()
        if missing := [name for name in LEDGER_FILES if not (self.path / name).is_file()]:
            raise ConfigError(f"{self.path} lacks {missing[0]} and cannot be copied; train it again with --overwrite")
        for read in (self.read_config, self.read_final):  # what half a file says would count as the result
            try:
                read()
            except ConfigError as error:
                raise ConfigError(f"{error}; nothing was copied. Train the run again with --overwrite") from error
        for name in LEDGER_FILES:
            write_atomic(target.path / name, (self.path / name).read_text(encoding="utf-8"))


def _read(path: Path, read: Callable[[Path], object]) -> Plain:
    if not path.is_file():
        raise ConfigError(f"{path.parent} holds no run: {path.name} is missing{_meant(path.parent)}")
    data = read(path)
    if not isinstance(data, dict):
        raise ConfigError(f"{path} must hold named values, got {type(data).__name__}")
    return data


def _meant(folder: Path) -> str:
    """Name the run that may be meant: that of a file in it, or one below a folder of runs; empty if there is none."""
    around = [folder.parent / CONFIG] if folder.is_file() else []
    below = (path for depth in range(4) for path in sorted(folder.glob(f"{'*/' * depth}seed_*/{CONFIG}")))
    found = next((path.parent for path in (*around, *below) if path.is_file()), None)
    return f"; name the folder of a run, e.g. {found}" if found else ""


def curve_summary(rows: list[EvaluationRow]) -> Plain:
    """Best evaluation and stability of a curve: from the first evaluation at 0.9 on, the share at 0.9 and the worst."""
    if not rows:
        return {"best_success_rate": None, "stable_share": None, "worst_after_first_90": None}
    rates = [row.success_rate for row in rows]
    share, worst = stability(rates) or (None, None)
    return {"best_success_rate": max(rates), "stable_share": share, "worst_after_first_90": worst}


def run_folders(root: Path, file: str) -> Iterator[RunFolder]:
    """Folders of runs that hold a file, in order of their paths; a copy such as ``seed_3 (copy)`` is none."""
    for path in sorted(root.glob(f"*/*/*/seed_*/{file}")):
        if SEED_FOLDER.fullmatch(path.parent.name):
            yield RunFolder(path.parent)


def finished_runs(root: Path) -> Iterator[RunFolder]:
    """All runs with a result below a folder, in order of their paths."""
    return run_folders(root, FINAL)
