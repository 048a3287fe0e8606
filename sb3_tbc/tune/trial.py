"""One trial of a search: the same settings are trained on several seeds, unless the trial is pruned."""

from __future__ import annotations

import os
import socket
import time
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import optuna
from optuna.trial import Trial, TrialState
from stable_baselines3.common.callbacks import BaseCallback

from sb3_tbc.errors import ConfigError, EnvironmentFault, TrainingError
from sb3_tbc.tune.objectives import ACROSS, OBJECTIVES
from sb3_tbc.tune.pruning import SEED_VALUES, SeedPruner
from sb3_tbc.tune.search_space import suggest
from sb3_tbc.tune.study import COUNTED, ORIGIN, REASON, WORKER, StudySettings
from sb3_tbc.zoo.callbacks import EvaluationRow, SuccessEvalCallback
from sb3_tbc.zoo.config import RunConfig
from sb3_tbc.zoo.ledger import RunFolder
from sb3_tbc.zoo.run_spec import RunOptions, RunSpec
from sb3_tbc.zoo.runner import Interrupted, start_run
from sb3_tbc.zoo.safety import LossWatch

CURVES = "curves"
"""Trial attribute: seed -> the reports made during its run, so that a retried trial need not train it again."""
DIVERGED = 1e6
"""Critic loss at which a run counts as diverging; returns here are of the order of 10 to 100, so losses of 1e4."""


class Surplus(Exception):
    """Two workers began the last trial, or queued the same baseline, at the same time; the later one drops it."""


class Stopped(Exception):
    """The user stopped the search within a trial."""


class ReportCallback(BaseCallback):
    """After each evaluation: stop a diverging run, report the score so far, ask the pruner.

    :param report: called with the curve so far; raises ``TrialPruned`` to stop
    """

    def __init__(self, report: Callable[[list[EvaluationRow]], None]) -> None:
        super().__init__()
        self.report = report
        self.watch = LossWatch(DIVERGED)

    def _init_callback(self) -> None:
        self.logger.output_formats.append(self.watch)

    def _on_step(self) -> bool:
        if not isinstance(self.parent, SuccessEvalCallback):
            raise TypeError(f"ReportCallback works only inside a SuccessEvalCallback, got {type(self.parent).__name__}")
        if self.watch.reason:
            raise optuna.TrialPruned(self.watch.reason)
        self.report(self.parent.rows)
        return True


@dataclass
class TrialRunner:
    """The objective: callable with a trial, returns its value.

    :param settings: settings that all trials share
    :param folder: each trial's runs go to ``<folder>/trial_<number>/seed_<seed>/``
    :param n_trials: size of the search; a trial beyond it is dropped
    :param options: how runs are carried out
    :param tell: called with a line about each finished seed but the last
    """

    settings: StudySettings
    folder: Path
    n_trials: int
    options: RunOptions
    tell: Callable[[str], None]

    def __call__(self, trial: Trial) -> float:
        """Train all seeds.

        :raises optuna.TrialPruned: with the reason, which is also stored with the trial
        :raises Stopped: after Ctrl-C or a termination signal
        :raises Surplus: if there are enough trials without this one
        """
        self._claim(trial)
        trial.set_user_attr(WORKER, f"{socket.gethostname()}:{os.getpid()}")
        origin = trial.user_attrs.get(ORIGIN)
        space = self.settings.parameters
        values = suggest(space, trial, self.settings.first_trials()[origin] if origin else None)
        try:
            return self._run(trial, self.settings.config_of_values(origin, values))
        except optuna.TrialPruned as pruned:
            trial.set_user_attr(REASON, str(pruned))
            raise
        except Interrupted as stopped:
            raise Stopped(str(stopped)) from stopped

    def _claim(self, trial: Trial) -> None:
        trials = trial.study.get_trials(deepcopy=False, states=(*COUNTED, TrialState.RUNNING))
        before = [other for other in trials if other.number < trial.number]
        origin = trial.user_attrs.get(ORIGIN)
        same = [other for other in trials if origin and other.user_attrs.get(ORIGIN) == origin]
        if len(before) >= self.n_trials or any(other in before or other.state in COUNTED for other in same):
            raise Surplus

    def _run(self, trial: Trial, run: RunConfig) -> float:
        scores: dict[str, float] = dict(trial.user_attrs.get(SEED_VALUES, {}))
        for index, seed in enumerate(self.settings.seeds):
            earlier = [scores[str(s)] for s in self.settings.seeds[:index]]
            if str(seed) in scores:
                self._report_again(trial, index, seed)
                continue
            begun = time.monotonic()
            scores[str(seed)] = self._seed(trial, run, index, seed, earlier)
            trial.set_user_attr(SEED_VALUES, scores)
            if index + 1 < self.settings.n_seeds:
                self.tell(
                    f"trial {trial.number}, seed {seed}: {scores[str(seed)]:.3g}, {time.monotonic() - begun:.0f} s"
                )
                self._ask(trial, f"after seed {seed}")
        return float(ACROSS[self.settings.across_seeds]([scores[str(seed)] for seed in self.settings.seeds]))

    def _seed(self, trial: Trial, run: RunConfig, index: int, seed: int, earlier: list[float]) -> float:
        """Train one seed and return its score."""
        objective, reports = OBJECTIVES[self.settings.objective], []

        def report(rows: list[EvaluationRow]) -> None:
            score = objective.score(rows, run.n_timesteps, self.settings.threshold)
            reports.append((sum(earlier) + score) / (index + 1))
            trial.report(reports[-1], index * self.settings.n_evaluations + len(rows))
            self._ask(trial, f"at step {rows[-1].timesteps:,} of seed {seed}")

        spec = self.spec(trial.number, run, seed)
        folder = RunFolder(self.folder / f"trial_{trial.number:04d}" / f"seed_{seed}")
        command = f"python -m sb3_tbc.tune: study {trial.study.study_name}, trial {trial.number}, seed {seed}"
        try:
            result = start_run(spec, folder, command, self.options, True, ReportCallback(report))
        except TrainingError as error:
            if isinstance(error.__cause__, EnvironmentFault):
                raise
            raise optuna.TrialPruned(f"not finite: {error.__cause__} (seed {seed})") from error
        except ConfigError as error:
            if trial.user_attrs.get(ORIGIN):
                raise
            raise optuna.TrialPruned(f"refused: {error}") from error
        trial.set_user_attr(CURVES, {**trial.user_attrs.get(CURVES, {}), str(seed): reports})
        if self.settings.objective == "success":
            return float(result["success_rate"])
        return objective.score(folder.read_evaluations(), run.n_timesteps, self.settings.threshold)

    def spec(self, number: int, run: RunConfig, seed: int) -> RunSpec:
        """The training run of one seed."""
        s = self.settings
        variant = f"trial_{number}"
        return RunSpec(run, s.env_id, variant, seed, s.eval_freq, s.n_eval_episodes, s.n_final_episodes)

    def _report_again(self, trial: Trial, index: int, seed: int) -> None:
        """Report a seed that this trial finished before its worker died."""
        for k, value in enumerate(trial.user_attrs.get(CURVES, {}).get(str(seed), ())):
            trial.report(value, index * self.settings.n_evaluations + k + 1)

    def _ask(self, trial: Trial, when: str) -> None:
        """Prune the trial if the pruner says so; the baselines are never pruned."""
        if trial.user_attrs.get(ORIGIN) or not trial.should_prune():
            return
        pruner = trial.study.pruner
        raise optuna.TrialPruned(f"{pruner.reason if isinstance(pruner, SeedPruner) else 'pruned'}, {when}")
