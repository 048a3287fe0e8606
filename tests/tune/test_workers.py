"""Real worker processes: one is killed within a trial; the trial is run again, nothing is lost or counted twice."""

from __future__ import annotations

import io
import os
import shlex
import signal
import subprocess
import sys
import threading
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from types import SimpleNamespace

import optuna
import pytest
from optuna.trial import TrialState
from postgres import private_server

from sb3_tbc.errors import TrainingError, WriteError
from sb3_tbc.stopping import StopRequest
from sb3_tbc.tune import worker
from sb3_tbc.tune.study import COUNTED, ORIGIN, WORKER, count_done, open_storage

HERE = Path(__file__).parent
MODULES = os.pathsep.join([str(HERE), str(HERE.parent)])
NAME = "tbc-hrl-TunedCorridor-v0"
GRACE = 8
N_TRIALS = 3


def test_output_that_nobody_reads_is_no_fault_of_a_trial(monkeypatch: pytest.MonkeyPatch) -> None:
    """It stops the worker as Ctrl-C does, which puts the trial back without counting a retry."""

    class Broken(io.StringIO):
        def flush(self) -> None:
            raise BrokenPipeError(32, "Broken pipe")

    monkeypatch.setattr(sys, "stdout", Broken())
    with pytest.raises(KeyboardInterrupt):
        worker._say(0, "trial 0 begins")


def command(folder: Path, storage: str, *more: str) -> list[str]:
    tiny = ["compile:false", "gradient_ratio:0.02", "low.buffer_size:2000", "high.buffer_size:500", "n_timesteps:200"]
    fixed = ["--env", "tuned_corridor:TunedCorridor-v0", "--log-folder", str(folder), "--storage", storage]
    short = ["--eval-freq", "100", "--n-eval-episodes", "1", "--n-final-episodes", "1", "--pruner", "none"]
    size = ["--n-trials", str(N_TRIALS), "--grace-seconds", str(GRACE)]
    return [sys.executable, "-m", "sb3_tbc.tune", *fixed, *short, *size, "--hyperparams", *tiny, *more]


def start(arguments: list[str], log: Path) -> subprocess.Popen[bytes]:
    environment = {**os.environ, "PYTHONPATH": MODULES, "OMP_NUM_THREADS": "1"}
    with log.open("wb") as output:
        return subprocess.Popen(arguments, stdout=output, stderr=output, env=environment, start_new_session=True)


def wait_for(condition: Callable[[], bool], seconds: float, log: Path) -> None:
    end = time.monotonic() + seconds
    while not condition():
        assert time.monotonic() < end, log.read_text()
        time.sleep(0.2)


def kill_one_worker_within_a_trial(folder: Path, storage: str) -> tuple[optuna.Study, int]:
    """Search with two workers, kill one of them in its trial, let the other finish; the study and the killed trial."""
    log = folder / "tune.log"
    process = start(command(folder, storage, "--workers", "2"), log)
    try:
        wait_for(lambda: log.read_text().count(" begins") >= 2, 120, log)
        study = optuna.load_study(study_name=NAME, storage=open_storage(storage, GRACE))
        wait_for(lambda: bool(training(study, folder)), 60, log)
        victim = training(study, folder)[-1]
        os.kill(int(victim.user_attrs[WORKER].rpartition(":")[2]), signal.SIGKILL)
        assert process.wait(180) == 0, log.read_text()
    finally:
        if process.poll() is None:
            os.killpg(process.pid, signal.SIGKILL)
    assert "ended with signal 9; its trial will be run again by another" in log.read_text()
    return study, victim.number


def training(study: optuna.Study, folder: Path) -> list[optuna.trial.FrozenTrial]:
    """Trials whose first seed is being trained, so all parameters are chosen."""
    running = [t for t in study.trials if t.state == TrialState.RUNNING and WORKER in t.user_attrs]
    return [t for t in running if (folder / NAME / f"trial_{t.number:04d}" / "seed_0" / "config.yml").is_file()]


def check(study: optuna.Study, killed: int) -> None:
    trials = study.get_trials()
    assert trials[killed].state == TrialState.FAIL
    assert count_done(study) == N_TRIALS
    assert {t.state for t in trials} == {TrialState.COMPLETE, TrialState.FAIL}
    (retry,) = [t for t in trials if t.system_attrs.get("failed_trial") == killed]
    assert retry.state == TrialState.COMPLETE
    assert retry.params == trials[killed].params
    done = [t for t in trials if t.state in COUNTED]
    assert [t.user_attrs.get(ORIGIN) for t in done].count("default") == 1
    assert all(len(t.user_attrs["seed_values"]) == 2 for t in done)
    assert len({str(t.params) for t in done}) == N_TRIALS


