"""One training run: make environments, build the agent, train, evaluate, and save everything in the run's folder."""

from __future__ import annotations

import shlex
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

from stable_baselines3.common.callbacks import BaseCallback, CallbackList
from stable_baselines3.common.logger import configure
from stable_baselines3.common.vec_env import VecEnv

from sb3_tbc.aliases import Plain
from sb3_tbc.errors import (
    ConfigError,
    DivergedError,
    EnvironmentFault,
    NonFiniteError,
    TrainingError,
    WriteError,
)
from sb3_tbc.files import explained, locked, remove_stale_lock, save_atomic
from sb3_tbc.outside import one_line
from sb3_tbc.stopping import StopEvaluation, StoppableVecEnv, StopRequest
from sb3_tbc.tbc_hrl.evaluation import Agent, evaluate_agent
from sb3_tbc.zoo.algorithms import RUN_INFO, build_model, load_model, read_zip
from sb3_tbc.zoo.callbacks import OptionTraceCallback, StopTraining, SuccessEvalCallback, TimedCheckpointCallback
from sb3_tbc.zoo.checkpoints import find_checkpoint, is_kept, keep_only, remove_checkpoints, save_checkpoint
from sb3_tbc.zoo.curves import MONITOR, TrainingMonitor
from sb3_tbc.zoo.environments import make_envs
from sb3_tbc.zoo.ledger import RunFolder, curve_summary, summarise
from sb3_tbc.zoo.rows import RowsCallback
from sb3_tbc.zoo.run_spec import RunOptions, RunSpec
from sb3_tbc.zoo.safety import CURE, ConsistentState, DivergenceCallback, check_weights

TRAINED = "wall_time"
"""In an agent's run information: seconds that its training took, evaluations included."""
HELD_OUT = 50_000_000
"""First seed of episodes that no run has met, neither in training nor in its evaluations."""


def evaluation_seed(seed: int) -> int:
    """First seed of the evaluations during training.

    Evaluation ``k`` adds ``1000 k``, its environment ``i`` adds ``i``. The first seeds are a million apart, so no two
    training seeds share an episode, nor do they share one with the final evaluations. Environments take seeds below
    ``2**32``.
    """
    return (100_000_000 + 1_000_000 * seed) % 2**32


def final_seed(seed: int) -> int:
    """Seed of the evaluation after training; they are a thousand apart, so no two training seeds share an episode."""
    return (2_000_000 + 1_000 * seed) % 2**32


def evaluation_envs(env_id: str, n_episodes: int, seed: int, env_kwargs: Plain) -> VecEnv:
    """Parallel environments for evaluations, at most ten: acting costs about the same for ten as for one."""
    return make_envs(env_id, min(10, n_episodes), seed, env_kwargs)


class Interrupted(Exception):
    """Training was stopped by the user; ``folder`` holds the checkpoint to resume from."""

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
) -> Plain:
    """Train from the beginning and return the content of ``final.json``.

    :param after_eval: called after each evaluation, e.g. by a search that may stop the run
    :raises ConfigError: for a user's mistake, before anything is written, and if the folder already holds a run
    :raises WriteError: if the folder cannot be written, or the disk is full
    :raises Interrupted: when stopped, after the checkpoint is written
    :raises TrainingError: if an environment fails or learning diverges
    """
    _check_new(folder, overwrite)
    env = make_envs(spec.env_id, spec.run.n_envs, spec.seed, spec.run.env_kwargs)
    try:
        model = build_model(spec.run, env, spec.seed, device=options.device)
        with locked(folder.path):
            _check_new(folder, overwrite)
            with explained(folder.path):
                folder.clear()
            folder.start(spec.to_dict(), command)
            return Training(model, spec, folder, options, 0.0, after_eval).run()
    finally:
        env.close()


