"""Planned runs: what counts as finished, and the commands that make the rest."""

from __future__ import annotations

import shlex
from pathlib import Path

import pytest
from made_up_runs import fake_run

from sb3_tbc.errors import ConfigError
from sb3_tbc.report.planned import missing_table
from sb3_tbc.report.runs import load_results
from sb3_tbc.reproduce import jobs


def test_rows_of_a_plan_may_have_options_of_their_own(tmp_path: Path) -> None:
    fake_run(tmp_path, "Pendulum", "tbc-hrl", 100, 1.0)
    own = "first_seed: 102, options: [--n-eval-episodes, 20]"
    rows = f"{{task: Pendulum, seeds: 1, {own}, methods: [tbc-hrl, tbc-hrl no-ts-paper]}}"
    rows += ", {task: Drawbridge, seeds: 1, methods: [tbc-hrl]}"
    plan = tmp_path / "campaign.yml"
    plan.write_text(f"first_seed: 100\noptions: [--n-eval-episodes, 100]\nruns: [{rows}]")
    commands = [row[3] for row in missing_table(tmp_path, load_results(tmp_path))[1:]]
    planned = [job for command in commands for job in jobs(shlex.split(command)[3:])]
    assert [job.seed for job in planned] == [102, 102, 100]
    assert [job.n_episodes for job in planned] == [40 * 20 + 100, 40 * 20 + 100, 40 * 100 + 100]
    assert [job.variant for job in planned] == ["full", "no-ts-paper", "full"]
    assert {"--ablation", "no-ts", "--config", "paper"} <= set(planned[1].arguments)
    plan.write_text(f"first_seed: 100\nruns: [{rows}, {{task: Pendulum, seeds: 1, methods: [hits]}}]")
    with pytest.raises(ConfigError, match="all methods of a task must be evaluated alike"):
        missing_table(tmp_path, load_results(tmp_path))


def test_missing_runs_come_with_a_command_that_is_understood(tmp_path: Path) -> None:
    counts = {"n_timesteps": 500, "eval_freq": 500, "n_eval_episodes": 100}
    for seed in (0, 100):
        fake_run(tmp_path, "Pendulum", "tbc-hrl", seed, 1.0, config=counts)
    fake_run(tmp_path, "Pendulum", "hits", 100, 1.0, config=counts)
    rows = "{task: Pendulum, seeds: 2, n_timesteps: 500, methods: [tbc-hrl, tbc-hrl no-ts, tbc-hrl full-paper]}"
    rows += ", {task: Pendulum, seeds: 1, n_timesteps: 500, methods: [hits]}"
    (tmp_path / "campaign.yml").write_text(f"first_seed: 100\noptions: [--n-eval-episodes, 100]\nruns: [{rows}]")
    _, *missing = missing_table(tmp_path, load_results(tmp_path))
    assert [row[:3] for row in missing] == [
        ["Pendulum", "tbc-hrl", "1 of 2"],
        ["Pendulum", "tbc-hrl no-ts", "0 of 2"],
        ["Pendulum", "tbc-hrl full-paper", "0 of 2"],
    ]
    variants = []
    for row in missing:
        planned = list(jobs(shlex.split(row[3])[3:]))
        assert [job.seed for job in planned] == [100, 101]
        assert {job.n_timesteps for job in planned} == {500}
        assert "--n-eval-episodes" in planned[0].arguments
        variants.append(planned[0].target.path.parent.name)
    assert variants == ["full", "no-ts", "full-paper"]
    many = f"{{first_seed: 0, runs: [{{task: A, seeds: {10**30}, methods: [sac]}}]}}"
    for wrong in ("runs: 3", "runs: [options]", many):
        (tmp_path / "campaign.yml").write_text(wrong)
        with pytest.raises(ConfigError, match="cannot read the plan"):
            missing_table(tmp_path, load_results(tmp_path))


def test_runs_made_otherwise_than_planned_do_not_count(tmp_path: Path) -> None:
    planned = {"n_timesteps": 200_000, "eval_freq": 5000, "n_eval_episodes": 20}
    changes: tuple[dict[str, int], ...] = ({}, {"n_timesteps": 100}, {"eval_freq": 100}, {"n_eval_episodes": 100})
    for seed, change in enumerate(changes):
        fake_run(tmp_path, "Pendulum", "tbc-hrl", seed, 1.0, config={**planned, **change})
    plan = tmp_path / "campaign.yml"
    plan.write_text("{first_seed: 0, runs: [{task: Pendulum, seeds: 4, methods: [tbc-hrl]}]}")
    assert missing_table(tmp_path, load_results(tmp_path))[1][2] == "1 of 4"


