"""How long a campaign will take, from finished runs and measured speeds."""

from __future__ import annotations

import zipfile
from dataclasses import replace
from pathlib import Path

import pytest
from test_campaign import make_job

from sb3_tbc.campaign.hours import Speeds, hours_of, hours_together, plan, read_speeds
from sb3_tbc.errors import ConfigError
from sb3_tbc.zoo.ledger import RunFolder


def test_hours_from_finished_runs(tmp_path: Path) -> None:
    for seed, speed in enumerate((100.0, 200.0, 1000.0)):
        folder = RunFolder.for_run(tmp_path / "results", "Pendulum", "hits", "full", seed)
        folder.start({}, "x")
        folder.finish({"task": "Pendulum", "algo": "hits", "variant": "full", "steps_per_second": speed})
    speeds = read_speeds(tmp_path / "results")
    job = make_job(tmp_path, 9)
    assert hours_of(job, speeds) == pytest.approx(1000 / 200 / 3600)
    unknown = make_job(tmp_path, 9, env="Drawbridge")
    assert hours_of(unknown, speeds) is None
    lines = plan([job, unknown], 2, speeds)
    assert lines[0] == "to do   Pendulum hits full seed 9   1,000 steps, 0.00 h"
    assert lines[1].endswith("hours unknown")
    assert "with 2 at a time" in lines[2]
    assert lines[2].endswith("1 runs of unknown length")


@pytest.mark.parametrize(
    ("hours", "workers", "whole"),
    [
        ([1.0, 1.0], 40, 1.0),
        ([1.0, *[0.01] * 9], 5, 1.0),
        ([*[0.5] * 3, 1.0], 2, 1.5),
        ([], 3, 0.0),
        ([1.0, 2.0], 1, 3.0),
    ],
)
def test_the_last_run_ends_when_its_turn_is_over(hours: list[float], workers: int, whole: float) -> None:
    assert hours_together(hours, workers) == pytest.approx(whole)


def test_a_plan_of_which_nothing_is_known_names_no_hours(tmp_path: Path) -> None:
    (*_, last) = plan([make_job(tmp_path), make_job(tmp_path, 1)], 2, read_speeds(tmp_path))
    assert last.startswith("2 runs, hours unknown: no speeds.yml and no finished run of these tasks in")
    assert "measured" not in last
    assert plan([], 1, read_speeds(tmp_path))[-1].startswith("0 runs, 0.0 hours")


def test_a_plan_waits_for_its_longest_run(tmp_path: Path) -> None:
    speeds = Speeds({}, {}, {}, {("Pendulum", ""): 1000 / 3600})
    plans = plan([make_job(tmp_path), make_job(tmp_path, 1)], 40, speeds)
    assert "2.0 hours of one core at measured speeds, evaluations included; about 1.0 hours with 40" in plans[-1]


def test_of_a_stopped_run_the_rest_counts(tmp_path: Path) -> None:
    speeds = Speeds({}, {}, {}, {("Pendulum", ""): 1000 / 3600})
    stopped, trained, damaged = (make_job(tmp_path, seed) for seed in range(3))
    for job in (stopped, trained, damaged):
        job.folder.start({}, "x")
        job.folder.checkpoint.mkdir()
        (job.folder.checkpoint / "state.json").write_text('{"timesteps": 750}')
    trained.folder.finish({})  # only its copy into the ledger is missing
    (damaged.folder.checkpoint / "state.json").write_text('{"timesteps')
    assert [hours_of(job, speeds) for job in (stopped, trained, damaged)] == [0.25, 0.0, 1.0]
    lines = plan([stopped, trained, damaged], 1, speeds)
    assert [line.split("   ")[2] for line in lines[:3]] == [
        "250 of 1,000 steps left, 0.25 h",
        "0 of 1,000 steps left, 0.00 h",
        "1,000 steps, 1.00 h",
    ]


def test_the_evaluation_after_training_counts_until_it_is_done(tmp_path: Path) -> None:
    """Also of a run that lacks nothing else, which has its agent, and a checkpoint of before or none."""
    rows = {("Pendulum", "hits"): 1.0}
    speeds = Speeds(rows, rows, {("Pendulum", "hits"): 10.0}, {})
    fresh, stopped, trained, finished = (
        replace(make_job(tmp_path, seed), n_episodes=300, n_final_episodes=100) for seed in range(4)
    )
    for job in (stopped, trained, finished):
        job.folder.start({}, "x")
        job.folder.checkpoint.mkdir()
        (job.folder.checkpoint / "state.json").write_text('{"timesteps": 750}')
    for job in (trained, finished):
        with zipfile.ZipFile(job.folder.model, "w") as file:
            file.writestr("data", '{"num_timesteps": 1000}')
    finished.folder.finish({})
    seconds = [3600 * (hours_of(job, speeds) or 0.0) for job in (fresh, stopped, trained, finished)]
    assert seconds == pytest.approx([1000 + 3000, 250 + 500 + 1000, 1000, 0])
    assert plan([trained], 1, speeds)[0].endswith("0 of 1,000 steps left, 0.28 h")


def test_hours_without_evaluations_are_not_said_to_include_them(tmp_path: Path) -> None:
    rows = {("Pendulum", "hits"): 1000 / 3600}
    job = replace(make_job(tmp_path), n_episodes=100)
    (_, last) = plan([job], 1, Speeds(rows, rows, {}, {}))
    assert last.endswith("1.0 hours of one core at measured speeds, evaluations included except those of 1 runs, whose "
        "episodes' length is unknown")  # fmt: skip
    for known, planned in (({("Pendulum", ""): 5.0}, job), ({}, replace(job, n_episodes=0))):
        (_, last) = plan([planned], 1, Speeds(rows, rows, known, {}))
        assert last.endswith("evaluations included")


def test_hours_from_measured_speeds_with_evaluations(tmp_path: Path) -> None:
    ledger = tmp_path / "results"
    folder = RunFolder.for_run(ledger, "Pendulum", "hits", "full", 0)
    folder.start({}, "x")
    header = "timesteps,success_rate,episodes,mean_length,subgoal_success,mean_window,wall_time\n"
    folder.evaluations.write_text(header + "500,0,4,200,0.5,4,1\n1000,1,4,100,0.5,4,2\n")
    folder.finish({"task": "Pendulum", "algo": "hits", "variant": "full", "steps_per_second": 1e6})
    rows = "hits: {train: 10, evaluate: 300}, hits full-paper: {train: 5, evaluate: 300}"
    (ledger / "speeds.yml").write_text(f"Pendulum: {{{rows}, hits no-ts: {{train: 1, evaluate: 300}}}}")
    speeds = read_speeds(ledger)
    job = replace(make_job(tmp_path), n_episodes=20)
    assert hours_of(job, speeds) == pytest.approx((1000 / 10 + 20 * 150 / 300) / 3600)
    seconds = {}
    for variant in ("full-paper", "with-memory-paper", "no-ts", "with-memory"):
        folder = RunFolder.for_run(tmp_path, "Pendulum", "hits", variant, 0)
        seconds[variant] = 3600 * (hours_of(replace(job, folder=folder), speeds) or 0.0)
    expected = {"full-paper": 210, "with-memory-paper": 210, "no-ts": 1010, "with-memory": 110}
    assert seconds == pytest.approx(expected)
    assert hours_of(replace(job, algo="sac"), speeds) == pytest.approx(1000 / 1e6 / 3600)  # of its task only
    (ledger / "speeds.yml").write_text("Pendulum: 3")
    with pytest.raises(ConfigError, match=r"speeds\.yml must have"):
        read_speeds(ledger)