def _check_new(folder: RunFolder, overwrite: bool) -> None:
    if folder.exists and not overwrite:
        state = "a finished run" if folder.finished else "an unfinished run"
        cure = "--overwrite, --variant NAME or another --log-folder"
        cure += "" if folder.finished else f", or --resume {shlex.quote(str(folder.path))}"
        raise ConfigError(f"{folder.path} holds {state}; nothing was changed. Use {cure}")


def resume_run(folder: RunFolder, options: RunOptions, n_timesteps: int | None = None, command: str = "") -> Plain:
    """Resume a run from its last undamaged checkpoint, or evaluate it if only that is missing.

    Of a finished run the result is returned, so that a script can call this until all runs are done.

    :param n_timesteps: a new total of environment steps
    :param command: what is added to ``command.txt`` if it changes the total
    :raises ConfigError: if there is no checkpoint, or the run is beyond ``n_timesteps``
    :raises WriteError: if the folder cannot be written, or the disk is full
    :raises Interrupted: when stopped, after the checkpoint is written
    :raises TrainingError: if an environment fails or learning diverges
    """
    spec = RunSpec.from_dict(folder.read_config())
    changed = n_timesteps is not None and n_timesteps != spec.run.n_timesteps
    if folder.finished and not changed:
        remove_stale_lock(folder.path)
        return folder.read_final()
    if n_timesteps is not None:
        spec = replace(spec, run=replace(spec.run, n_timesteps=n_timesteps))
    options = replace(options, keep_checkpoint=options.keep_checkpoint or is_kept(folder.path))
    with locked(folder.path):
        with explained(folder.path):
            folder.tidy()
        # with another total, the agent at the end of training may be that of an earlier part, before the checkpoint
        if not folder.finished and not changed and trained_steps(folder) >= spec.run.n_timesteps:
            return _only_evaluate(spec, folder, options)
        return _go_on(spec, folder, options, command if changed else "")


def trained_steps(folder: RunFolder) -> int:
    """Steps of the agent at the end of training; 0 if training has not ended."""
    if not folder.model.is_file():
        return 0
    try:
        steps = read_zip(folder.model).get("num_timesteps")
    except ConfigError:  # damaged: training resumes from its checkpoint
        return 0
    return steps if isinstance(steps, int) else 0


def _only_evaluate(spec: RunSpec, folder: RunFolder, options: RunOptions) -> Plain:
    """Finish a run that ended between training and its result."""
    env = make_envs(spec.env_id, spec.run.n_envs, spec.seed, spec.run.env_kwargs)
    try:
        model = load_model(folder.model, env, options.device, options.trust)
    finally:
        env.close()
    rows, info = folder.read_evaluations(), getattr(model, RUN_INFO, None)
    trained = info.get(TRAINED) if isinstance(info, dict) else None
    if not isinstance(trained, float):  # of an earlier version: what came after the last evaluation is not known
        trained = rows[-1].wall_time if rows else 0.0
    return finish(model, spec, folder, options, trained)


def _go_on(spec: RunSpec, folder: RunFolder, options: RunOptions, command: str) -> Plain:
    checkpoint = find_checkpoint(folder.path)
    if checkpoint is None:
        again = "start it with --keep-checkpoint to be able to extend a finished run"
        cure = again if folder.finished else "start it again with --overwrite"
        raise ConfigError(f"{folder.path} has no checkpoint to resume from; {cure}")
    done = checkpoint.timesteps
    if done > spec.run.n_timesteps:
        raise ConfigError(f"{folder.path} is at {done} of {spec.run.n_timesteps} steps already; raise --n-timesteps")
    env = make_envs(spec.env_id, spec.run.n_envs, spec.seed + done, spec.run.env_kwargs)
    try:
        model = load_model(checkpoint.model, env, options.device, options.trust)
        _load_replay(model, checkpoint.replay_buffer)
        checkpoint = keep_only(folder.path, checkpoint)
        with explained(folder.path):
            folder.reopen(checkpoint)
        folder.start(spec.to_dict(), command)
        return Training(model, spec, folder, options, checkpoint.wall_time).run()
    finally:
        env.close()


