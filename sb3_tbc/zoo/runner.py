"""One training run: make environments, build the agent, learn, evaluate, keep everything that matters."""

from __future__ import annotations

import json
import math
import os
import shutil
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any

from stable_baselines3.common.callbacks import BaseCallback, CallbackList
from stable_baselines3.common.logger import configure
from stable_baselines3.common.vec_env import VecEnv

from sb3_tbc.errors import ConfigError
from sb3_tbc.files import save_atomic, write_atomic
from sb3_tbc.tbc_hrl.evaluation import evaluate_agent
from sb3_tbc.zoo.algorithms import RUN_INFO, Agent, build_model, load_model
from sb3_tbc.zoo.callbacks import OptionTraceCallback, SuccessEvalCallback, TimedCheckpointCallback
from sb3_tbc.zoo.config import RunConfig
from sb3_tbc.zoo.environments import make_envs
from sb3_tbc.zoo.ledger import RunFolder, curve_summary, summarise, to_json


def evaluation_seed(seed: int) -> int:
    """First seed of the evaluations during training.

    Evaluation ``k`` adds ``1000 k``, its environment ``i`` adds ``i``. A million apart, no two training seeds share an
    episode, and none is shared with the final evaluations. Environments take seeds below ``2**32``.
    """
    return (100_000_000 + 1_000_000 * seed) % 2**32


def final_seed(seed: int) -> int:
    """Seed of the evaluation after training; a thousand apart, no two training seeds share an episode."""
    return (2_000_000 + 1_000 * seed) % 2**32


@dataclass(frozen=True)
class RunSpec:
    """A run: what is trained (:class:`RunConfig`), on which seed, and how it is watched.

    :param run: algorithm, task, settings
    :param env_id: environment id of the task
    :param variant: folder name: ``full``, an ablation, or a name of the user's
    :param seed: of everything in training
    :param eval_freq: environment steps between evaluations
    :param n_eval_episodes: episodes of each of them
    :param n_final_episodes: episodes of the evaluation after training
    """

    run: RunConfig
    env_id: str
    variant: str = "full"
    seed: int = 0
    eval_freq: int = 5000
    n_eval_episodes: int = 20
    n_final_episodes: int = 100

    def to_dict(self) -> dict[str, Any]:
        """As plain data for ``config.yml``; the run's own keys come first."""
        watching = {k: v for k, v in asdict(self).items() if k != "run"}
        run = self.run.to_dict()
        model = run.pop("model")
        return {**run, **watching, "model": model}

    @classmethod
    def from_dict(cls, data: dict[str, Any]) -> RunSpec:
        """Back from ``config.yml``.

        :raises ConfigError: if keys are missing or unknown
        """
        watching = {k: data[k] for k in cls.__dataclass_fields__ if k != "run" and k in data}
        run = RunConfig.from_dict({k: v for k, v in data.items() if k not in watching})
        try:
            return cls(run=run, **watching)
        except TypeError as error:
            raise ConfigError(f"not a run's config.yml: {error}") from error

    @property
    def identity(self) -> dict[str, Any]:
        """What names a result in ``final.json`` and inside the agent's ``.zip``."""
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
    """How a run is carried out, which does not change its result.

    :param device: torch device
    :param progress: show a progress bar
    :param verbose: print a line per evaluation
    :param tensorboard: write TensorBoard files into the run folder
    :param trace: write ``options.csv``
    :param checkpoint_seconds: time between checkpoints; infinite for none, not even when stopped
    :param keep_checkpoint: keep the last checkpoint (with replay buffers) of a finished run
    """

    device: str = "cpu"
    progress: bool = False
    verbose: int = 1
    tensorboard: bool = False
    trace: bool = False
    checkpoint_seconds: float = 600.0
    keep_checkpoint: bool = False


def evaluation_envs(env_id: str, n_episodes: int, seed: int, env_kwargs: dict[str, Any]) -> VecEnv:
    """Environments for evaluations: up to ten side by side, because acting costs the same for ten as for one."""
    return make_envs(env_id, min(10, n_episodes), seed, env_kwargs)


class Interrupted(Exception):
    """Training was stopped by the user; the checkpoint is written to ``folder``."""

    def __init__(self, message: str, folder: Path) -> None:
        super().__init__(message)
        self.folder = folder


def start_run(
    spec: RunSpec,
    folder: RunFolder,
    command: str,
    options: RunOptions,
    overwrite: bool = False,
    after_eval: BaseCallback | None = None,
) -> dict[str, Any]:
    """Train from the beginning and return the content of ``final.json``.

    :param after_eval: called after each evaluation, e.g. by a search that may give the run up
    :raises ConfigError: for a user's mistake, before anything is written, and if the folder holds a run
    :raises Interrupted: after Ctrl-C, when the checkpoint is written
    """
    if folder.exists and not overwrite:
        state = "a finished run" if folder.finished else "an unfinished run"
        cure = "--overwrite, --variant NAME or another --log-folder" + (
            "" if folder.finished else f", or --resume {folder.path}"
        )
        raise ConfigError(f"{folder.path} holds {state}; nothing was changed. Use {cure}")
    env = make_envs(spec.env_id, spec.run.n_envs, spec.seed, spec.run.env_kwargs)
    try:
        model = build_model(spec.run, env, spec.seed, device=options.device)
        folder.clear()
        folder.start(spec.to_dict(), command)
        return _learn(model, spec, folder, options, earlier=0.0, after_eval=after_eval)
    finally:
        env.close()


