"""Workers of a search: processes that take trials from one storage until there are enough."""

from __future__ import annotations

import math
import multiprocessing
import os
import signal
import sys
import time
import traceback
from collections.abc import Sequence
from dataclasses import dataclass
from functools import partial
from multiprocessing.process import BaseProcess
from pathlib import Path
from types import FrameType

import optuna
import torch as th
from optuna.study import Study
from optuna.trial import FrozenTrial, TrialState

from sb3_tbc.commands import INTERRUPTED, USER_MISTAKE
from sb3_tbc.errors import ConfigError
from sb3_tbc.tune.pruning import SEED_VALUES, make_pruner
from sb3_tbc.tune.study import (
    ORIGIN,
    REASON,
    count_done,
    make_sampler,
    open_storage,
    read_settings,
    requeue,
    retire_stale,
)
from sb3_tbc.tune.trial import Stopped, Surplus, TrialRunner
from sb3_tbc.zoo.environments import resolve_env
from sb3_tbc.zoo.runner import RunOptions

POLL = 1.0
"""Seconds between looks at the storage while the last trials run elsewhere."""

STOP_SECONDS = 60.0
"""How long a stopped worker may take to put its trial back."""


@dataclass(frozen=True)
class Job:
    """What a worker needs to know; plain data, so that it can be handed to another process.

    :param storage: journal file or URL
    :param study: name
    :param folder: of the study's runs
    :param n_trials: trials of the whole study that are to be done (complete or pruned)
    :param sampler: name
    :param pruner: name
    :param seed: of the sampler
    :param device: torch device
    :param grace: seconds after which a silent worker's trial is given to another
    :param until: ``time.time()`` after which no trial begins
    """

    storage: str
    study: str
    folder: Path
    n_trials: int
    sampler: str
    pruner: str
    seed: int | None
    device: str
    grace: int
    until: float = math.inf


def load(job: Job, index: int) -> tuple[Study, TrialRunner]:
    """Open a worker's study with its own sampler.

    :raises ConfigError: for unknown names and a storage that cannot be opened
    """
    study = optuna.load_study(study_name=job.study, storage=open_storage(job.storage, job.grace))
    settings = read_settings(study)
    study.sampler = make_sampler(job.sampler, job.seed, (index, len(study.get_trials(deepcopy=False))))
    study.pruner = make_pruner(job.pruner, settings.n_evaluations, settings.n_seeds)
    resolve_env(settings.env)  # imports the module that registers it
    options = RunOptions(device=job.device, verbose=0, checkpoint_seconds=math.inf, save_at_end=False)
    return study, TrialRunner(settings, job.folder, job.n_trials, options, partial(_say, index))


def work(job: Job, index: int) -> None:
    """Run trials until the study has enough of them.

    A worker stays while the last ones run elsewhere: if that worker dies, its trial is still to be done.

    :raises KeyboardInterrupt: when stopped; the trial is back in the queue then
    """
    study, runner = load(job, index)
    parent = os.getppid()
    while time.time() < job.until and os.getppid() == parent:
        retire_stale(study)
        done = count_done(study)
        if done >= job.n_trials:
            return
        running = len(study.get_trials(deepcopy=False, states=(TrialState.RUNNING,)))
        if done + running >= job.n_trials:
            time.sleep(POLL)
            continue
        _one_trial(study, runner, index)


def _one_trial(study: Study, runner: TrialRunner, index: int) -> None:
    started: list[int] = []

    def objective(trial: optuna.Trial) -> float:
        started.append(trial.number)
        origin = trial.user_attrs.get(ORIGIN)
        first = study.trials[trial.number].system_attrs.get("failed_trial")
        again = "" if first is None else f" in place of trial {first}"
        _say(index, f"trial {trial.number} begins{again}" + (f": the {origin} configuration" if origin else ""))
        return runner(trial)

    try:
        study.optimize(objective, n_trials=1)
    except Surplus:
        return
    except (optuna.exceptions.UpdateFinishedTrialError, ValueError) as error:
        if not _was_taken(error):
            raise
        _say(index, f"trial {started[-1]} was given to another worker after a long silence; dropped here")
        return
    except (Stopped, KeyboardInterrupt) as stopped:
        if started:
            _put_back(study, started[-1])
        raise KeyboardInterrupt from stopped
    _say(index, describe(study.trials[started[-1]]))