def _load_replay(model: Agent, path: Path) -> None:
    try:
        model.load_replay_buffer(path)
    except (ValueError, KeyError, TypeError) as error:
        raise ConfigError(f"{path} does not belong to this run's agent: {one_line(error)}") from error


class Training:
    """Trains an agent and writes all files of the run, also when training is stopped or fails.

    :param earlier: wall time of earlier parts of the run, seconds
    :param after_eval: called after each evaluation
    """

    def __init__(
        self,
        model: Agent,
        spec: RunSpec,
        folder: RunFolder,
        options: RunOptions,
        earlier: float,
        after_eval: BaseCallback | None = None,
    ) -> None:
        self.model, self.spec, self.folder, self.options = model, spec, folder, options
        self.earlier, self.after_eval = earlier, after_eval
        self.written: list[RowsCallback] = [TrainingMonitor(folder.path / MONITOR, spec.env_id, earlier)]
        if options.trace:
            self.written.append(OptionTraceCallback(folder.path / "options.csv"))
        self.consistent = ConsistentState()

    def run(self) -> Plain:
        """Train, evaluate, write the result, and return it.

        :raises Interrupted: when stopped
        :raises TrainingError: if an environment fails or learning diverges
        :raises WriteError: if something cannot be written
        """
        model, spec, seed = self.model, self.spec, evaluation_seed(self.spec.seed)
        setattr(model, RUN_INFO, spec.identity)
        with explained(self.folder.path):
            model.set_logger(configure(str(self.folder.path), ["csv", *["tensorboard"] * self.options.tensorboard]))
        env = evaluation_envs(spec.env_id, spec.n_eval_episodes, seed, spec.run.env_kwargs)
        self.evaluations = SuccessEvalCallback(
            env, spec.eval_freq, spec.n_eval_episodes, seed=seed, csv_path=self.folder.evaluations,
            best_model_path=self.folder.best_model, wall_time=self.earlier, callback_after_eval=self.after_eval,
            verbose=self.options.verbose, stop=self.options.stop,
        )  # fmt: skip
        try:
            self._train()
        finally:
            env.close()
        check_weights(model)
        if self.options.keep_checkpoint:
            self.checkpoint()
        trained = self.evaluations.wall_time
        setattr(model, RUN_INFO, {**spec.identity, TRAINED: trained})  # for its result, if that is made later
        save_atomic(model.save, self.folder.model)
        return finish(model, spec, self.folder, self.options, trained)

    def checkpoint(self, save_replay: Callable[[Path], object] | None = None) -> None:
        """Save everything that is needed to resume the run."""
        check_weights(self.model)
        for file in self.written:
            file.flush()
        steps, replay = int(self.model.num_timesteps), save_replay or self.model.save_replay_buffer
        wall_time, kept = self.evaluations.wall_time, self.options.keep_checkpoint
        save_checkpoint(self.folder.path, steps, wall_time, self.model.save, replay, kept)

    def _train(self) -> None:
        """Train; an early end gives a message of one line that also names the checkpoint to resume from."""
        options, wanted = self.options, self.spec.run.n_timesteps
        callbacks = [
            DivergenceCallback(),
            self.evaluations,
            TimedCheckpointCallback(self.checkpoint, options.checkpoint_seconds, lambda: bool(options.stop)),
            self.consistent,
            *self.written,
        ]
        left, fresh = wanted - self.model.num_timesteps, self.model.num_timesteps == 0
        try:
            options.stop.calls(lambda: setattr(self.model, "stop_requested", True))
            self.model.learn(
                left, callback=CallbackList(callbacks), reset_num_timesteps=fresh, progress_bar=options.progress
            )
            if options.stop and (self.evaluations.given_up or self.model.num_timesteps < wanted):
                raise StopTraining
        except StopTraining as stop:
            if options.save_at_end:
                self.checkpoint()
            raise Interrupted(f"stopped at {self.model.num_timesteps} of {wanted} steps", self.folder.path) from stop
        except OSError as error:  # writing SB3's progress.csv raises OSError itself
            told = error if isinstance(error, WriteError) else f"cannot write {self.folder.path}: {error.strerror}"
            raise WriteError(f"{told}. {self._what_is_left()}") from error
        except EnvironmentFault as error:
            raise self._ended(error, self._save_before()) from error
        except (NonFiniteError, DivergedError, ValueError) as error:
            self._told(error)

    def _told(self, error: NonFiniteError | DivergedError | ValueError) -> None:
        if NOT_A_DISTRIBUTION in str(error):  # SB3's own SAC does not look at its weights
            error = NonFiniteError(f"the actor's actions became NaN or infinite; {CURE}")
        if isinstance(error, ValueError):
            raise error
        raise self._ended(error, self._save_before()) from error

    def _ended(self, error: Exception, saved: bool = False) -> TrainingError:
        step, wanted = self.model.num_timesteps, self.spec.run.n_timesteps
        return TrainingError(
            f"training ended at step {step} of {wanted}: {one_line(error, 1000)}. {self._what_is_left(saved)}"
        )

    def _save_before(self) -> bool:
        """Save the state at the start of the rollout, if nothing was learned since; True if it was saved."""
        replay = self.consistent.go_back() if self.options.save_at_end else None
        if replay is None:
            return False
        try:
            self.checkpoint(replay)
        except (DivergedError, WriteError):
            return False
        return True

    def _what_is_left(self, saved: bool = False) -> str:
        if not self.options.save_at_end:
            return ""
        checkpoint = find_checkpoint(self.folder.path)
        if checkpoint is None:
            return "No checkpoint had been written yet"
        how = "Saved" if saved else "The last checkpoint is"
        return f"{how} at step {checkpoint.timesteps}; continue with: {self.options.resume_line(self.folder.path)}"


