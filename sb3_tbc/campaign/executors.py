"""Where runs are carried out: processes on this machine, Slurm, or a Ray cluster. One interface for the three."""

from __future__ import annotations

import contextlib
import ctypes
import os
import signal
import socket
import subprocess
import sys
import threading
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import IO, Any, Protocol

from sb3_tbc.aliases import PlainMapping
from sb3_tbc.campaign.jobs import Job
from sb3_tbc.commands import INTERRUPTED
from sb3_tbc.errors import ConfigError
from sb3_tbc.extras import require

PAUSE = 0.2
"""Seconds between two looks at a run."""


class Handle(Protocol):
    """A run that was started."""

    def poll(self) -> int | None:
        """The exit status, or ``None`` while the run goes on."""

    def stop(self) -> None:
        """Ask the run to save itself and end; returns at once."""


class Executor(Protocol):
    """A place where runs are carried out."""

    def start(self, job: Job) -> Handle:
        """Start a run, from its last checkpoint where there is one."""

    def close(self) -> None:
        """Let go of the place; running jobs were stopped before."""


def start_training(job: Job, output: IO[bytes], at_parents_death: signal.Signals) -> subprocess.Popen[bytes]:
    """The training command as a process of its own, which ends when this process does.

    It has a session of its own, so that Ctrl-C in a terminal reaches it once, from us, and not twice.
    """
    return subprocess.Popen(
        job.command(),
        stdout=output,
        stderr=output,
        cwd=job.cwd,
        env={**os.environ, "OMP_NUM_THREADS": "1"},
        start_new_session=True,
        preexec_fn=_end_with_parent(at_parents_death),
    )


def _end_with_parent(number: signal.Signals) -> Callable[[], None] | None:
    """What a child does before it runs: ask Linux for a signal when its parent ends, however it ends."""
    if not sys.platform.startswith("linux"):
        return None
    libc, set_parent_death_signal = ctypes.CDLL(None), 1

    def ask() -> None:
        libc.prctl(set_parent_death_signal, int(number))

    return ask


def run_job(job: Job) -> int:
    """Carry out a run in this process and wait for its end; what a Slurm job and a Ray task do.

    :return: exit status of the training command
    """
    if job.folder.finished:
        return 0
    job.folder.path.mkdir(parents=True, exist_ok=True)
    with job.log.open("ab") as output:
        # When a machine's agent is killed, the run must be gone before another machine continues it.
        process = start_training(job, output, signal.SIGKILL)
        try:
            while (status := process.poll()) is None:
                time.sleep(PAUSE)  # Ray's cancel does not interrupt a wait in the system, it is noticed between two
            return status
        except BaseException:  # cancelled: the run saves itself before this process ends
            process.terminate()
            process.wait()
            raise


def run_slurm_job(job: Job) -> int:
    """Carry out a run; at the job's time limit submitit raises an error in it, and the run has saved itself.

    A job that is preempted ends with ``SystemExit``: Slurm begins it again, so it must leave no result.

    :return: exit status of the training command
    """
    submitit = require("submitit", extra="cluster", what="--executor slurm")
    try:
        return run_job(job)
    except submitit.core.utils.UncompletedJobError:
        return INTERRUPTED


class LocalHandle:
    """A process on this machine."""

    def __init__(self, process: subprocess.Popen[bytes]) -> None:
        self.process = process

    def poll(self) -> int | None:
        """The exit status, or ``None`` while the run goes on."""
        return self.process.poll()

    def stop(self) -> None:
        """Ask the run to save itself and end."""
        self.process.terminate()


class LocalExecutor:
    """Processes on this machine, one thread each."""

    def start(self, job: Job) -> LocalHandle:
        """Start a run."""
        job.folder.path.mkdir(parents=True, exist_ok=True)
        with job.log.open("ab") as output:
            return LocalHandle(start_training(job, output, signal.SIGTERM))

    def close(self) -> None:
        """Nothing to let go of."""


class SlurmHandle:
    """A Slurm job, through submitit."""

    def __init__(self, job: Any) -> None:
        self.job = job

    def poll(self) -> int | None:
        """The exit status, or ``None`` while the run goes on; 1 when Slurm ended the job without one."""
        if not self.job.done():
            return None
        return int(self.job.result()) if self.job.exception() is None else 1

    def stop(self) -> None:
        """Cancel the job; Slurm asks the run to end first."""
        # scancel fails for a job that has just ended, and the others must still be asked
        with contextlib.suppress(subprocess.SubprocessError, OSError):
            self.job.cancel()


