"""Callbacks of a run: evaluations of success with a CSV record, a trace of options, timed checkpoints."""

from __future__ import annotations

import csv
import io
import math
import signal
import time
from collections.abc import Callable, Iterable
from pathlib import Path
from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike
from stable_baselines3.common.base_class import BaseAlgorithm
from stable_baselines3.common.callbacks import BaseCallback, EventCallback
from stable_baselines3.common.vec_env import VecEnv

from sb3_tbc.aliases import Plain
from sb3_tbc.errors import ConfigError
from sb3_tbc.files import save_atomic, write_atomic
from sb3_tbc.outside import one_line
from sb3_tbc.reading import read_text
from sb3_tbc.stopping import StopEvaluation, StoppableVecEnv, StopRequest
from sb3_tbc.tbc_hrl import TBCHRL
from sb3_tbc.tbc_hrl.evaluation import evaluate_agent
from sb3_tbc.tbc_hrl.flat_sac import FlatSAC
from sb3_tbc.zoo.curves import EvaluationEpisodes
from sb3_tbc.zoo.rows import RowsCallback


class EvaluationRow(NamedTuple):
    """One line of ``evaluations.csv``; lengths and windows in environment steps, wall time in seconds."""

    timesteps: int
    success_rate: float
    episodes: int
    mean_length: float
    subgoal_success: float
    mean_window: float
    wall_time: float


def write_evaluations(path: Path, rows: Iterable[EvaluationRow]) -> None:
    """Rewrite ``evaluations.csv`` as a whole, so that a crash leaves either the old file or the new one."""
    text = io.StringIO()
    writer = csv.writer(text, lineterminator="\n")
    writer.writerow(EvaluationRow._fields)
    writer.writerows([f"{value:.6g}" if isinstance(value, float) else value for value in row] for row in rows)
    write_atomic(path, text.getvalue())


def read_evaluations(path: Path) -> list[EvaluationRow]:
    """Read ``evaluations.csv``; a missing file is no evaluations.

    :raises ConfigError: if it cannot be read or has other columns
    """
    if not path.is_file():
        return []
    reader = csv.DictReader(io.StringIO(read_text(path), newline=""))
    try:
        if tuple(reader.fieldnames or ()) != EvaluationRow._fields:
            raise ConfigError(
                f"{path} must have the columns {', '.join(EvaluationRow._fields)}, got {one_line(reader.fieldnames)}"
            )
        return [_parse_row(row) for row in reader]
    except ConfigError:
        raise
    except (ValueError, TypeError, KeyError, AttributeError, OverflowError, csv.Error) as error:
        raise ConfigError(f"{path} holds a line that is not an evaluation: {one_line(error)}") from error


def _parse_row(row: dict[str, str]) -> EvaluationRow:
    # the csv module gives a line that is too long a further key, and one that was cut off values of None
    if len(row) > len(EvaluationRow._fields) or any(text is None for text in row.values()):
        raise ValueError("it has not as many values as there are columns")
    values = {name: float(text) for name, text in row.items()}
    if not 0.0 <= values["success_rate"] <= 1.0:
        raise ValueError(f"success_rate must lie in [0, 1], got {values['success_rate']}")
    for name in ("timesteps", "episodes"):
        if not values[name].is_integer():
            raise ValueError(f"{name} must be a whole number, got {values[name]}")
    for name in ("mean_length", "wall_time"):  # the other two are NaN where no window ended
        if not 0.0 <= values[name] < math.inf:
            raise ValueError(f"{name} must be a finite number of at least 0, got {values[name]}")
    steps, episodes = int(values.pop("timesteps")), int(values.pop("episodes"))
    return EvaluationRow(timesteps=steps, episodes=episodes, **values)


def finite_mean(values: ArrayLike) -> float:
    """Mean of the finite values, NaN if there are none (an episode in which no window ended has no window length)."""
    array = np.asarray(values, dtype=np.float64)
    array = array[np.isfinite(array)]
    return float(array.mean()) if array.size else float("nan")


