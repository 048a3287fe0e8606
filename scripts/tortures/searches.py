"""Searches whose workers and parents are killed at random moments: no trial is lost or counted twice."""

from __future__ import annotations

import multiprocessing
import os
import random
import signal
import sys
import time
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path

import optuna
from optuna.trial import TrialState
from postgres import private_server
from tuned_corridor import ENV_ID

from sb3_tbc.tune import command
from sb3_tbc.tune.study import COUNTED, ORIGIN, count_done, open_storage

NAME = f"tbc-hrl-{ENV_ID}"
GRACE = 3
"""Seconds of silence after which a worker counts as dead."""
TRIALS_PER_KILL = 3.0
"""So many trials a study has for each kill, so that most of the kills hit a running search."""
TINY = ["compile:false", "gradient_ratio:0.02", "low.buffer_size:2000", "high.buffer_size:500", "n_timesteps:400"]


def torture_tune(root: Path, number: int, first: int) -> tuple[int, int]:
    """Kill workers and parents, a third each with a journal, SQLite and PostgreSQL."""
    tried = good = 0
    per_storage = max(1, (number or 30) // 3)
    with private_server() as server:
        storages = {
            "journal": str(root / "journal" / "study.log"),
            "SQLite": f"sqlite:///{root}/sqlite.db",
            **({} if server is None else {"PostgreSQL": server}),
        }
        if server is None:
            print("   PostgreSQL is not installed (scripts/install-postgres.sh): left out", flush=True)
        for name, storage in storages.items():
            folder = root / name
            folder.mkdir(exist_ok=True)
            kills, problems = _study(folder, storage, per_storage, random.Random(first))
            tried += kills
            good += 0 if problems else kills
            print(f"   {name}: {kills} kills, {problems or 'nothing lost, nothing twice'}", flush=True)
    return tried, good


def _study(folder: Path, storage: str, kills: int, rng: random.Random) -> tuple[int, list[str]]:
    """Search, kill, search on; how often was killed, and what is wrong with the study at its end."""
    wanted = int(kills * TRIALS_PER_KILL) + 2
    done = 0
    for _ in range(20 * kills):
        with _search(folder, storage, wanted) as parent:
            while done < kills and _alive(parent):
                time.sleep(rng.uniform(1.5, 4.0))
                workers = _children(parent)
                victim = rng.choice([parent, *workers])
                if not _alive(victim):
                    continue
                os.kill(victim, signal.SIGKILL)
                done += 1
                if victim == parent:  # its workers end by themselves, after the trials that they are at
                    _wait(workers)
            if done >= kills:
                _wait([parent])
        study = optuna.load_study(study_name=NAME, storage=open_storage(storage, GRACE)) if _exists(storage) else None
        if study is not None and done >= kills and count_done(study) >= wanted:
            return done, _problems(study, wanted)
    return done, ["the search did not end"]


LONGEST = 120.0
"""Seconds that a search may take to its end, with a worker killed or without."""


@contextmanager
def _search(folder: Path, storage: str, wanted: int) -> Iterator[int]:
    """A search in a process group of its own, ended with all of its processes."""
    child = os.fork()
    if not child:
        os.setpgid(0, 0)
        log = os.open(folder / "log", os.O_WRONLY | os.O_CREAT | os.O_APPEND)
        os.dup2(log, 1)
        os.dup2(log, 2)
        fork = multiprocessing.get_context("fork")
        multiprocessing.get_context = lambda _=None: fork  # type: ignore[assignment,return-value]  # no slow imports
        fixed = [
            "--env",
            f"tuned_corridor:{ENV_ID}",
            "--log-folder",
            str(folder),
            "--storage",
            storage,
            "--workers",
            "2",
        ]
        short = ["--eval-freq", "200", "--n-eval-episodes", "1", "--n-final-episodes", "1", "--pruner", "none"]
        size = ["--n-trials", str(wanted), "--grace-seconds", str(GRACE), "--n-seeds", "2"]
        status = 99
        try:
            status = command.main([*fixed, *short, *size, "--hyperparams", *TINY])
        finally:
            sys.stdout.flush()
            os._exit(status)
    try:
        yield child
    finally:
        with suppress(ProcessLookupError, PermissionError):
            os.killpg(child, signal.SIGKILL)
        with suppress(ChildProcessError):
            os.waitpid(child, 0)


def _alive(process: int) -> bool:
    """Whether a child runs; it is not waited for, so that its number stays its own."""
    try:
        return Path(f"/proc/{process}/stat").read_text().rpartition(")")[2].split()[0] != "Z"
    except FileNotFoundError:
        return False


def _children(parent: int) -> list[int]:
    path = Path(f"/proc/{parent}/task/{parent}/children")
    return [int(child) for child in path.read_text().split()] if path.exists() else []


def _wait(processes: list[int]) -> None:
    until = time.monotonic() + LONGEST
    while time.monotonic() < until and any(map(_alive, processes)):
        time.sleep(0.1)


def _exists(storage: str) -> bool:
    try:
        return NAME in optuna.get_all_study_names(open_storage(storage, GRACE))
    except Exception:  # not there yet
        return False


def _problems(study: optuna.Study, wanted: int) -> list[str]:
    trials = study.get_trials()
    done = [t for t in trials if t.state in COUNTED]
    found = [] if len(done) == wanted else [f"{len(done)} trials are done instead of {wanted}"]
    if len({str(sorted(t.params.items())) for t in done}) < len(done):
        found.append("a trial was counted twice")
    if sum(t.user_attrs.get(ORIGIN) == "default" for t in done) != 1:
        found.append("the baseline was not done once")
    if any(len(t.user_attrs.get("seed_values", {})) != 2 for t in done):
        found.append("a trial was done without all of its seeds")
    chains = {t.system_attrs.get("failed_trial", t.number) for t in trials if t.params}  # a trial and its repetitions
    kept = {t.system_attrs.get("failed_trial", t.number) for t in done}
    kept |= {t.number for t in trials if t.state == TrialState.FAIL and t.number not in _repeated(trials)
             and any(t.params == other.params for other in done)}  # fmt: skip
    lost = sorted(chains - kept)
    return [*found, *([f"trials {lost} were lost"] if lost else [])]


def _repeated(trials: list[optuna.trial.FrozenTrial]) -> set[int]:
    return {t.system_attrs["failed_trial"] for t in trials if "failed_trial" in t.system_attrs}