class SlurmExecutor:
    """Jobs of a Slurm cluster. All machines must see the folders under the same paths.

    :param folder: where submitit keeps its files
    :param settings: for submitit, e.g. ``{"slurm_partition": "short", "timeout_min": 600}``
    :param cluster: ``"slurm"``, or ``"local"`` to try submitit without a cluster
    :raises MissingExtraError: without submitit
    :raises ConfigError: where there is no Slurm, or for a setting that submitit does not know
    """

    def __init__(self, folder: Path, settings: PlainMapping, cluster: str = "slurm") -> None:
        submitit = require("submitit", extra="cluster", what="--executor slurm")
        try:
            self.executor = submitit.AutoExecutor(folder=folder, cluster=cluster)
            self.executor.update_parameters(**{"cpus_per_task": 1, "timeout_min": 24 * 60, **settings})
        # submitit asserts the kinds of its settings
        except (RuntimeError, NameError, TypeError, ValueError, AssertionError) as error:
            raise ConfigError(f"--executor slurm: {error}") from error

    def start(self, job: Job) -> SlurmHandle:
        """Submit a run."""
        self.executor.update_parameters(name=f"{job.env}-{job.algo}-{job.seed}".replace("/", "_"))
        return SlurmHandle(self.executor.submit(run_slurm_job, job))

    def close(self) -> None:
        """Nothing to let go of: Slurm keeps its queue."""


class RayHandle:
    """A task on a Ray cluster."""

    def __init__(self, ray: Any, reference: Any) -> None:
        self.ray, self.reference = ray, reference

    def poll(self) -> int | None:
        """The exit status, or ``None`` while the run goes on; 1 when the task ended without one."""
        ready, _ = self.ray.wait([self.reference], timeout=0)
        if not ready:
            return None
        try:
            return int(self.ray.get(self.reference))
        except self.ray.exceptions.RayError:
            return 1

    def stop(self) -> None:
        """Cancel the task, which stops its run."""
        with contextlib.suppress(Exception):  # it may have ended in this moment
            self.ray.cancel(self.reference)


class RayExecutor:
    """Tasks on a Ray cluster, one core each; when a machine is lost, another continues its runs.

    All machines must see the folders under the same paths.

    :param address: of the cluster; ``None`` for the one of this machine (``RAY_ADDRESS``), or a new one on it
    :raises MissingExtraError: without Ray
    :raises ConfigError: if there is no cluster at the address
    """

    def __init__(self, address: str | None = None) -> None:
        self.ray = require("ray", extra="cluster", what="--executor ray")
        self.started = not self.ray.is_initialized()
        if self.started:
            _check_address(address or os.environ.get("RAY_ADDRESS"))
            with _kept_handler(signal.SIGTERM):
                self._join(address)
        # Ray repeats a task whose machine died; the run then continues from its last checkpoint.
        self.run = self.ray.remote(num_cpus=1, max_retries=-1, retry_exceptions=False)(run_job)

    def _join(self, address: str | None) -> None:
        try:
            self.ray.init(address=address, log_to_driver=False, configure_logging=False)
        except (ConnectionError, RuntimeError, ValueError) as error:
            raise ConfigError(f"--executor ray cannot join the cluster {address or ''}: {error}") from error

    def start(self, job: Job) -> RayHandle:
        """Put a run into the cluster's queue."""
        return RayHandle(self.ray, self.run.remote(job))

    def close(self) -> None:
        """Leave the cluster, if we were not in it before."""
        if self.started:
            self.ray.shutdown()


@contextlib.contextmanager
def _kept_handler(number: signal.Signals) -> Iterator[None]:
    """Keep what a signal does: joining a cluster, Ray lets SIGTERM end this process, and its runs with it, unsaved."""
    before = signal.getsignal(number)
    yield
    if threading.current_thread() is threading.main_thread():  # elsewhere neither Ray nor we can set one
        signal.signal(number, before)


def _check_address(address: str | None) -> None:
    """Ray ends the whole process when nobody answers at ``host:port``, so ask first.

    :raises ConfigError: if nobody answers
    """
    host, _, port = (address or "").rpartition(":")
    if not host or "/" in host or not port.isdecimal():
        return
    try:
        socket.create_connection((host, int(port)), timeout=5.0).close()
    except OSError as error:
        cure = "start one with: ray start --head"
        raise ConfigError(f"--executor ray: no cluster answers at {address} ({error}); {cure}") from error