class SuccessEvalCallback(EventCallback):
    """Evaluates the deterministic agent every ``eval_freq`` environment steps and keeps the best by success rate.

    SB3's ``EvalCallback`` keeps the best by mean reward, which says little on sparse tasks and does not log subgoals.

    :param eval_env: one or several environments, separate from those of training
    :param eval_freq: environment steps between evaluations (all environments counted)
    :param n_eval_episodes: episodes per evaluation
    :param seed: evaluation ``k`` runs on seed ``seed + 1000 k``, independently of training
    :param csv_path: file of the rows, rewritten after each evaluation; rows that are already there are kept. Beside it,
        as ``.npz``, all episodes are written in the form that SB3's plots read
    :param best_model_path: where the best agent is saved; among equal success rates the one with shorter episodes
    :param wall_time: seconds that earlier parts of a resumed run took
    :param callback_on_new_best: called after a new best was saved
    :param callback_after_eval: called after each evaluation; returning ``False`` stops training
    :param stop: tells whether the user asked to stop; then an evaluation is given up and training stops. The next
        ``learn`` begins with it
    """

    def __init__(
        self,
        eval_env: VecEnv,
        eval_freq: int = 5000,
        n_eval_episodes: int = 20,
        seed: int = 0,
        csv_path: Path | None = None,
        best_model_path: Path | None = None,
        wall_time: float = 0.0,
        callback_on_new_best: BaseCallback | None = None,
        callback_after_eval: BaseCallback | None = None,
        verbose: int = 0,
        stop: StopRequest | None = None,
    ) -> None:
        super().__init__(callback_after_eval, verbose=verbose)
        if eval_freq < 1 or n_eval_episodes < 1:
            raise ValueError(f"eval_freq and n_eval_episodes must be at least 1, got {eval_freq} and {n_eval_episodes}")
        self.eval_env = eval_env if stop is None else StoppableVecEnv(eval_env, stop)
        self.stop, self.given_up = stop, False
        self.eval_freq = eval_freq
        self.n_eval_episodes = n_eval_episodes
        self.seed = seed
        self.csv_path = csv_path
        self.best_model_path = best_model_path
        self.callback_on_new_best = callback_on_new_best
        self.rows = read_evaluations(csv_path) if csv_path else []
        self._last = self.rows[-1].timesteps if self.rows else 0
        episodes = csv_path.with_suffix(".npz") if csv_path else None
        self.episodes = EvaluationEpisodes(episodes, {row.timesteps for row in self.rows})
        self._earlier = wall_time
        self._started = time.monotonic()

    def init_callback(self, model: BaseAlgorithm) -> None:
        """Hand the model to the inner callbacks too."""
        super().init_callback(model)
        if self.callback_on_new_best is not None:
            self.callback_on_new_best.parent = self
            self.callback_on_new_best.init_callback(model)

    @property
    def wall_time(self) -> float:
        """Seconds since the run began, evaluations included, earlier parts of a resumed run too."""
        return self._earlier + time.monotonic() - self._started

    def _on_training_start(self) -> None:
        super()._on_training_start()
        self._last = min(self._last, self.model.num_timesteps)  # another call of learn may count from zero again
        # before anything is learnt: the resumed run then evaluates the agent that an undisturbed one does
        if self.stop is not None and self._is_due() and not self._evaluate_unless_stopped():
            raise StopTraining

    def _on_step(self) -> bool:
        return not self._is_due() or self._evaluate_unless_stopped()

    def _is_due(self) -> bool:
        return self.num_timesteps // self.eval_freq > self._last // self.eval_freq

    def _evaluate_unless_stopped(self) -> bool:
        """Evaluate; False if training is to stop."""
        try:
            self.evaluate()
        except StopEvaluation:
            self.given_up = True
            return False
        self._last = self.num_timesteps
        return self._on_event()

    def evaluate(self) -> EvaluationRow:
        """Evaluate now, record the row, keep the agent if it is the best."""
        if not isinstance(self.model, (TBCHRL, FlatSAC)):
            raise TypeError(f"SuccessEvalCallback evaluates this package's agents, got {type(self.model).__name__}")
        result = evaluate_agent(
            self.model, self.eval_env, self.n_eval_episodes, seed=self.seed + 1000 * len(self.rows), deterministic=True
        )
        row = EvaluationRow(
            timesteps=int(self.num_timesteps),
            success_rate=finite_mean(result.successes),
            episodes=len(result.successes),
            mean_length=finite_mean(result.lengths),
            subgoal_success=finite_mean(result.subgoal_success),
            mean_window=finite_mean(result.mean_window),
            wall_time=self.wall_time,
        )
        self.episodes.add(row.timesteps, result)
        is_best = not self.rows or _quality(row) > max(map(_quality, self.rows))
        self.rows.append(row)
        self._record(row, is_best)
        return row

    def _record(self, row: EvaluationRow, is_best: bool) -> None:
        for name in ("success_rate", "mean_length", "subgoal_success", "mean_window"):
            self.logger.record(f"eval/{name}", getattr(row, name))
        self.logger.record("time/total_timesteps", self.num_timesteps, exclude="tensorboard")
        self.logger.dump(self.num_timesteps)
        if is_best and self.best_model_path is not None:
            save_atomic(self.model.save, self.best_model_path)
        if self.csv_path is not None:  # after saving the agent that this row may mark as the best
            write_evaluations(self.csv_path, self.rows)
        if is_best and self.callback_on_new_best is not None:
            self.callback_on_new_best.on_step()
        if self.verbose:
            self._tell(row)

    def _tell(self, row: EvaluationRow) -> None:
        """Print a row at once, also into a file; if what reads the output has ended, training is asked to stop."""
        options = f", subgoals reached {row.subgoal_success:.2f}, window {row.mean_window:.1f} steps"
        line = f"{row.timesteps:>9,} steps: success {row.success_rate:.2f}, length {row.mean_length:.0f}"
        try:
            print(line + ("" if math.isnan(row.mean_window) else options), flush=True)  # a flat agent has no options
        except BrokenPipeError:
            if self.stop is None:
                raise
            self.stop.ask(getattr(signal, "SIGPIPE", signal.SIGTERM))  # Windows has no such signal


