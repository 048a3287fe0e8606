"""Progress of a campaign: a line when a run begins or ends, and on a terminal a bar for each run."""

from __future__ import annotations

import time
from collections.abc import Iterable

from rich.console import Console
from rich.markup import escape
from rich.progress import BarColumn, Progress, TaskID, TextColumn, TimeElapsedColumn, TimeRemainingColumn

from sb3_tbc.campaign.jobs import Job
from sb3_tbc.errors import ConfigError
from sb3_tbc.outside import one_line

EVERY = 2.0
"""Seconds between two looks into the runs' folders."""


def _result(job: Job) -> str:
    """A run's result in words; one that says nothing sensible, which a report refuses, ends no campaign."""
    try:
        final = job.target.read_final()
        return f"success {final['success_rate']:.2f} at {final['n_timesteps']:,} steps"
    except (ConfigError, KeyError, TypeError, ValueError) as error:
        return f"(its final.json is not understood, and a report will refuse it: {one_line(repr(error))})"


class Board:
    """Shows the progress of every run.

    :param total: runs to do
    :param console: where; bars are drawn on a terminal only
    """

    def __init__(self, total: int, console: Console | None = None) -> None:
        self.console = console or Console(highlight=False, soft_wrap=True)
        columns = TextColumn("{task.description}"), BarColumn(), TextColumn("{task.fields[said]}")
        self.bars = Progress(*columns, TimeElapsedColumn(), TimeRemainingColumn(), console=self.console,
                             disable=not self.console.is_terminal)  # fmt: skip
        self.all = self.bars.add_task("all runs", total=total, said=f"0 of {total}")
        self.tasks: dict[Job, TaskID] = {}
        self.waiting: set[Job] = set()
        self.ended, self.total = 0, total
        self._looked = 0.0

    def __enter__(self) -> Board:
        self.bars.start()
        return self

    def __exit__(self, *_: object) -> None:
        self.bars.stop()

    def begin(self, job: Job) -> None:
        """A run begins."""
        self._say(f"begin   {job.name}   (log: {job.log})")
        self.tasks[job] = self.bars.add_task(escape(job.name), total=job.n_timesteps or None, said="")

    def wait(self, job: Job) -> None:
        """Another process is at a run; said once."""
        if job in self.tasks:
            self.bars.remove_task(self.tasks.pop(job))
        if job not in self.waiting:
            self.waiting.add(job)
            self._say(f"waits   {job.name}   (another process is at it)")

    def show(self, running: Iterable[Job]) -> None:
        """Read from the runs' folders how far they are."""
        if not self.console.is_terminal or time.monotonic() - self._looked < EVERY:
            return
        self._looked = time.monotonic()
        for job in running:
            try:
                rows = job.folder.read_evaluations()
            except ConfigError:  # damaged: the run itself tells it, and ends no other
                continue
            if rows and job in self.tasks:
                said = f"{rows[-1].timesteps:,} steps, success {rows[-1].success_rate:.2f}"
                self.bars.update(self.tasks[job], completed=rows[-1].timesteps, said=said)

    def done(self, job: Job) -> None:
        """A run is finished and in the ledger."""
        self._say(f"done    {job.name}   {_result(job)}")
        self._close(job)

    def fail(self, job: Job, status: int, message: str) -> None:
        """A run ended in an error."""
        self._say(f"failed  {job.name}   (exit status {status}, see {job.log}) {message}".rstrip())
        self._close(job)

    def stopping(self, count: int, seconds: float) -> None:
        """Runs were asked to stop; said at once, as nothing else is seen until they have saved themselves."""
        if count:
            runs = "1 run saves itself" if count == 1 else f"{count} runs save themselves"
            self._say(f"stopping: {runs}, in at most {seconds:.0f} seconds")

    def stopped(self, job: Job) -> None:
        """A run was asked to stop and can be continued."""
        self._say(f"stopped {job.name}")
        self._close(job)

    def _close(self, job: Job) -> None:
        self.ended += 1
        if job in self.tasks:
            self.bars.remove_task(self.tasks.pop(job))
        self.bars.update(self.all, completed=self.ended, said=f"{self.ended} of {self.total}")

    def _say(self, line: str) -> None:
        self.console.print(escape(line))
