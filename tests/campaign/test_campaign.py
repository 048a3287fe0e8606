"""A campaign with made-up runs: order, results, failures, stops."""

from __future__ import annotations

import io
import json
import os
import signal
import subprocess
import sys
import time
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import pytest
import yaml
from rich.console import Console

from sb3_tbc.campaign import campaign as campaigns
from sb3_tbc.campaign.campaign import Campaign
from sb3_tbc.campaign.executors import LocalExecutor, SlurmExecutor, run_job
from sb3_tbc.campaign.jobs import FAILED, Job
from sb3_tbc.campaign.progress import Board
from sb3_tbc.errors import ConfigError
from sb3_tbc.extras import MissingExtraError
from sb3_tbc.files import locked
from sb3_tbc.zoo.config import load_config
from sb3_tbc.zoo.ledger import LEDGER_FILES, RunFolder
from sb3_tbc.zoo.run_spec import RunSpec


def make_job(tmp_path: Path, seed: int = 0, env: str = "Pendulum") -> Job:
    folder, target = (RunFolder.for_run(tmp_path / root, env, "hits", "full", seed) for root in ("runs", "results"))
    return Job("hits", env, seed, folder, target, ("--seed", str(seed)), 1000)


def wanted(job: Job) -> RunSpec:
    run = replace(load_config("hits", "Pendulum"), n_timesteps=1000)
    return RunSpec(run, "sb3_tbc/Pendulum-v0", "full", job.seed)


def finish(job: Job) -> None:
    """Leave behind what a finished training leaves behind."""
    job.folder.path.mkdir(parents=True, exist_ok=True)
    for name in LEDGER_FILES:
        (job.folder.path / name).write_text("{}")
    (job.folder.path / "config.yml").write_text(yaml.safe_dump(wanted(job).to_dict()))
    (job.folder.path / "final.json").write_text('{"success_rate": 0.5, "n_timesteps": 1000}')


class Finished:
    """A run that ends at the first look."""

    def __init__(self, status: int) -> None:
        self.status: int | None = status

    def poll(self) -> int | None:
        return self.status

    def stop(self) -> None:
        self.status = 130


class Going(Finished):
    """A run that goes on until it is stopped."""

    def __init__(self) -> None:
        self.status = None


class Scripted:
    """An executor whose runs end as a function says."""

    def __init__(self, start: Callable[[Job], Finished]) -> None:
        self.begin, self.jobs, self.most, self.handles = start, [], 0, list[Finished]()

    def start(self, job: Job) -> Finished:
        self.jobs.append(job.seed)
        self.handles.append(self.begin(job))
        return self.handles[-1]

    def close(self) -> None:
        pass