def _quality(row: EvaluationRow) -> tuple[float, float]:
    return row.success_rate, -row.mean_length


class OptionTraceCallback(RowsCallback):
    """Writes every option of training to a CSV: step, environment, subgoal, time budget, duration, reason of its end.

    :param path: the CSV file; a resumed run keeps its rows up to the step from which it resumes
    :param every: write every n-th option only, to keep the file small
    """

    HEADER = ("timesteps", "env", "time_budget", "duration", "reached", "reason", "episode_over", "subgoal")

    def __init__(self, path: Path, every: int = 1, verbose: int = 0) -> None:
        super().__init__(path, verbose)
        if every < 1:
            raise ValueError(f"every must be at least 1, got {every}")
        self.every = every
        self._seen = 0

    def head(self) -> str:
        """The names of the columns."""
        return ",".join(self.HEADER) + "\n"

    def _on_step(self) -> bool:
        for index, info in enumerate(self.locals.get("infos", ())):
            option = info.get("option")
            if option is None:
                continue
            self._seen += 1
            if self._seen % self.every == 0:
                self._note(index, option, index in self.locals.get("episodes", {}))
        return True

    def _note(self, index: int, option: Plain, episode_over: bool) -> None:
        subgoal = " ".join(f"{x:.4g}" for x in option["subgoal"])
        row = [index, f"{option['time_budget']:.4g}", option["duration"]]
        self.write([*row, int(option["reached"]), option["reason"], int(episode_over), subgoal])


class StopTraining(Exception):
    """The user asked to stop, and training is at a point from which it can be resumed exactly."""


class TimedCheckpointCallback(BaseCallback):
    """Saves a checkpoint at fixed intervals, and stops training when asked.

    Both happen between rollouts, when no option is half recorded.

    :param save: writes the checkpoint
    :param seconds: shortest time between two checkpoints
    :param stop: tells whether the user asked to stop; then :class:`StopTraining` is raised before the next rollout
    """

    def __init__(
        self,
        save: Callable[[], None],
        seconds: float = 600.0,
        stop: Callable[[], bool] = bool,
        verbose: int = 0,
    ) -> None:
        super().__init__(verbose)
        self.save, self.seconds, self.stop = save, seconds, stop
        self._last = time.monotonic()

    def _on_step(self) -> bool:
        return True

    def _on_rollout_start(self) -> None:
        if self.stop():
            raise StopTraining
        if time.monotonic() - self._last >= self.seconds:
            self.save()
            self._last = time.monotonic()
