"""Carries out a list of runs, several at a time; each result is copied into the ledger."""

from __future__ import annotations

import time
from collections import deque
from collections.abc import Sequence

from sb3_tbc.campaign.executors import Executor, Handle
from sb3_tbc.campaign.jobs import Job
from sb3_tbc.campaign.progress import Board
from sb3_tbc.commands import INTERRUPTED

PAUSE = 0.2
"""Seconds between two looks at the running jobs."""
PATIENCE = 120.0
"""Seconds that stopped runs may take to save a checkpoint."""


class Campaign:
    """Carries out jobs; stopping it stops the runs, which save checkpoints.

    :param executor: where they are carried out
    :param workers: how many at a time
    :param board: where progress is shown
    """

    def __init__(self, executor: Executor, workers: int, board: Board) -> None:
        self.executor, self.workers, self.board = executor, workers, board
        self.running: dict[Job, Handle] = {}
        self.failed: list[Job] = []

    def run(self, todo: Sequence[Job]) -> list[Job]:
        """Run jobs in order; returns those that failed.

        :raises KeyboardInterrupt: after Ctrl-C, when the runs are stopped
        """
        waiting = deque(todo)
        try:
            while waiting or self.running:
                while waiting and len(self.running) < self.workers:
                    self._begin(waiting.popleft())
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

    def _begin(self, job: Job) -> None:
        if job.folder.finished:  # trained earlier, and stopped before it was copied
            self._end(job, 0)
            return
        self.board.begin(job)
        self.running[job] = self.executor.start(job)

    def _end(self, job: Job, status: int) -> None:
        if status == 0 and job.folder.finished:
            job.keep_result()
            self.board.done(job)
        elif status == INTERRUPTED:
            self.board.stopped(job)
        else:
            self.failed.append(job)
            self.board.fail(job, status, job.keep_failure(status))

    def _stop(self) -> None:
        """Ask each run once to stop, and wait until all have saved a checkpoint."""
        for handle in self.running.values():
            handle.stop()
        until = time.monotonic() + PATIENCE
        while self.running and time.monotonic() < until:
            for job, handle in list(self.running.items()):
                if handle.poll() is not None:
                    del self.running[job]
                    self.board.stopped(job)
            time.sleep(PAUSE)
