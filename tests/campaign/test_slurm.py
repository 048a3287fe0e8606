"""What a Slurm job makes of the ways in which submitit ends it."""

from __future__ import annotations

import subprocess
from pathlib import Path
from types import SimpleNamespace

import pytest
from test_campaign import make_job

from sb3_tbc.campaign import executors


def test_at_its_time_limit_a_run_is_stopped_and_preempted_it_leaves_no_result(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    submitit = pytest.importorskip("submitit")

    def ended_by(error: BaseException) -> int:
        def run(job: object) -> int:
            raise error

        monkeypatch.setattr(executors, "run_job", run)
        return executors.run_slurm_job(make_job(tmp_path))

    assert ended_by(submitit.core.utils.UncompletedJobError("timed-out and not checkpointable")) == 130
    with pytest.raises(SystemExit):
        ended_by(SystemExit(-1))


def test_a_job_that_ended_before_it_was_cancelled_keeps_no_other_from_being_asked() -> None:
    def scancel() -> None:
        raise subprocess.CalledProcessError(1, ["scancel", "7"])

    executors.SlurmHandle(SimpleNamespace(cancel=scancel)).stop()
