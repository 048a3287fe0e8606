"""What a run is and how it is carried out; ``config.yml`` holds the first, so that a stopped run can be continued."""

from __future__ import annotations

import shlex
from dataclasses import asdict, dataclass, field
from pathlib import Path

from sb3_tbc.aliases import Plain
from sb3_tbc.commands import python
from sb3_tbc.errors import ConfigError
from sb3_tbc.stopping import StopRequest
from sb3_tbc.zoo.config import RunConfig


@dataclass(frozen=True)
class RunSpec:
    """A run: what is trained (:class:`RunConfig`), on which seed, and how it is evaluated.

    :param run: algorithm, task, settings
    :param env_id: environment id of the task
    :param variant: folder name: ``full``, ``custom``, an ablation, or a name given by the user
    :param seed: seed of everything in training
    :param eval_freq: environment steps between evaluations
    :param n_eval_episodes: episodes per evaluation
    :param n_final_episodes: episodes of the evaluation after training
    """

    run: RunConfig
    env_id: str
    variant: str = "full"
    seed: int = 0
    eval_freq: int = 5000
    n_eval_episodes: int = 20
    n_final_episodes: int = 100

    def to_dict(self) -> Plain:
        """Return plain data for ``config.yml``; the run's own keys come first."""
        watching = {k: v for k, v in asdict(self).items() if k != "run"}
        run = self.run.to_dict()
        model = run.pop("model")
        return {**run, **watching, "model": model}

    @classmethod
    def from_dict(cls, data: Plain) -> RunSpec:
        """Build the run from the data of ``config.yml``.

        :raises ConfigError: if keys are missing or unknown
        """
        watching = {k: data[k] for k in cls.__dataclass_fields__ if k != "run" and k in data}
        run = RunConfig.from_dict({k: v for k, v in data.items() if k not in watching})
        try:
            return cls(run=run, **watching)
        except TypeError as error:
            raise ConfigError(f"not a run's config.yml: {error}") from error

    @property
    def identity(self) -> Plain:
        """What identifies a result in ``final.json`` and inside the agent's ``.zip``."""
        run = self.run
        return {
            "task": run.task,
            "algo": run.algo,
            "variant": self.variant,
            "config": run.config,
            "seed": self.seed,
            "env_id": self.env_id,
            "env_kwargs": run.env_kwargs,
        }


@dataclass(frozen=True)
class RunOptions:
    """How a run is carried out; these options do not change its result.

    :param device: torch device
    :param progress: show a progress bar
    :param verbose: print a line per evaluation
    :param tensorboard: write TensorBoard files into the run folder
    :param trace: write ``options.csv``
    :param checkpoint_seconds: time between checkpoints; with infinity the only one is that of a stopped run
    :param keep_checkpoint: keep the last checkpoint (with replay buffers) of a finished run; a resumed one remembers it
    :param save_at_end: save a checkpoint when training is stopped or an environment fails
    :param trust: whether a checkpoint may run code, see :func:`.load_model`
    :param stop: tells whether the user asked to stop; training stops at the next point from which it can be resumed
    :param again: further arguments of the command line that continues the run, e.g. ``("--trace",)``
    """

    device: str = "cpu"
    progress: bool = False
    verbose: int = 1
    tensorboard: bool = False
    trace: bool = False
    checkpoint_seconds: float = 600.0
    keep_checkpoint: bool = False
    save_at_end: bool = True
    trust: bool = False
    stop: StopRequest = field(default_factory=StopRequest)
    again: tuple[str, ...] = ()

    def resume_line(self, folder: Path) -> str:
        """Return the command line that continues the run in ``folder`` with these options."""
        return f"{python()} -m sb3_tbc.train {shlex.join(['--resume', str(folder), *self.again])}"
