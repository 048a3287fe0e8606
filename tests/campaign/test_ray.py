"""A real Ray cluster of two nodes on this machine, one of which is killed in the middle of its run."""

from __future__ import annotations

import _thread
import io
import os
import signal
import sys
import threading
import time
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest
from rich.console import Console
from test_campaign import fake_training, make_job

from sb3_tbc import reproduce
from sb3_tbc.campaign.campaign import Campaign
from sb3_tbc.campaign.executors import RayExecutor, run_job
from sb3_tbc.campaign.progress import Board
from sb3_tbc.errors import ConfigError
from sb3_tbc.extras import MissingExtraError

STEPS = 3000
SMALL = [
    *("--n-timesteps", str(STEPS), "--eval-freq", "500", "--n-eval-episodes", "1", "--n-final-episodes", "1"),
    *("--hyperparams", "compile:false", "gradient_ratio:0.1", "low.batch_size:16", "high.batch_size:8"),
]


def test_without_ray_the_extra_is_named(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "ray", None)
    with pytest.raises(MissingExtraError, match=r"sb3_tbc\[cluster\]"):
        RayExecutor()


def test_without_a_cluster_at_the_address(capfd: pytest.CaptureFixture[str]) -> None:
    pytest.importorskip("ray")
    with pytest.raises(ConfigError, match=r"no cluster answers at 127\.0\.0\.1:1"):
        RayExecutor("127.0.0.1:1")


def test_a_cancelled_task_lets_its_run_save_itself(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    job = make_job(tmp_path)
    saves = (
        "import signal, sys, time; signal.signal(15, lambda *_: sys.exit(print('saved'))); print('begun', flush=True)"
    )
    fake_training(monkeypatch, f"{saves}; time.sleep(20)")

    def cancel() -> None:
        while not job.log.is_file() or "begun" not in job.log.read_text():
            time.sleep(0.05)
        _thread.interrupt_main()  # what Ray does, which wakes no call that waits in the system

    threading.Thread(target=cancel, daemon=True).start()
    with pytest.raises(KeyboardInterrupt):
        run_job(job)
    assert job.log.read_text() == "begun\nsaved\n"


def test_a_polite_kill_still_stops_the_campaign_like_ctrl_c(monkeypatch: pytest.MonkeyPatch) -> None:
    def init(**_: object) -> None:
        signal.signal(signal.SIGTERM, lambda *_: sys.exit(15))  # as Ray's own

    ray = SimpleNamespace(is_initialized=lambda: False, init=init, remote=lambda **_: lambda run: run)
    monkeypatch.setitem(sys.modules, "ray", ray)
    before = signal.signal(signal.SIGTERM, signal.default_int_handler)
    try:
        RayExecutor("auto")
        with pytest.raises(KeyboardInterrupt):
            os.kill(os.getpid(), signal.SIGTERM)
    finally:
        signal.signal(signal.SIGTERM, before)


@pytest.fixture
def cluster() -> Iterator[tuple[Any, Any]]:
    """A head without cores, so that runs are carried out on the two nodes that join it."""
    pytest.importorskip("ray")
    import ray
    from ray.cluster_utils import Cluster

    made = Cluster(initialize_head=True, head_node_args={"num_cpus": 0, "include_dashboard": False})
    ray.init(address=made.address, log_to_driver=False, configure_logging=False)
    yield ray, made
    ray.shutdown()
    made.shutdown()


@pytest.mark.slow
def test_a_killed_node_loses_nothing(cluster: tuple[Any, Any], tmp_path: Path) -> None:
    _, made = cluster
    first = made.add_node(num_cpus=1)
    folders = ["--log-folder", str(tmp_path / "runs"), "--ledger", str(tmp_path / "results")]
    (job,) = reproduce.jobs(["--tasks", "Pendulum", "--algos", "hits", "--seeds", "1", *folders, *SMALL])
    # a checkpoint every second, so that there is one to continue from
    job = replace(job, arguments=("--checkpoint-minutes", "0.01", *job.arguments))

    class KillsTheNode(Board):
        """Kills the first node once its run has a checkpoint; another takes its place."""

        killed_at: int | None = None

        def show(self, running: Any) -> None:
            rows = job.folder.read_evaluations()
            if self.killed_at is None and job.folder.resumable and rows and rows[-1].timesteps < STEPS:
                self.killed_at = rows[-1].timesteps
                made.remove_node(first, allow_graceful=False)
                made.add_node(num_cpus=1)
            time.sleep(0.2)

    said = io.StringIO()
    with KillsTheNode(1, Console(file=said, width=300)) as board:
        failed = Campaign(RayExecutor(), 1, board, reproduce.wanted_run).run([job])
    assert failed == [], said.getvalue() + job.log.read_text()
    assert board.killed_at is not None, "the run ended before the node was killed"
    final = job.target.read_final()
    assert final["n_timesteps"] == STEPS
    steps = [row.timesteps for row in job.target.read_evaluations()]
    assert len(steps) == len(set(steps)) == STEPS // 500  # nothing twice, nothing lost
    assert job.folder.path.joinpath("command.txt").read_text().count("--resume") == 0
    assert len(list(job.folder.path.glob("progress_until_*.csv"))) >= 1, "it began anew instead of continuing"


@pytest.mark.slow
def test_ctrl_c_leaves_every_run_saved(cluster: tuple[Any, Any], tmp_path: Path) -> None:
    _, made = cluster
    made.add_node(num_cpus=1)
    folders = ["--log-folder", str(tmp_path / "runs"), "--ledger", str(tmp_path / "results")]
    (job,) = reproduce.jobs(["--tasks", "Pendulum", "--algos", "hits", "--seeds", "1", *folders, *SMALL])

    class PressesCtrlC(Board):
        def show(self, running: Any) -> None:
            if job.folder.read_evaluations():
                raise KeyboardInterrupt

    with PressesCtrlC(1, Console(file=io.StringIO())) as board, pytest.raises(KeyboardInterrupt):
        Campaign(RayExecutor(), 1, board, reproduce.wanted_run).run([job])
    assert job.folder.resumable, job.log.read_text()