@pytest.fixture(autouse=True)
def no_pause(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(campaigns, "PAUSE", 0.0)


def carry_out(executor: object, jobs: list[Job], workers: int = 2) -> tuple[list[Job], str]:
    said = io.StringIO()
    with Board(len(jobs), Console(file=said, width=300)) as board:
        failed = Campaign(executor, workers, board, wanted).run(jobs)  # type: ignore[arg-type]
    return failed, said.getvalue()


def test_results_go_to_the_ledger_and_failures_are_recorded(tmp_path: Path) -> None:
    jobs = [make_job(tmp_path, seed) for seed in range(4)]

    def start(job: Job) -> Finished:
        if job.seed == 2:
            job.folder.path.mkdir(parents=True)
            job.log.write_text("begin\nsb3_tbc.train: error: [red] no space\n")
            return Finished(2)
        finish(job)
        return Finished(0)

    failed, said = carry_out(Scripted(start), jobs)
    assert [job.seed for job in failed] == [2]
    assert [job.target.finished for job in jobs] == [True, True, False, True]
    record = json.loads((jobs[2].target.path / FAILED).read_text())
    assert record == {
        "task": "Pendulum",
        "algo": "hits",
        "variant": "full",
        "seed": 2,
        "exit_status": 2,
        "attempts": 1,
        "message": "sb3_tbc.train: error: [red] no space",
    }
    assert "failed  Pendulum hits full seed 2" in said
    assert "[red] no space" in said  # a run's words are no markup
    assert said.count("done    ") == 3

    def start_again(job: Job) -> Finished:
        finish(job)
        return Finished(0)

    carry_out(Scripted(lambda job: Finished(3)), [jobs[2]])
    assert json.loads((jobs[2].target.path / FAILED).read_text())["attempts"] == 2
    assert carry_out(Scripted(start_again), [jobs[2]])[0] == []
    assert not (jobs[2].target.path / FAILED).exists()


def test_a_run_that_is_killed_in_silence_has_no_message_of_an_earlier_attempt(tmp_path: Path) -> None:
    job = make_job(tmp_path)

    def start(job: Job) -> Finished:
        job.folder.path.mkdir(parents=True, exist_ok=True)
        with job.log.open("a") as log:
            log.write(next(said))
        return Finished(-9)

    said = iter(("begin\ndisk full\n", "", "begin\n"))
    messages = []
    for _ in range(3):
        carry_out(Scripted(start), [job])
        messages.append(json.loads((job.target.path / FAILED).read_text())["message"])
    assert messages == ["disk full", "", "begin"]


def test_a_run_that_ends_well_without_a_result_has_failed(tmp_path: Path) -> None:
    failed, _ = carry_out(Scripted(lambda job: Finished(0)), [make_job(tmp_path)])
    assert len(failed) == 1


def test_a_finished_run_is_only_copied(tmp_path: Path) -> None:
    job = make_job(tmp_path)
    finish(job)
    executor = Scripted(lambda job: Finished(1))
    assert carry_out(executor, [job])[0] == []
    assert executor.jobs == []
    assert job.target.finished


def test_what_another_campaign_finished_meanwhile_is_done(tmp_path: Path) -> None:
    jobs = [make_job(tmp_path, seed) for seed in range(3)]

    def start(job: Job) -> Finished:
        for other in jobs[:2]:  # the running one, and one that waits
            if not other.target.finished:
                finish(other)
                other.keep_result()
        finish(job)
        return Finished(0)

    executor = Scripted(start)
    failed, said = carry_out(executor, jobs, workers=1)
    assert failed == []
    assert executor.jobs == [0, 2]
    assert said.count("done    ") == 3


def test_a_run_that_another_process_is_at_is_waited_for(tmp_path: Path) -> None:
    held, late, free = (make_job(tmp_path, seed) for seed in range(3))
    locks = {}

    def hold(job: Job) -> None:
        locks[job] = locked(job.folder.path)
        locks[job].__enter__()

    def start(job: Job) -> Finished:
        if job == late and job not in locks:
            hold(job)  # another process was faster by a moment
            return Finished(2)
        finish(job)
        return Finished(0)

    class Others(Board):
        looks = 0

        def show(self, running: object) -> None:
            self.looks += 1
            if self.looks == 3:
                finish(held)
                for lock in locks.values():
                    lock.__exit__(None, None, None)

    hold(held)
    executor, said = Scripted(start), io.StringIO()
    with Others(3, Console(file=said, width=300)) as board:
        failed = Campaign(executor, 1, board, wanted).run([held, late, free])  # type: ignore[arg-type]
    assert failed == []
    assert executor.jobs == [1, 2, 1]
    assert [said.getvalue().count(f"waits   {job.name}") for job in (held, late, free)] == [1, 1, 0]
    assert said.getvalue().count("done    ") == 3
    assert not list((tmp_path / "results").rglob(FAILED))


def test_a_result_that_cannot_be_kept_is_a_failed_run_and_ends_no_other(tmp_path: Path) -> None:
    jobs = [make_job(tmp_path, seed) for seed in range(3)]
    jobs[1].target.path.parent.mkdir(parents=True)
    jobs[1].target.path.write_text("a file in the ledger's place")

    def start(job: Job) -> Finished:
        finish(job)
        if job.seed == 0:
            job.folder.evaluations.unlink()
        return Finished(0)

    failed, said = carry_out(Scripted(start), jobs, workers=1)
    assert [job.seed for job in failed] == [0, 1]
    assert jobs[2].target.finished
    assert [p.name for p in jobs[0].target.path.iterdir()] == [FAILED]  # nothing is copied by halves
    assert (
        "lacks evaluations.csv and cannot be copied"
        in json.loads((jobs[0].target.path / FAILED).read_text())["message"]
    )
    assert said.count("its result cannot be copied: ") == 2


def test_a_run_that_cannot_be_started_has_failed(tmp_path: Path) -> None:
    jobs = [make_job(tmp_path, seed) for seed in range(2)]

    def start(job: Job) -> Finished:
        if job.seed == 0:
            raise PermissionError(13, "Permission denied", str(job.log))
        finish(job)
        return Finished(0)

    failed, said = carry_out(Scripted(start), jobs)
    assert [job.seed for job in failed] == [0]
    assert "Permission denied" in said
    assert jobs[1].target.finished


def test_a_folder_with_another_run_is_left_alone(tmp_path: Path) -> None:
    shorter, other, unreadable, same = (make_job(tmp_path, seed) for seed in range(4))
    config = wanted(shorter).to_dict() | {"n_timesteps": 600, "eval_freq": 50}
    shorter.folder.start(config, "x")
    shorter.folder.finish({"success_rate": 1.0, "n_timesteps": 600})
    config = wanted(other).to_dict()
    other.folder.start({**config, "model": {**config["model"], "low": {"gamma": 0.5}}}, "x")
    other.folder.model.write_bytes(b"")  # unfinished: it would be continued
    finish(unreadable)
    (unreadable.folder.path / "config.yml").write_text("x: 1")
    same.folder.start(wanted(same).to_dict(), "x")
    same.folder.model.write_bytes(b"")

    def start(job: Job) -> Finished:
        finish(job)
        return Finished(0)

    executor = Scripted(start)
    failed, said = carry_out(executor, [shorter, other, unreadable, same])
    assert failed == [shorter, other, unreadable]
    assert executor.jobs == [same.seed]
    messages = [json.loads((job.target.path / FAILED).read_text())["message"] for job in failed]
    told = "holds another run: n_timesteps is 600 there, not 1000; use another --log-folder"
    assert messages[0].startswith(f"{shorter.folder.path} {told}")
    assert "holds another run: model.low." in messages[1]
    assert "not a run's config.yml" in messages[2]
    assert said.count("failed  ") == 3
    assert not any(job.target.finished for job in failed)


def test_no_more_runs_at_a_time_than_workers(tmp_path: Path) -> None:
    going: list[Going] = []
    most = 0

    def start(job: Job) -> Finished:
        nonlocal most
        for handle in going[:-1]:
            handle.status = 1
        going.append(Going())
        most = max(most, sum(handle.status is None for handle in going))
        if job.seed >= 3:
            for handle in going:
                handle.status = 1
        return going[-1]

    class Impatient(Board):
        def show(self, running: object) -> None:
            for handle in going:
                handle.status = 1

    with Impatient(6, Console(file=io.StringIO())) as board:
        Campaign(Scripted(start), 2, board, wanted).run([make_job(tmp_path, seed) for seed in range(6)])  # type: ignore[arg-type]
    assert most <= 2
    assert len(going) == 6


def test_ctrl_c_stops_every_run_once_and_begins_no_other(tmp_path: Path) -> None:
    stops: list[int] = []

    class Counting(Going):
        def stop(self) -> None:
            stops.append(1)
            super().stop()

    class Interrupted(Board):
        def show(self, running: object) -> None:
            raise KeyboardInterrupt

    executor = Scripted(lambda job: Counting())
    said = io.StringIO()
    with Interrupted(3, Console(file=said)) as board, pytest.raises(KeyboardInterrupt):
        Campaign(executor, 2, board, wanted).run([make_job(tmp_path, seed) for seed in range(3)])  # type: ignore[arg-type]
    assert executor.jobs == [0, 1]
    assert len(stops) == 2
    assert said.getvalue().count("stopped ") == 2
    assert list((tmp_path / "results").rglob("*")) == []  # a stopped run has not failed


def test_bars_on_a_terminal(tmp_path: Path) -> None:
    job = make_job(tmp_path)
    said = io.StringIO()
    console = Console(file=said, force_terminal=True, width=160)
    with Board(1, console) as board:
        board.begin(job)
        job.folder.path.mkdir(parents=True)
        lines = (
            "timesteps,success_rate,episodes,mean_length,subgoal_success,mean_window,wall_time\n400,0.25,4,9,0.5,4,1\n"
        )
        job.folder.evaluations.write_text(lines)
        board.show([job])
        board.bars.refresh()
        job.folder.evaluations.write_text("timesteps\n500\n")
        board._looked = 0.0
        board.show([job])  # a damaged curve ends no campaign
    assert "400 steps, success 0.25" in said.getvalue()


def fake_training(monkeypatch: pytest.MonkeyPatch, code: str) -> None:
    monkeypatch.setattr(Job, "command", lambda self: [sys.executable, "-c", code])


def wait_for(condition: Callable[[], bool]) -> None:
    until = time.monotonic() + 90
    while not condition():
        assert time.monotonic() < until, "waited in vain"
        time.sleep(0.05)


def test_local_runs_write_a_log_and_are_asked_to_stop(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    job = make_job(tmp_path)
    asked = (
        "import signal, sys, time; signal.signal(15, lambda *_: sys.exit(130)); print('on', flush=True); time.sleep(30)"
    )
    fake_training(monkeypatch, asked)
    handle = LocalExecutor().start(job)
    wait_for(lambda: job.log.is_file() and "on" in job.log.read_text())
    assert handle.poll() is None
    assert os.getsid(handle.process.pid) != os.getsid(0)  # Ctrl-C in the terminal does not reach it a second time
    handle.stop()
    wait_for(lambda: handle.poll() == 130)


@pytest.mark.skipif(not sys.platform.startswith("linux"), reason="asks Linux for a signal at the parent's death")
def test_a_run_ends_with_the_process_that_began_it(tmp_path: Path) -> None:
    code = (
        "import sys; from pathlib import Path; sys.path.insert(0, 'tests/campaign')\n"
        "from test_campaign import make_job; from sb3_tbc.campaign.jobs import Job\n"
        "from sb3_tbc.campaign.executors import run_job\n"
        "sleep = 'import os, time; print(os.getpid(), flush=True); time.sleep(60)'\n"
        "Job.command = lambda self: [sys.executable, '-c', sleep]\n"
        f"run_job(make_job(Path({str(tmp_path)!r})))"
    )
    parent = subprocess.Popen([sys.executable, "-c", code], cwd=Path(__file__).parents[2])
    log = make_job(tmp_path).log
    wait_for(lambda: log.is_file() and log.read_text().strip() != "")
    child = int(log.read_text())
    parent.send_signal(signal.SIGKILL)
    parent.wait()

    def gone() -> bool:
        try:
            return Path(f"/proc/{child}/stat").read_text().rpartition(")")[2].split()[0] == "Z"
        except FileNotFoundError:
            return True

    wait_for(gone)


def test_what_a_cluster_runs(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    job = make_job(tmp_path)
    fake_training(monkeypatch, "import sys; print('hello'); sys.exit(3)")
    assert run_job(job) == 3
    assert job.log.read_text() == "hello\n"
    finish(job)
    assert run_job(job) == 0


@pytest.mark.slow
def test_slurm_jobs_through_submitit(tmp_path: Path) -> None:
    """Without a Slurm cluster at hand: submitit's own local cluster, the same calls."""
    pytest.importorskip("submitit")
    job = make_job(tmp_path)
    finish(job)
    executor = SlurmExecutor(tmp_path / "slurm", {"timeout_min": 1}, cluster="local")
    handle = executor.start(job)
    wait_for(lambda: handle.poll() is not None)
    assert handle.poll() == 0
    impossible = executor.start(make_job(tmp_path, 1, env="Nowhere"))
    wait_for(lambda: impossible.poll() is not None)
    assert impossible.poll() != 0
    executor.close()


def test_without_submitit_the_extra_is_named(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "submitit", None)
    with pytest.raises(MissingExtraError, match=r"sb3_tbc\[cluster\]"):
        SlurmExecutor(tmp_path, {})


def test_without_a_slurm_cluster_it_is_one_line(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    pytest.importorskip("submitit")
    monkeypatch.setenv("PATH", str(tmp_path))
    with pytest.raises(ConfigError, match="--executor slurm: "):
        SlurmExecutor(tmp_path / "slurm", {})
    with pytest.raises(ConfigError, match="--executor slurm: "):
        SlurmExecutor(tmp_path / "slurm", {"no_such_setting": 1}, cluster="local")
    with pytest.raises(ConfigError, match=r"--executor slurm: .*timeout_min"):
        SlurmExecutor(tmp_path / "slurm", {"timeout_min": "2h"}, cluster="local")