def resume_run(folder: RunFolder, options: RunOptions, n_timesteps: int | None = None) -> dict[str, Any]:
    """Go on from the last checkpoint of a run.

    :param n_timesteps: a new total of environment steps
    :raises ConfigError: if there is no checkpoint or nothing is left to do
    """
    spec = RunSpec.from_dict(folder.read_config())
    if n_timesteps is not None:
        spec = replace(spec, run=replace(spec.run, n_timesteps=n_timesteps))
    _mend_checkpoint(folder)
    state_file = folder.checkpoint / "state.json"
    if not state_file.is_file():
        cure = (
            "start with --keep-checkpoint to go on after the end"
            if folder.finished
            else "start it again with --overwrite"
        )
        raise ConfigError(f"{folder.path} has no checkpoint to resume from; {cure}")
    state = json.loads(state_file.read_text(encoding="utf-8"))
    if state["timesteps"] >= spec.run.n_timesteps:
        raise ConfigError(
            f"{folder.path} is at {state['timesteps']} of {spec.run.n_timesteps} steps; raise --n-timesteps"
        )
    env = make_envs(spec.env_id, spec.run.n_envs, spec.seed + state["timesteps"], spec.run.env_kwargs)
    try:
        model = load_model(folder.checkpoint / "model.zip", env, options.device)
        model.load_replay_buffer(folder.checkpoint / "replay_buffer.pkl")
        folder.drop_evaluations_after(state["timesteps"])
        folder.keep_progress(state["timesteps"])
        folder.start(spec.to_dict(), (folder.path / "command.txt").read_text(encoding="utf-8").strip())
        return _learn(model, spec, folder, options, earlier=state["wall_time"])
    finally:
        env.close()


def _learn(
    model: Agent,
    spec: RunSpec,
    folder: RunFolder,
    options: RunOptions,
    earlier: float,
    after_eval: BaseCallback | None = None,
) -> dict[str, Any]:
    setattr(model, RUN_INFO, spec.identity)
    formats = ["csv", "tensorboard"] if options.tensorboard else ["csv"]
    model.set_logger(configure(str(folder.path), formats))
    eval_env = evaluation_envs(spec.env_id, spec.n_eval_episodes, evaluation_seed(spec.seed), spec.run.env_kwargs)
    evaluations = SuccessEvalCallback(
        eval_env,
        spec.eval_freq,
        spec.n_eval_episodes,
        seed=evaluation_seed(spec.seed),
        csv_path=folder.evaluations,
        best_model_path=folder.best_model,
        wall_time=earlier,
        callback_after_eval=after_eval,
        verbose=options.verbose,
    )

    def checkpoint() -> None:
        _save_checkpoint(model, folder, evaluations.wall_time)

    callbacks: list[BaseCallback] = [evaluations, TimedCheckpointCallback(checkpoint, options.checkpoint_seconds)]
    if options.trace:
        callbacks.append(OptionTraceCallback(folder.path / "options.csv"))
    try:
        try:
            _train(model, spec.run.n_timesteps, CallbackList(callbacks), options.progress)
        except KeyboardInterrupt as error:
            if math.isfinite(options.checkpoint_seconds):
                checkpoint()
            message = f"stopped at {model.num_timesteps} of {spec.run.n_timesteps} steps"
            raise Interrupted(message, folder.path) from error
        save_atomic(model.save, folder.model)
        result = _final(model, spec, folder, evaluations.wall_time)
    finally:
        eval_env.close()
    if options.keep_checkpoint:
        checkpoint()
    else:
        shutil.rmtree(folder.checkpoint, ignore_errors=True)
    folder.finish(result)
    return result


def _train(model: Agent, n_timesteps: int, callback: BaseCallback, progress: bool) -> None:
    fresh = model.num_timesteps == 0
    model.learn(n_timesteps - model.num_timesteps, callback=callback, reset_num_timesteps=fresh, progress_bar=progress)


def _final(model: Agent, spec: RunSpec, folder: RunFolder, trained: float) -> dict[str, Any]:
    """Evaluate the trained agent as ``python -m sb3_tbc.evaluate`` does, on ``eval_seed``."""
    seed = final_seed(spec.seed)
    env = evaluation_envs(spec.env_id, spec.n_final_episodes, seed, spec.run.env_kwargs)
    try:
        result = evaluate_agent(model, env, spec.n_final_episodes, seed=seed, deterministic=True)
    finally:
        env.close()
    return {
        **spec.identity,
        "n_timesteps": int(model.num_timesteps),
        **summarise(result),
        "eval_seed": seed,
        **curve_summary(folder.read_evaluations()),
        "wall_time": round(trained, 1),
        "steps_per_second": round(model.num_timesteps / max(trained, 1e-9), 1),
    }


def _save_checkpoint(model: Agent, folder: RunFolder, wall_time: float) -> None:
    """Agent, replay buffers and clock, written aside and then swapped in: they always belong together."""
    new, old = folder.path / f"checkpoint.new{os.getpid()}", folder.path / "checkpoint.old"
    shutil.rmtree(new, ignore_errors=True)
    new.mkdir(parents=True)
    model.save(new / "model.zip")
    model.save_replay_buffer(new / "replay_buffer.pkl")
    write_atomic(new / "state.json", to_json({"timesteps": int(model.num_timesteps), "wall_time": wall_time}))
    shutil.rmtree(old, ignore_errors=True)
    if folder.checkpoint.exists():
        folder.checkpoint.rename(old)
    new.rename(folder.checkpoint)
    shutil.rmtree(old, ignore_errors=True)


def _mend_checkpoint(folder: RunFolder) -> None:
    """Take the previous checkpoint if the process died between the two renames of the swap."""
    old = folder.path / "checkpoint.old"
    if not folder.checkpoint.exists() and old.exists():
        old.rename(folder.checkpoint)
