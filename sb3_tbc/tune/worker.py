"""Workers of a search: processes that take trials from one storage until enough are done."""

from __future__ import annotations

import contextlib
import math
import multiprocessing
import os
import signal
import sys
import time
import traceback
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from functools import partial
from multiprocessing import resource_tracker
from multiprocessing.process import BaseProcess
from pathlib import Path

import optuna
import torch as th
from optuna.study import Study
from optuna.trial import FrozenTrial, TrialState

from sb3_tbc.commands import INTERRUPTED, TOLD, USER_MISTAKE, tell
from sb3_tbc.outside import one_line
from sb3_tbc.stopping import StopRequest, stop_request
from sb3_tbc.tune.pruning import SEED_VALUES, make_pruner
from sb3_tbc.tune.study import (
    MAX_RETRIES,
    ORIGIN,
    REASON,
    SamplerOfEachTrial,
    count_done,
    make_sampler,
    open_storage,
    read_settings,
    requeue,
    retire_stale,
    told_if_lost,
)
from sb3_tbc.tune.trial import Stopped, Surplus, TrialRunner
from sb3_tbc.zoo.environments import resolve_env
from sb3_tbc.zoo.run_spec import RunOptions

POLL = 1.0
"""Seconds between looks at the storage while the last trials run elsewhere."""

STOP_SECONDS = 60.0
"""How long a stopped worker may take to put its trial back."""