@pytest.mark.parametrize(("error", "status"), [(WriteError("no\nspace"), 2), (TrainingError("it fell"), 1)])
def test_a_workers_error_is_one_line(
    error: Exception, status: int, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    def fails(*_: object) -> None:
        raise error

    monkeypatch.setattr(worker, "work", fails)
    with pytest.raises(SystemExit) as ended:
        worker._main(worker.Job("study.log", NAME, Path(), 1, "random", "none", 0, "cpu", 60), 3)
    assert ended.value.code == status
    assert capsys.readouterr().err == f"worker 3: error: {' '.join(str(error).split())}\n"


@pytest.mark.slow
def test_a_killed_worker_on_a_journal(tmp_path: Path) -> None:
    check(*kill_one_worker_within_a_trial(tmp_path, str(tmp_path / "study.log")))


JOB = worker.Job("study.log", NAME, Path(), 1, "random", "none", 0, "cpu", 60)


def test_ctrl_c_does_not_reach_workers_that_load_their_packages(monkeypatch: pytest.MonkeyPatch) -> None:
    """A terminal sends it to all processes, and it ended each in a traceback of its imports."""
    mask = "import signal; print(signal.SIGINT in signal.pthread_sigmask(signal.SIG_BLOCK, ()))"
    held: list[bytes] = []

    class Process:
        exitcode = 0

        def __init__(self, **_: object) -> None: ...

        def start(self) -> None:
            held.append(subprocess.check_output([sys.executable, "-c", mask]))

        def is_alive(self) -> bool:
            return False

    monkeypatch.setattr(worker.multiprocessing, "get_context", lambda kind: SimpleNamespace(Process=Process))
    assert worker.run_workers(JOB, 2, StopRequest()) == 0
    assert held == [b"True\n", b"True\n"]
    assert signal.SIGINT not in signal.pthread_sigmask(signal.SIG_BLOCK, ())


def test_a_worker_hears_the_ctrl_c_that_came_while_it_loaded(monkeypatch: pytest.MonkeyPatch) -> None:
    heard: list[bool] = []
    monkeypatch.setattr(worker, "work", lambda job, index, stop: heard.append(bool(stop)))
    signal.pthread_sigmask(signal.SIG_BLOCK, {signal.SIGINT})
    try:
        signal.pthread_kill(threading.get_ident(), signal.SIGINT)  # another thread of the tests would hear os.kill's
        worker._main(JOB, 0)
    finally:
        signal.pthread_sigmask(signal.SIG_UNBLOCK, {signal.SIGINT})
    assert heard == [True]


@pytest.mark.slow
def test_a_search_outlives_the_shell_that_began_it(tmp_path: Path) -> None:
    """As with ``nohup ... &`` and a logout: the command's parent ends while the search runs."""
    log, storage = tmp_path / "tune.log", str(tmp_path / "study.log")
    until_it_runs = f"until grep -q begins {shlex.quote(str(log))}; do sleep .1; done"
    shell = ["sh", "-c", f"{shlex.join(command(tmp_path, storage))} & {until_it_runs}"]
    assert start(shell, log).wait(120) == 0
    wait_for(lambda: "best " in log.read_text(), 170, log)
    assert count_done(optuna.load_study(study_name=NAME, storage=open_storage(storage, GRACE))) == N_TRIALS


@pytest.mark.slow
def test_a_stop_puts_running_trials_back(tmp_path: Path) -> None:
    log, storage = tmp_path / "tune.log", str(tmp_path / "study.log")
    process = start(command(tmp_path, storage, "--workers", "2"), log)
    try:
        wait_for(lambda: log.read_text().count(" begins") >= 2, 120, log)
        os.killpg(process.pid, signal.SIGINT)  # what a terminal's Ctrl-C does: every process gets it
        assert process.wait(60) == 130, log.read_text()
    finally:
        if process.poll() is None:
            os.killpg(process.pid, signal.SIGKILL)
    study = optuna.load_study(study_name=NAME, storage=open_storage(storage, GRACE))
    states = [t.state for t in study.trials]
    assert TrialState.RUNNING not in states
    assert TrialState.WAITING in states
    done = subprocess.run(
        command(tmp_path, storage),
        capture_output=True,
        text=True,
        timeout=170,
        env={**os.environ, "PYTHONPATH": MODULES},
    )
    assert done.returncode == 0, done.stderr
    assert count_done(study) == N_TRIALS
    assert len({str(t.params) for t in study.trials if t.state in COUNTED}) == N_TRIALS


# --------------------------------------------------------------------------------------------- PostgreSQL


@pytest.fixture
def postgres() -> Iterator[str]:
    """The URL of a private server."""
    with private_server() as url:
        if url is None:
            pytest.skip("PostgreSQL is not installed; scripts/install-postgres.sh brings it")
        yield url


@pytest.mark.slow
def test_a_killed_worker_on_postgresql(tmp_path: Path, postgres: str) -> None:
    check(*kill_one_worker_within_a_trial(tmp_path, postgres))
