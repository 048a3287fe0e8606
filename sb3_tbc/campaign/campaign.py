"""Carries out a list of runs, several at a time; each result is copied into the ledger."""

from __future__ import annotations

import contextlib
import signal
import threading
import time
from collections import deque
from collections.abc import Callable, Iterator, Sequence

from sb3_tbc.campaign.executors import Executor, Handle
from sb3_tbc.campaign.jobs import Job
from sb3_tbc.campaign.progress import Board
from sb3_tbc.commands import FAILED, INTERRUPTED, USER_MISTAKE
from sb3_tbc.errors import ConfigError, WriteError
from sb3_tbc.files import in_use
from sb3_tbc.outside import one_line
from sb3_tbc.zoo.run_spec import RunSpec

PAUSE = 0.2
"""Seconds between two looks at the running jobs."""
PATIENCE = 120.0
"""Seconds that stopped runs may take to save a checkpoint."""


class Campaign:
    """Carries out jobs; stopping it stops the runs, which save checkpoints.

    :param executor: where they are carried out
    :param workers: how many at a time
    :param board: where progress is shown
    :param wanted: the run that a job stands for; a folder with another run is left alone, and its job fails
    """

    def __init__(self, executor: Executor, workers: int, board: Board, wanted: Callable[[Job], RunSpec]) -> None:
        self.executor, self.workers, self.board, self.wanted = executor, workers, board, wanted
        self.waiting: deque[Job] = deque()
        self.running: dict[Job, Handle] = {}
        self.log_sizes: dict[Job, int] = {}  # before the run began: what earlier attempts wrote, in bytes
        self.failed: list[Job] = []
        self.stopped: list[Job] = []  # by others than us, e.g. when a cluster needs its machine

    def run(self, todo: Sequence[Job]) -> list[Job]:
        """Run jobs in order; returns those that failed. Those that others stopped are in ``stopped``.

        :raises KeyboardInterrupt: after Ctrl-C, when the runs are stopped
        """
        self.waiting.extend(todo)
        try:
            while self.waiting or self.running:
                self._begin_free()
                for job, handle in list(self.running.items()):
                    status = handle.poll()
                    if status is not None:
                        del self.running[job]
                        self._end(job, status)
                self.board.show(self.running)
                time.sleep(PAUSE)
        except KeyboardInterrupt:
            self._stop()
            raise
        return self.failed

    def _begin_free(self) -> None:
        """Begin waiting runs while there are workers; one that another process is at is waited for."""
        for job in list(self.waiting):
            if len(self.running) >= self.workers:
                return
            if not job.target.finished and in_use(job.folder.path):
                self.board.wait(job)
            else:
                self.waiting.remove(job)
                self._begin(job)

    def _begin(self, job: Job) -> None:
        if job.target.finished:  # another campaign was faster
            self._end(job, 0)
            return
        try:
            if job.holds_run:
                job.require(self.wanted(job))
            if job.folder.finished:  # trained earlier, and stopped before it was copied
                self._end(job, 0)
                return
            self.board.begin(job)
            self.log_sizes[job] = job.log.stat().st_size if job.log.is_file() else 0
            self.running[job] = self.executor.start(job)
        except (OSError, ConfigError) as error:
            self._fail(job, FAILED, one_line(error))

    def _end(self, job: Job, status: int) -> None:
        if (status == 0 and job.folder.finished) or job.target.finished:
            try:
                job.keep_result()
            except (OSError, ValueError) as error:
                self._fail(job, status, f"its result cannot be copied: {one_line(error)}")
            else:
                self.board.done(job)
        elif status == USER_MISTAKE and in_use(job.folder.path):  # another process began it in the same moment
            self.waiting.append(job)
            self.board.wait(job)
        elif status == INTERRUPTED:
            self.stopped.append(job)
            self.board.stopped(job)
        else:
            self._fail(job, status, job.last_line(self.log_sizes[job]))

    def _fail(self, job: Job, status: int, message: str) -> None:
        """Record a failure; one that cannot be recorded is told, and ends no other run."""
        self.failed.append(job)
        try:
            job.keep_failure(status, message)
        except WriteError as error:
            message += f" ({one_line(error)})"
        self.board.fail(job, status, message)

    def _stop(self) -> None:
        """Ask each run once to stop, and wait until all have saved a checkpoint."""
        with _signals_ignored():
            self.board.stopping(len(self.running), PATIENCE)
            for handle in self.running.values():
                handle.stop()
            until = time.monotonic() + PATIENCE
            while self.running and time.monotonic() < until:
                for job, handle in list(self.running.items()):
                    if handle.poll() is not None:
                        del self.running[job]
                        self.board.stopped(job)
                time.sleep(PAUSE)


@contextlib.contextmanager
def _signals_ignored() -> Iterator[None]:
    """Let a second Ctrl-C change nothing: runs on a cluster would go on that were not asked yet, or end unsaved.

    The commands that ask them, such as ``scancel``, do not hear it either.
    """
    if threading.current_thread() is not threading.main_thread():
        yield
        return
    before = {number: signal.signal(number, signal.SIG_IGN) for number in (signal.SIGINT, signal.SIGTERM)}
    try:
        yield
    finally:
        for number, handler in before.items():
            signal.signal(number, handler)