@dataclass(frozen=True)
class Job:
    """What a worker needs to know; plain data, so that it can be handed to another process.

    :param storage: journal file or URL
    :param study: name
    :param folder: folder of the study's runs
    :param n_trials: trials of the whole study (complete or pruned)
    :param sampler: name of the sampler
    :param pruner: name of the pruner
    :param seed: seed of the sampler
    :param device: torch device
    :param grace: seconds without a heartbeat after which a worker's trial is given to another
    :param until: value of ``time.time()`` after which no trial begins
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


def load(job: Job, index: int, stop: StopRequest) -> tuple[Study, TrialRunner]:
    """Open a worker's study with its own sampler.

    :raises ConfigError: for unknown names and a storage that cannot be opened
    """
    study = optuna.load_study(study_name=job.study, storage=open_storage(job.storage, job.grace))
    settings = read_settings(study)
    study.sampler = SamplerOfEachTrial(lambda number: make_sampler(job.sampler, job.seed, (number,)))
    study.pruner = make_pruner(job.pruner, settings.n_evaluations, settings.n_seeds)
    resolve_env(settings.env)  # imports the module that registers it
    options = RunOptions(device=job.device, verbose=0, checkpoint_seconds=math.inf, save_at_end=False, stop=stop)
    return study, TrialRunner(settings, job.folder, job.n_trials, options, partial(_say, index))


def work(job: Job, index: int, stop: StopRequest) -> None:
    """Run trials until the study has enough of them.

    A worker waits while other workers run the last trials: if one of them dies, its trial must be run again.

    :param stop: whether the user asked to stop: looked at between steps, so that no write is interrupted
    :raises KeyboardInterrupt: when stopped, after the trial was put back into the queue
    """
    study, runner = load(job, index, stop)
    parent = multiprocessing.parent_process()  # of a worker; the command itself outlives the shell that began it
    while time.time() < job.until and (parent is None or parent.is_alive()):
        if stop:
            raise KeyboardInterrupt
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
    except (Stopped, KeyboardInterrupt) as stopped:
        if started:
            _put_back(study, started[-1])
        raise KeyboardInterrupt from stopped
    except Exception as error:
        if started and _was_taken(error):
            number = started[-1]
            _say(index, f"trial {number} is dropped here: another worker has it, because this one was silent too long")
            return
        if started:
            _say(index, _retry(study, started[-1], error))
        raise
    _say(index, describe(study.trials[started[-1]]))


def _was_taken(error: Exception) -> bool:
    """Whether a trial that still ran here had been marked as failed, because its worker counted as dead."""
    refused = isinstance(error, ValueError) and str(error).startswith("Cannot tell")
    return refused or isinstance(error, optuna.exceptions.UpdateFinishedTrialError)


def _retry(study: Study, number: int, error: Exception) -> str:
    """Queue a trial again in which an error was raised, as those of dead workers are; return a line about it.

    The fault may be the machine's, and then another run succeeds. If it is the trial's, the retries are counted.
    """
    failed = f"trial {number} failed: {type(error).__name__}: {one_line(error)}"
    trial = study.trials[number]
    if trial.state != TrialState.FAIL:  # the storage failed as well, so the trial will be found without a heartbeat
        return failed
    if requeue(study, trial, MAX_RETRIES):
        return f"{failed}; it is back in the queue"
    return f"{failed}; this was retry {MAX_RETRIES}, so it is not run again"


def _put_back(study: Study, number: int) -> None:
    """Queue the trial that the user stopped again, whatever its state."""
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
    try:
        print(f"worker {index}: {text}", flush=True)
    except BrokenPipeError as error:  # what reads the output has ended; no fault of the trial
        raise KeyboardInterrupt from error


# --------------------------------------------------------------------------------------------- processes


def run_workers(job: Job, n: int, stop: StopRequest) -> int:
    """Run ``n`` workers, in this process if it is one, and return an exit status.

    :param stop: whether the user asked to stop
    :raises KeyboardInterrupt: when stopped, after the workers have put their trials back
    """
    if n == 1:
        work(job, 0, stop)
        return 0
    context = multiprocessing.get_context("spawn")
    workers = [context.Process(target=_main, args=(job, index), name=f"worker {index}") for index in range(n)]
    with _ctrl_c_held_back():
        for worker in workers:
            worker.start()
    _watch(workers, stop)
    if stop:
        _stop(workers)
        raise KeyboardInterrupt
    codes = [worker.exitcode for worker in workers]
    return next((code for code in (0, USER_MISTAKE, INTERRUPTED) if code in codes), 1)


@contextlib.contextmanager
def _ctrl_c_held_back() -> Iterator[None]:
    """Let processes that begin in the block hear Ctrl-C only when they ask for it, see :func:`_hear_ctrl_c`.

    A terminal sends it to all processes; while they load their packages, it would end them in tracebacks.
    """
    if not hasattr(signal, "pthread_sigmask"):  # Windows
        yield
        return
    resource_tracker.ensure_running()  # beginning within the block, it would let the signal through again
    before = signal.pthread_sigmask(signal.SIG_BLOCK, {signal.SIGINT})
    try:
        yield
    finally:
        signal.pthread_sigmask(signal.SIG_SETMASK, before)


def _hear_ctrl_c() -> None:
    if hasattr(signal, "pthread_sigmask"):
        signal.pthread_sigmask(signal.SIG_UNBLOCK, {signal.SIGINT})


def _watch(workers: Sequence[BaseProcess], stop: StopRequest) -> None:
    """Wait for all workers, or until a stop is asked for, and report each one that dies."""
    waiting = list(workers)
    while waiting and not stop:
        for worker in [w for w in waiting if not w.is_alive()]:
            waiting.remove(worker)
            code = worker.exitcode or 0
            if code == INTERRUPTED:
                print(f"{worker.name} was stopped; its trial is back in the queue", file=sys.stderr)
            elif code != 0:
                how = f"signal {-code}" if code < 0 else f"exit status {code}"
                again = "; its trial will be run again by another" if code < 0 else ""  # else the worker has told it
                print(f"{worker.name} ended with {how}{again}", file=sys.stderr)
        time.sleep(0.2)


def _stop(workers: Sequence[BaseProcess]) -> None:
    """Let every worker put its trial back."""
    for worker in workers:
        if worker.is_alive():
            worker.terminate()
    for worker in workers:
        worker.join(STOP_SECONDS)
        if worker.is_alive():
            worker.kill()  # without a heartbeat its trial will be run again


def _main(job: Job, index: int) -> None:
    """Main function of a worker process: one thread, one orderly stop, user errors in one line."""
    os.environ["OMP_NUM_THREADS"] = "1"
    th.set_num_threads(1)
    try:
        with stop_request() as stop, told_if_lost(job.storage):
            _hear_ctrl_c()
            work(job, index, stop)
    except KeyboardInterrupt:
        sys.exit(INTERRUPTED)
    except TOLD as error:
        sys.exit(tell(error, f"worker {index}"))
    except Exception:
        traceback.print_exc()
        sys.exit(1)
