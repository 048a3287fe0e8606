"""One run of a campaign: its folders, its command, and the record of a failure."""

from __future__ import annotations

import sys
from dataclasses import dataclass, field
from pathlib import Path

import yaml

from sb3_tbc.aliases import Plain
from sb3_tbc.errors import ConfigError
from sb3_tbc.files import write_atomic
from sb3_tbc.outside import one_line
from sb3_tbc.reading import read_json
from sb3_tbc.zoo.checkpoints import steps_done
from sb3_tbc.zoo.ledger import RunFolder, to_json
from sb3_tbc.zoo.run_spec import RunSpec
from sb3_tbc.zoo.runner import trained_steps

FAILED = "failed.json"
"""File in the ledger's folder of a failed run: exit status, number of attempts and last message."""


@dataclass(frozen=True)
class Job:
    """One run of the campaign and its folders.

    :param algo: algorithm
    :param env: task or environment id, as it was asked for
    :param seed: training seed
    :param folder: where the run is carried out
    :param target: its place in the ledger
    :param arguments: for ``python -m sb3_tbc.train``
    :param n_timesteps: environment steps of the run
    :param n_episodes: episodes of all its evaluations together
    :param n_final_episodes: those of them that follow training
    :param cwd: working directory of the command; folders in ``arguments`` are relative to it
    """

    algo: str
    env: str
    seed: int
    folder: RunFolder
    target: RunFolder
    arguments: tuple[str, ...]
    n_timesteps: int = 0
    n_episodes: int = 0
    n_final_episodes: int = 0
    cwd: Path = field(default_factory=Path.cwd)

    @property
    def name(self) -> str:
        """For messages."""
        return f"{self.env} {self.algo} {self.variant} seed {self.seed}"

    @property
    def variant(self) -> str:
        """Name of the run's settings, as its folder has it."""
        return self.folder.path.parent.name

    @property
    def log(self) -> Path:
        """Where the run's output goes."""
        return self.folder.path / "train.log"

    def command(self) -> list[str]:
        """The training command that begins this run, or continues it where it stopped."""
        train = [sys.executable, "-m", "sb3_tbc.train", "--no-progress"]
        if self.folder.resumable:
            return [*train, "--resume", str(self.folder.path)]
        return [*train, "--overwrite", *self.arguments]

    @property
    def holds_run(self) -> bool:
        """Whether the folder holds a run that would be copied or continued, and not replaced."""
        return self.folder.finished or self.folder.resumable

    @property
    def steps_left(self) -> int:
        """Environment steps still to do: of a stopped run those after its checkpoint, of a trained one none."""
        if self.folder.finished:
            return 0
        if not self.folder.resumable:
            return self.n_timesteps
        return max(self.n_timesteps - max(steps_done(self.folder.path), trained_steps(self.folder)), 0)

    @property
    def episodes_left(self) -> float:
        """Episodes of evaluations still to come: those within the steps that are left, and those after training."""
        if self.folder.finished:
            return 0.0
        left = self.steps_left / self.n_timesteps if self.n_timesteps else 1.0
        return left * (self.n_episodes - self.n_final_episodes) + self.n_final_episodes

    def require(self, wanted: RunSpec) -> None:
        """Refuse a folder with another run: its result is none of the campaign's.

        :param wanted: what the folder must hold
        :raises ConfigError: naming the first difference, or if the folder's configuration cannot be read
        """
        cure = "use another --log-folder, or replace that run with sb3_tbc.train --overwrite"
        _require_run(self.folder, wanted, cure)

    def require_kept(self, wanted: RunSpec) -> None:
        """Refuse a result in the ledger that is another run's, or that cannot be read: this run is not done by it.

        :param wanted: the run whose result it must be
        :raises ConfigError: naming the first difference or the file
        """
        cure = "ask for that run with the same options, use another --variant or --ledger, or move it out of the ledger"
        _require_run(self.target, wanted, cure)
        self.target.read_final()

    def keep_result(self) -> None:
        """Copy the result into the ledger, if it is not there yet, and forget earlier failures.

        :raises ConfigError: if the run's folder is not complete
        :raises WriteError: if the ledger cannot be written
        """
        if not self.target.finished:
            self.folder.copy_to(self.target)
        (self.target.path / FAILED).unlink(missing_ok=True)

    def last_line(self, skip: int = 0) -> str:
        """The last line that the training command wrote; empty if it was killed before it wrote any.

        :param skip: bytes of the log that earlier attempts wrote
        """
        written = self.log.read_bytes()[skip:] if self.log.is_file() else b""
        text = written.decode("utf-8", "replace").strip()
        return text.splitlines()[-1] if text else ""

    def keep_failure(self, status: int, message: str) -> None:
        """Record in the ledger that the run failed, and count how often it did.

        :param status: exit status of the training command
        :param message: what went wrong
        :raises WriteError: if the ledger cannot be written
        """
        record = self.target.path / FAILED
        attempts = _attempts(record)
        row = {"task": self.env, "algo": self.algo, "variant": self.variant, "seed": self.seed}
        write_atomic(record, to_json({**row, "exit_status": status, "attempts": attempts + 1, "message": message}))


def _require_run(folder: RunFolder, wanted: RunSpec, cure: str) -> None:
    found = RunSpec.from_dict(folder.read_config()).to_dict()
    asked = yaml.safe_load(yaml.safe_dump(wanted.to_dict(), sort_keys=False))  # as the folder has it
    if difference := first_difference(asked, found):
        raise ConfigError(f"{folder.path} holds another run: {difference}; {cure}")


def first_difference(asked: Plain, found: Plain, section: str = "") -> str:
    """The first setting that two configurations do not share, with both values; empty if they are equal."""
    for name in asked | found:
        one, other = asked.get(name, "nothing"), found.get(name, "nothing")
        if isinstance(one, dict) and isinstance(other, dict):
            if inner := first_difference(one, other, f"{section}{name}."):
                return inner
        elif one != other:
            return f"{section}{name} is {one_line(other)} there, not {one_line(one)}"
    return ""


def _attempts(record: Path) -> int:
    """How often a run failed before; a record that cannot be read counts as none."""
    try:
        found = read_json(record) if record.is_file() else {}
        return int(found["attempts"]) if isinstance(found, dict) and "attempts" in found else 0
    except (ConfigError, ValueError, TypeError, OverflowError):
        return 0