def test_options_of_a_plan_may_be_written_with_a_sign_of_equality(tmp_path: Path) -> None:
    fake_run(tmp_path, "Pendulum", "tbc-hrl", 0, 1.0, config={"n_timesteps": 200_000, "eval_freq": 50})
    rows = "{task: Pendulum, seeds: 1, options: [--eval-freq=50, --n-eval-episodes=10], methods: [tbc-hrl, hits]}"
    (tmp_path / "campaign.yml").write_text(f"{{first_seed: 0, runs: [{rows}]}}")
    _, (*said, command) = missing_table(tmp_path, load_results(tmp_path))
    assert said == ["Pendulum", "hits", "0 of 1"]
    assert command.endswith("--eval-freq 50 --n-eval-episodes 10")


@pytest.mark.parametrize(
    ("row", "told"),
    [
        ("seeds: 1, options: --eval-freq 50", "options must be a list of words.*got '--eval-freq 50'"),
        ("seeds: 1, options: [--n-timesteps, 500]", "options must not hold --n-timesteps"),
        ("seeds: 0", "seeds and n_timesteps are 1 or more"),
        ("seeds: 1, first_seed: -1", "first_seed is 0 or more"),
        ("seeds: 1, n_timesteps: -3", "n_timesteps are 1 or more"),
    ],
)
def test_plans_that_mean_nothing(row: str, told: str, tmp_path: Path) -> None:
    fake_run(tmp_path, "Pendulum", "tbc-hrl", 0, 1.0)
    rows = f"{{task: Pendulum, {row}, methods: [tbc-hrl]}}"
    (tmp_path / "campaign.yml").write_text(f"{{first_seed: 0, runs: [{rows}]}}")
    with pytest.raises(ConfigError, match=told):
        missing_table(tmp_path, load_results(tmp_path))


def test_plans_that_evaluate_a_task_at_other_steps_are_refused(tmp_path: Path) -> None:
    fake_run(tmp_path, "Pendulum", "tbc-hrl", 0, 1.0)
    plan = tmp_path / "campaign.yml"
    rows = (
        "{task: Pendulum, seeds: 1, methods: [tbc-hrl]}, {task: Pendulum, seeds: 1, n_timesteps: 400, methods: [hac]}"
    )
    plan.write_text(f"{{first_seed: 0, runs: [{rows}]}}")
    with pytest.raises(ConfigError, match="evaluated every 5000 steps with tbc-hrl and every 500 with hac"):
        missing_table(tmp_path, load_results(tmp_path))
    plan.write_text(f"{{first_seed: 0, options: [--eval-freq, 500], runs: [{rows}]}}")
    assert [row[2] for row in missing_table(tmp_path, load_results(tmp_path))[1:]] == ["0 of 1", "0 of 1"]
    plan.write_text(f"{{first_seed: 0, options: [--eval-freq], runs: [{rows}]}}")
    with pytest.raises(ConfigError, match="cannot read the plan"):
        missing_table(tmp_path, load_results(tmp_path))


@pytest.mark.parametrize(
    ("plan", "said"),
    [
        ("runs: [{task: A, seeds: 2, methods: [hits], n_timestep: 5}]", "unknown key 'n_timestep' .*'n_timesteps'"),
        ("runs: [{task: A, methods: [hits]}]", "seeds is missing in"),
        ("runs: [{task: A, seeds: 2, methods: hits}]", "methods must be a list, as .*, got 'hits'"),
        ("run: []", "unknown key 'run' .*'runs'"),
        ("{}", "runs is missing in"),
    ],
)
def test_keys_of_a_plan_that_nobody_reads_or_that_are_missing(plan: str, said: str, tmp_path: Path) -> None:
    (tmp_path / "campaign.yml").write_text(plan if plan == "{}" else f"first_seed: 0\n{plan}\n")
    with pytest.raises(ConfigError, match=said):
        missing_table(tmp_path, {})


def test_a_planned_ablation_that_no_longer_exists_is_told_in_its_row_and_ends_no_report(tmp_path: Path) -> None:
    fake_run(tmp_path, "Pendulum", "tbc-hrl", 0, 1.0, config={"n_timesteps": 500})
    rows = "{task: Pendulum, seeds: 1, n_timesteps: 500, methods: [tbc-hrl, tbc-hrl no-tz, tbc-hrl no-tz-paper, hits]}"
    (tmp_path / "campaign.yml").write_text(f"{{first_seed: 0, runs: [{rows}]}}")
    _, *missing = missing_table(tmp_path, load_results(tmp_path))
    told = {method: (done, command) for _, method, done, command in missing}
    for method in ("tbc-hrl no-tz", "tbc-hrl no-tz-paper"):
        assert told[method] == ("0 of 1", "none: no ablation 'no-tz'; did you mean 'no-ts'?")
    assert "--algos hits" in told["hits"][1]
