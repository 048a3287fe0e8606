"""Stopping a campaign: an impatient second Ctrl-C changes nothing."""

from __future__ import annotations

import io
import os
import signal
from collections.abc import Iterator
from pathlib import Path

import pytest
from rich.console import Console
from test_campaign import Going, Scripted, make_job, wanted

from sb3_tbc.campaign import campaign as campaigns
from sb3_tbc.campaign.campaign import Campaign
from sb3_tbc.campaign.progress import Board


def press_ctrl_c() -> None:
    os.kill(os.getpid(), signal.SIGINT)


@pytest.fixture(autouse=True)
def ctrl_c_raises(monkeypatch: pytest.MonkeyPatch) -> Iterator[None]:
    monkeypatch.setattr(campaigns, "PAUSE", 0.0)
    before = signal.signal(signal.SIGINT, signal.default_int_handler)
    yield
    signal.signal(signal.SIGINT, before)


class Saving(Going):
    """A run that takes a few looks to save itself; the user presses Ctrl-C again in the meantime."""

    def __init__(self) -> None:
        super().__init__()
        self.looks: int | None = None

    def stop(self) -> None:
        press_ctrl_c()
        self.looks = 3

    def poll(self) -> int | None:
        if self.looks is None:
            return None
        press_ctrl_c()
        self.looks -= 1
        return 130 if self.looks <= 0 else None


class Pressed(Board):
    """The user presses Ctrl-C once the runs have begun."""

    def show(self, running: object) -> None:
        press_ctrl_c()


def test_all_runs_are_stopped_and_waited_for_whatever_else_is_pressed(tmp_path: Path) -> None:
    """The second one left the loop: of jobs on a cluster, those after the first were never told to stop."""
    executor, said = Scripted(lambda job: Saving()), io.StringIO()
    with Pressed(3, Console(file=said, width=300)) as board, pytest.raises(KeyboardInterrupt):
        Campaign(executor, 3, board, wanted).run([make_job(tmp_path, seed) for seed in range(3)])  # type: ignore[arg-type]
    assert [handle.looks for handle in executor.handles] == [0, 0, 0]
    lines = said.getvalue().splitlines()
    assert lines[3] == "stopping: 3 runs save themselves, in at most 120 seconds"
    assert [line.split()[0] for line in lines[4:]] == ["stopped"] * 3
    assert signal.getsignal(signal.SIGINT) is signal.default_int_handler