def _was_taken(error: Exception) -> bool:
    """Whether a trial had been declared dead, and so was finished, while it still ran here."""
    return isinstance(error, optuna.exceptions.UpdateFinishedTrialError) or str(error).startswith("Cannot tell")


def _put_back(study: Study, number: int) -> None:
    """Queue the trial that the user stopped, whatever state the stop left it in."""
    trial = study.trials[number]
    if trial.state == TrialState.RUNNING:
        study.tell(number, state=TrialState.FAIL)
    if trial.state in (TrialState.RUNNING, TrialState.FAIL):
        requeue(study, study.trials[number])


def describe(trial: FrozenTrial) -> str:
    """A line about a finished trial."""
    if trial.state == TrialState.PRUNED:
        return f"trial {trial.number} pruned: {trial.user_attrs.get(REASON, '')}"
    seeds = ", ".join(f"{float(value):.3g}" for value in trial.user_attrs.get(SEED_VALUES, {}).values())
    value = "none" if trial.value is None else f"{trial.value:.4g}"
    return f"trial {trial.number} done: {value}   (seeds: {seeds})"


def _say(index: int, text: str) -> None:
    print(f"worker {index}: {text}", flush=True)


# --------------------------------------------------------------------------------------------- processes


def run_workers(job: Job, n: int) -> int:
    """Run ``n`` workers, in this process if it is one, and return an exit status.

    :raises KeyboardInterrupt: when stopped, after the workers have put their trials back
    """
    if n == 1:
        work(job, 0)
        return 0
    context = multiprocessing.get_context("spawn")
    workers = [context.Process(target=_main, args=(job, index), name=f"worker {index}") for index in range(n)]
    for worker in workers:
        worker.start()
    try:
        _watch(workers)
    except KeyboardInterrupt:
        _stop(workers)
        raise
    codes = [worker.exitcode for worker in workers]
    return next((code for code in (0, USER_MISTAKE, INTERRUPTED) if code in codes), 1)


def _watch(workers: Sequence[BaseProcess]) -> None:
    """Wait for all, and tell of one that dies."""
    waiting = list(workers)
    while waiting:
        for worker in [w for w in waiting if not w.is_alive()]:
            waiting.remove(worker)
            code = worker.exitcode or 0
            if code == INTERRUPTED:
                print(f"{worker.name} was stopped; its trial is back in the queue", file=sys.stderr)
            elif code != 0:
                how = f"signal {-code}" if code < 0 else f"exit status {code}"
                print(f"{worker.name} ended with {how}; its trial will be run again by another", file=sys.stderr)
        time.sleep(0.2)


def _stop(workers: Sequence[BaseProcess]) -> None:
    """Let every worker put its trial back; an impatient second Ctrl-C must not leave them behind."""
    before = {number: signal.signal(number, _stopping) for number in (signal.SIGINT, signal.SIGTERM)}
    for worker in workers:
        if worker.is_alive():
            worker.terminate()
    for worker in workers:
        worker.join(STOP_SECONDS)
        if worker.is_alive():
            worker.kill()  # its trial is run again for want of signs of life
    for number, handler in before.items():
        signal.signal(number, handler)


def _main(job: Job, index: int) -> None:
    """A worker process: one thread, stops once and tidily, mistakes in one line."""
    os.environ["OMP_NUM_THREADS"] = "1"
    th.set_num_threads(1)
    signal.signal(signal.SIGTERM, _interrupt_once)
    if signal.getsignal(signal.SIGINT) != signal.SIG_IGN:  # in a script's background Ctrl-C is not meant for us
        signal.signal(signal.SIGINT, _interrupt_once)
    try:
        work(job, index)
    except KeyboardInterrupt:
        sys.exit(INTERRUPTED)
    except ConfigError as error:
        print(f"worker {index}: error: {' '.join(str(error).split())}", file=sys.stderr, flush=True)
        sys.exit(USER_MISTAKE)
    except Exception:
        traceback.print_exc()
        sys.exit(1)


def _interrupt_once(number: int, frame: FrameType | None) -> None:
    """A terminal sends Ctrl-C to every process and the parent passes on a stop: only the first may interrupt."""
    signal.signal(signal.SIGTERM, _stopping)
    signal.signal(signal.SIGINT, _stopping)
    raise KeyboardInterrupt


def _stopping(number: int, frame: FrameType | None) -> None:
    """Stopping has begun already."""