NOT_A_DISTRIBUTION = "to satisfy the constraint"
"""How torch says that an actor's mean is NaN."""


def finish(model: Agent, spec: RunSpec, folder: RunFolder, options: RunOptions, trained: float) -> Plain:
    """Evaluate the trained agent, write the result, and only then remove the checkpoints.

    :param trained: seconds that training took
    :raises Interrupted: when stopped, which may be before the evaluation
    :raises TrainingError: if an environment fails
    """
    try:
        result = _final(model, spec, folder, options.stop, trained)
    except StopEvaluation as stop:
        said = f"stopped after all {model.num_timesteps} steps, before the result"
        raise Interrupted(said, folder.path) from stop
    except (EnvironmentFault, NonFiniteError) as error:
        raise TrainingError(
            f"the evaluation after training failed: {one_line(error, 1000)}. The agent is saved; evaluate it with: "
            f"{options.resume_line(folder.path)}"
        ) from error
    folder.finish(result)
    if not options.keep_checkpoint:
        remove_checkpoints(folder.path)
    return result


def _final(model: Agent, spec: RunSpec, folder: RunFolder, stop: StopRequest, trained: float) -> Plain:
    """Evaluate the trained agent as ``python -m sb3_tbc.evaluate`` does, on ``eval_seed``."""
    seed = final_seed(spec.seed)
    env = evaluation_envs(spec.env_id, spec.n_final_episodes, seed, spec.run.env_kwargs)
    try:
        watched = StoppableVecEnv(env, stop)
        result = evaluate_agent(model, watched, spec.n_final_episodes, seed=seed, deterministic=True)
    finally:
        env.close()
    return {
        **spec.identity,
        "n_timesteps": int(model.num_timesteps),
        **summarise(result),
        "eval_seed": seed,
        **curve_summary(folder.read_evaluations()),
        "wall_time": round(trained, 1),
        "steps_per_second": round(model.num_timesteps / trained, 1) if trained else None,
    }
