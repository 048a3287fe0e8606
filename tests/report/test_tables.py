"""Tables from made-up runs: what is compared with what, and figures that a plausible mistake would change."""

from __future__ import annotations

import json
import re
import shlex
from pathlib import Path

import numpy as np
import pytest
import yaml
from made_up_runs import fake_run
from sb3_tbc.tasks import make_task

from sb3_tbc import train
from sb3_tbc.errors import ConfigError
from sb3_tbc.report import tables
from sb3_tbc.report.claims import HOLDS, SAME, claims
from sb3_tbc.report.comparisons import (
    against_ablations,
    against_baselines,
    baselines,
    common_threshold,
    convergence_gain,
    difference_of,
    interval_of,
    strongest_baselines,
)
from sb3_tbc.report.conditions import notes_of_row, unequal_conditions
from sb3_tbc.report.departures import departures_of, departures_table
from sb3_tbc.report.paper import load_paper
from sb3_tbc.report.planned import N_EVAL_EPISODES, eval_freq_of, missing_table
from sb3_tbc.report.runs import BEGIN_ALIKE, Curve, describe, load_descriptions, load_results, on_union_of_steps
from sb3_tbc.reproduce import jobs
from sb3_tbc.train import default_eval_freq
from sb3_tbc.zoo.config import load_config, merge

ROOT = Path(__file__).parents[2]


def row_of(root: Path, method: str) -> dict[str, str]:
    header, *rows = tables.success_table(load_results(root))
    (found,) = [row for row in rows if row[1] == method]
    return dict(zip(header, found, strict=True))


def test_final_success_is_the_last_evaluation_not_the_best(tmp_path: Path) -> None:
    fake_run(tmp_path, "A", "tbc-hrl", 0, 0.4, curve=[0.2, 1.0, 0.5, 0.4], best_success_rate=1.0)
    assert row_of(tmp_path, "tbc-hrl")["success"] == "0.400"


def test_worst_is_the_lowest_of_all_seeds_not_their_mean(tmp_path: Path) -> None:
    for seed, lowest in enumerate((0.9, 0.2, 0.7)):
        fake_run(tmp_path, "A", "tbc-hrl", seed, 1.0, worst_after_first_90=lowest)
    fake_run(tmp_path, "A", "hits", 0, 0.5)
    assert row_of(tmp_path, "tbc-hrl")["worst"] == "0.20"
    assert row_of(tmp_path, "hits")["worst"] == "-"


def test_the_interval_resamples_seeds_not_episodes(tmp_path: Path) -> None:
    for seed in range(4):
        fake_run(tmp_path, "A", "tbc-hrl", seed, float(seed % 2))
    assert row_of(tmp_path, "tbc-hrl")["95 % interval"] == "0.000 to 1.000"  # 400 episodes alone: .45 to .55


def test_seeds_that_all_succeed_leave_some_doubt(tmp_path: Path) -> None:
    for seed in range(5):
        fake_run(tmp_path, "A", "tbc-hrl", seed, 1.0)
    assert row_of(tmp_path, "tbc-hrl")["95 % interval"] == "0.993 to 1.000"
    fake_run(tmp_path, "B", "tbc-hrl", 0, 1.0)
    overall = tables.overall_table(load_results(tmp_path))[1]
    assert overall[:4] == ["tbc-hrl", "all", "6", "1.000"]
    assert overall[-1] == "0.978 to 1.000"
    fake_run(tmp_path, "B", "sac", 0, 1.0)
    assert tables.overall_table(load_results(tmp_path))[2][:3] == ["sac", "B", "1"]


def test_episodes_that_begin_alike_count_once(tmp_path: Path) -> None:
    for seed in range(3):
        fake_run(tmp_path, "Drawbridge", "tbc-hrl", seed, 1.0)
    assert row_of(tmp_path, "tbc-hrl")["95 % interval"] == "0.292 to 1.000"
    methods = load_results(tmp_path)["Drawbridge"]
    assert notes_of_row(methods["tbc-hrl"], methods) == ["all episodes begin alike: one counts per seed"]


@pytest.mark.parametrize("task", ["Drawbridge", "Pendulum", "Platforms", "Tennis2D"])
def test_which_tasks_begin_alike(task: str) -> None:
    env = make_task(task)
    first, second = (env.reset(seed=seed)[0] for seed in (1, 2))
    alike = all(np.array_equal(first[key], second[key]) for key in first)
    assert alike == (task in BEGIN_ALIKE)


def test_variants_and_ablations_never_are_baselines(tmp_path: Path) -> None:
    for seed in range(3):
        fake_run(tmp_path, "A", "tbc-hrl", seed, 0.8 + seed / 100)
        fake_run(tmp_path, "A", "tbc-hrl", seed, 1.0, variant="no-ts")
        fake_run(tmp_path, "A", "hits", seed, 0.5)
        fake_run(tmp_path, "A", "hits", seed, 1.0, variant="searched")
        fake_run(tmp_path, "A", "sac", seed, 0.3)
    methods = load_results(tmp_path)["A"]
    assert baselines(methods) == ["hits", "sac"]
    assert strongest_baselines(methods) == ["hits"]
    assert common_threshold(methods) == pytest.approx(0.9 * 0.81)


def test_of_equal_baselines_the_fastest_is_the_strongest(tmp_path: Path) -> None:
    """HAC is first in the alphabet and slow; the figure against it would be a gift."""
    for seed in range(3):
        fake_run(tmp_path, "A", "tbc-hrl", seed, 1.0, curve=[0.0, 1.0, 1.0, 1.0])
        fake_run(tmp_path, "A", "hac", seed, 1.0, curve=[0.0, 0.0, 0.0, 1.0])
        fake_run(tmp_path, "A", "hits", seed, 1.0, curve=[1.0, 1.0, 1.0, 1.0])
        fake_run(tmp_path, "A", "sac", seed, 1.0, curve=[1.0, 1.0, 1.0, 1.0])
    results = load_results(tmp_path)
    assert strongest_baselines(results["A"]) == ["hits", "sac"]
    gains = {row.other: str(row.gain) for row in against_baselines(results)}
    assert gains == {"hac": "2,000", "hits": "-1,000", "sac": "-1,000"}


def test_a_method_that_never_learns_meets_no_threshold(tmp_path: Path) -> None:
    fake_run(tmp_path, "A", "tbc-hrl", 0, 1.0)
    fake_run(tmp_path, "A", "sac", 0, 0.0)
    methods = load_results(tmp_path)["A"]
    gain = convergence_gain(methods["tbc-hrl"], methods["sac"], common_threshold(methods))
    assert gain is not None
    assert (gain.ours, gain.theirs, str(gain)) == (4000, None, "not reached in 4,000")
    fake_run(tmp_path, "B", "tbc-hrl", 0, 0.3)
    fake_run(tmp_path, "B", "sac", 0, 0.0)
    assert common_threshold(load_results(tmp_path)["B"]) is None  # nobody converges: no gain is reported


def test_comparisons_are_tested_over_seeds_and_corrected_together(tmp_path: Path) -> None:
    for seed, noise in enumerate((0.0, 0.01, 0.02)):
        fake_run(tmp_path, "A", "tbc-hrl", seed, 0.95 + noise)
        fake_run(tmp_path, "A", "hits", seed, 0.80 + noise)
        fake_run(tmp_path, "A", "hac", seed, 0.30 + noise)
    fake_run(tmp_path, "B", "tbc-hrl", 0, 1.0)
    fake_run(tmp_path, "B", "hits", 0, 0.1)
    rows = {(row.task, row.other): row for row in against_baselines(load_results(tmp_path))}
    hits = rows["A", "hits"].test
    assert hits.difference == pytest.approx(0.15)
    assert hits.mark == "**"
    assert hits.p_value is not None
    assert hits.p_holm == pytest.approx(hits.p_value)  # the larger of two tests
    assert rows["B", "hits"].test.p_value is None
    line = tables.comparison_table([rows["B", "hits"]])[1]
    assert line[-1] == "fewer than three seeds, strongest baseline"
    assert line[6] == "-"  # one seed against one: no effect size either
    verdicts = {(c.text, c.task): c.verdict for c in claims(load_results(tmp_path))}
    best = "ends with a higher success rate than the strongest baseline"
    assert verdicts[best, "A"] == HOLDS
    assert verdicts[best, "B"] == f"{SAME} (fewer than three seeds)"


def test_seeds_that_never_get_there_are_not_stable(tmp_path: Path) -> None:
    """A few seeds that learn do not beat a baseline that always does."""
    for seed in range(5):
        learns = seed < 2
        fake_run(tmp_path, "A", "tbc-hrl", seed, 1.0 if learns else 0.3, stable_share=1.0 if learns else None)
        for other in ("hits", "hac"):
            fake_run(tmp_path, "A", other, seed, 0.95, stable_share=0.85 + seed / 500)
    found = [claim for claim in claims(load_results(tmp_path)) if "stably" in claim.text]
    assert [claim.verdict for claim in found] == [SAME, SAME]
    assert ["against hac" in found[0].evidence, "against hits" in found[1].evidence] == [True, True]
    assert "once there, 0 for seeds never there: -0.45" in found[0].evidence
    assert row_of(tmp_path, "tbc-hrl")["stable"] == "0.40"


def test_ablations_are_compared_with_the_full_model(tmp_path: Path) -> None:
    for seed in range(3):
        fake_run(tmp_path, "Drawbridge", "tbc-hrl", seed, 0.9 + seed / 100)
        fake_run(tmp_path, "Drawbridge", "tbc-hrl", seed, 0.4 + seed / 100, variant="no-ts")
        fake_run(tmp_path, "Drawbridge", "tbc-hrl", seed, 0.6, variant="something")
    results = load_results(tmp_path)
    (row,) = against_ablations(results)
    assert row.other == "tbc-hrl no-ts"
    assert row.test.difference == pytest.approx(0.5)
    (claim,) = [c for c in claims(results) if c.task == "Drawbridge" and "timed subgoals" in c.text]
    assert claim.verdict == HOLDS


def test_few_seeds_pair_the_episodes_that_both_played(tmp_path: Path) -> None:
    """Both fail in the same episodes, one in a few more: in pairs that is certain, apart it is not."""
    first, second = "1" * 90 + "0" * 10, "1" * 80 + "0" * 20
    fake_run(tmp_path, "A", "tbc-hrl", 0, 0.9, outcomes=first)
    fake_run(tmp_path, "A", "hits", 0, 0.8, outcomes=second)
    methods = load_results(tmp_path)["A"]
    interval = difference_of(methods["tbc-hrl"], methods["hits"])
    assert interval.mean == pytest.approx(0.1)
    assert interval.low < 0 < interval.high  # never narrower than what both sides say apart
    assert methods["hits"][0].outcomes == [1] * 80 + [0] * 20
    assert interval_of(methods["hits"]).low == pytest.approx(0.708, abs=1e-3)


def test_unequal_conditions_are_named(tmp_path: Path) -> None:
    ours = {"env_kwargs": {"observation": "compact"}, "model": {"relative_subgoals": True, "gradient_ratio": 0.25}}
    theirs = {"env_kwargs": {}, "model": {"gradient_ratio": 0.07}, "n_eval_episodes": 20}
    for seed in range(2):
        fake_run(tmp_path, "A", "tbc-hrl", seed, 1.0, config=ours)
        fake_run(tmp_path, "A", "hits", seed, 1.0, config=theirs)
        equal = {**ours, "model": {"gradient_ratio": 0.25, "average_decay": 0.999}}
        fake_run(tmp_path, "A", "sac", seed, 1.0, config=equal)
    results = load_results(tmp_path)
    assert unequal_conditions(results) == {
        "A": {
            "hits": [
                "observation: paper (compact)",
                "subgoals seen: absolute (relative)",
                "updates per step: 0.07 (0.25)",
                "episodes per evaluation: 20 (10)",
            ]
        }
    }
    assert tables.conditions_table(results)[1][:2] == ["A", "hits"]


def test_defaults_are_compared_as_the_values_they_stand_for(tmp_path: Path) -> None:
    levels = {"high": {"average_decay": 0.999}, "low": {"average_decay": 0.999, "gone_since": 3}, "gradient_ratio": 1}
    fake_run(tmp_path, "A", "tbc-hrl", 0, 1.0, config={"model": levels})
    fake_run(tmp_path, "A", "hits", 0, 1.0, config={"model": {"high": {"gradient_ratio": 0.5}}})
    fake_run(tmp_path, "A", "hac", 0, 1.0, config={"model": {}})
    fake_run(tmp_path, "A", "sac", 0, 1.0, config={"model": {}})
    assert unequal_conditions(load_results(tmp_path))["A"] == {
        "hits": ["high level's updates per step: 0.5 (as the low level's)"],
        "sac": ["weight averaging: 0.0 (0.999)"],
    }


def test_rows_say_whose_settings_they_do_not_have(tmp_path: Path) -> None:
    model = load_config("tbc-hrl", "Pendulum").model
    other = {**model, "kappa": 9.0, "dt_min": 7, "reconsider_margin": 3.0, "fixed_duration": 5.0}
    for variant, settings in (("full", [model, model]), ("others", [model, {**model, "kappa": 9.0}])):
        for seed, given in enumerate(settings):
            fake_run(tmp_path, "Pendulum", "tbc-hrl", seed, 1.0, variant, config={"model": given})
    for task in ("Drawbridge", "Foreign"):
        given = {**load_config("sac", "Drawbridge").model, "tau": 0.5}
        fake_run(tmp_path, task, "sac", 0, 1.0, config={"model": given})
    fake_run(tmp_path, "UR5Reacher", "tbc-hrl", 0, 1.0, config={"model": merge(model, other)})
    notes = {(t, m): notes_of_row(runs, rows) for t, rows in load_results(tmp_path).items() for m, runs in rows.items()}
    assert notes["Pendulum", "tbc-hrl"] == notes["Foreign", "sac"] == []
    assert notes["Pendulum", "tbc-hrl others"] == ["settings differ between seeds: kappa"]
    assert notes["Drawbridge", "sac"][0] == "not the shipped settings: tau"
    assert re.fullmatch(r"not the shipped settings: \w+, \w+, \w+ and \d+ more", notes["UR5Reacher", "tbc-hrl"][0])


def test_comparisons_say_what_is_unequal_in_ablations_too(tmp_path: Path) -> None:
    for seed in range(3):
        fake_run(tmp_path, "Drawbridge", "tbc-hrl", seed, 0.9 + seed / 100)
        fake_run(tmp_path, "Drawbridge", "tbc-hrl", seed, 0.4, variant="no-ts", config={"n_timesteps": 1000})
    results = load_results(tmp_path)
    (row,) = against_ablations(results)
    assert row.unequal == ("training steps: 1,000 (4,000)",)
    assert tables.comparison_table([row])[1][-1] == "unequal training steps: 1,000 (4,000)"
    (claim,) = [c for c in claims(results) if "timed subgoals" in c.text]
    assert claim.evidence.endswith("unequal training steps: 1,000 (4,000)")


def test_departures_from_the_paper_come_with_their_measurement(tmp_path: Path) -> None:
    for seed in range(3):
        fake_run(tmp_path, "Pendulum", "tbc-hrl", seed, 0.9)
        fake_run(tmp_path, "Pendulum", "tbc-hrl", seed, 0.6, variant="with-memory", config={"n_timesteps": 1000})
        fake_run(tmp_path, "UR5Reacher", "tbc-hrl", seed, 0.9)
    fake_run(tmp_path, "Pendulum", "tbc-hrl", 3, 0.0)  # a seed that the other row does not have
    (tmp_path / "measurements.yml").write_text("default: {tbc-hrl with-memory: [memory]}")
    header, *rows = departures_table(tmp_path, load_results(tmp_path))
    cells = {(row[0], row[3]): dict(zip(header, row, strict=True)) for row in rows}
    memory = cells["memory", "all"]
    assert (memory["paper"], memory["shipped"]) == ("window", "none")
    assert memory["what it is worth"].startswith("Pendulum: +0.300 (")
    assert "), steps saved: not reached in 4,000, against tbc-hrl with-memory" in memory["what it is worth"]
    assert memory["what it is worth"].endswith("which differs in training steps: 1,000 (4,000)")
    assert cells["window_end", "all"]["what it is worth"] == "not measured"
    assert cells["max_options", "UR5Reacher"]["paper"] == "24"
    assert not [row for row in rows if row[1] == row[2]]
    assert not [row for row in rows if row[0] == "kappa"]  # the same in both


def test_measurements_name_departures_that_there_are() -> None:
    """Nothing is said to measure a setting that the shipped agent does not depart in."""
    table = yaml.safe_load((ROOT / "results" / "measurements.yml").read_text())
    everywhere = {name for task in load_results(ROOT / "results") for name in departures_of(task)}
    for task, rows in table.items():
        allowed = everywhere if task == "default" else set(departures_of(task))
        assert not [(row, name) for row, names in rows.items() for name in names if name not in allowed]


def test_rows_say_which_seeds_are_from_uncommitted_code(tmp_path: Path) -> None:
    fake_run(tmp_path, "A", "tbc-hrl", 0, 1.0)
    fake_run(tmp_path, "A", "tbc-hrl", 1, 1.0, commit="0123abcd+")
    fake_run(tmp_path, "A", "tbc-hrl", 2, 1.0, config={"n_envs": 2})
    resumed = fake_run(tmp_path, "A", "tbc-hrl", 3, 1.0).path / "versions.json"
    resumed.write_text(json.dumps({"commit": "0123abcd", "resumed": [{"commit": "4567cdef+"}]}))
    methods = load_results(tmp_path)["A"]
    notes = notes_of_row(methods["tbc-hrl"], methods)
    assert notes == [
        "environments: 1 or 2, depending on the seed",
        "seed 1, 3: code with changes that were not committed",
    ]
    resumed.write_text(json.dumps({"commit": "0123abcd", "resumed": ["4567cdef"]}))
    with pytest.raises(ConfigError, match="resumed must hold named values"):
        load_results(tmp_path)


def test_tuning_seeds_are_left_out_or_named(tmp_path: Path) -> None:
    for seed, rate in ((0, 1.0), (100, 0.6), (101, 0.8)):
        fake_run(tmp_path, "A", "tbc-hrl", seed, rate)
    fake_run(tmp_path, "A", "hits", 0, 0.5)
    (tmp_path / "tuning_seeds.yml").write_text("A: {tbc-hrl: [0], hits: [0]}")
    methods = load_results(tmp_path)["A"]
    assert [run.seed for run in methods["tbc-hrl"]] == [100, 101]
    assert row_of(tmp_path, "tbc-hrl")["success"] == "0.700"
    assert "settings were chosen on the seed that is reported" in notes_of_row(methods["hits"], methods)
    assert notes_of_row(methods["tbc-hrl"], methods) == []


@pytest.mark.parametrize("seeds", ["0", "", "['0']", "[true]", "{0: 1}"])
def test_tuning_seeds_that_are_no_seeds(seeds: str, tmp_path: Path) -> None:
    fake_run(tmp_path, "A", "sac", 0, 1.0)
    (tmp_path / "tuning_seeds.yml").write_text(f"A:\n  sac: {seeds}\n")
    with pytest.raises(ConfigError, match=r"tuning_seeds.yml: A, sac must be a list of seeds, as \[0, 10\], got "):
        load_results(tmp_path)


def test_ablations_of_the_papers_settings_are_compared_with_these(tmp_path: Path) -> None:
    for variant, rate, ratio in (("full", 1.0, 0.5), ("full-paper", 0.6, 1.0), ("no-ts", 0.7, 0.5)):
        fake_run(tmp_path, "A", "tbc-hrl", 0, rate, variant, config={"model": {"gradient_ratio": ratio}})
    fake_run(tmp_path, "A", "tbc-hrl", 0, 0.4, "no-ts-paper", config={"model": {"gradient_ratio": 1.0}})
    results = load_results(tmp_path)
    rows = {row.other: row for row in against_ablations(results)}
    assert rows["tbc-hrl no-ts"].interval.mean == pytest.approx(0.3)
    assert rows["tbc-hrl no-ts-paper"].test.difference == pytest.approx(0.2)
    assert rows["tbc-hrl no-ts-paper"].interval.mean == pytest.approx(0.2)
    assert rows["tbc-hrl no-ts-paper"].unequal == ()
    notes = {line[1]: line[-1] for line in tables.comparison_table(list(rows.values()))}
    assert notes["tbc-hrl no-ts-paper"] == "ours is tbc-hrl full-paper, fewer than three seeds"
    assert notes["tbc-hrl no-ts"] == "fewer than three seeds"
    methods = results["A"]
    assert notes_of_row(methods["tbc-hrl no-ts-paper"], methods) == []
    assert notes_of_row(methods["tbc-hrl full-paper"], methods) == ["updates per step: 1.0 (0.5)"]


def test_ablations_of_the_papers_settings_need_these(tmp_path: Path) -> None:
    fake_run(tmp_path, "A", "tbc-hrl", 0, 1.0)
    fake_run(tmp_path, "A", "tbc-hrl", 0, 0.4, "no-ts-paper")
    assert against_ablations(load_results(tmp_path)) == []


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
    assert planned["eval_freq"] == default_eval_freq(200_000) == eval_freq_of(200_000)
    assert default_eval_freq(30) == eval_freq_of(30)
    assert train.N_EVAL_EPISODES == N_EVAL_EPISODES


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


def test_no_extreme_is_lost_between_seeds_of_other_steps() -> None:
    curves = [Curve([10, 20, 30], [0.0, 1.0, 0.0]), Curve([10, 25, 40], [0.5, 0.0, 1.0])]
    steps, values = on_union_of_steps(curves)
    assert steps.tolist() == [10, 20, 25, 30]
    assert values[0].tolist() == [0.0, 1.0, 0.5, 0.0]
    assert values[1].min() == 0.0
    with pytest.raises(ValueError, match="curves with points"):
        on_union_of_steps([Curve([], [])])


@pytest.mark.parametrize("rate", ["NaN", "Infinity", '"0.9"', "true", "7", "-3", "null"])
def test_success_rates_that_are_none(rate: str, tmp_path: Path) -> None:
    folder = fake_run(tmp_path, "A", "tbc-hrl", 0, 0.5)
    final = folder.path / "final.json"
    final.write_text(final.read_text().replace('"success_rate": 0.5', f'"success_rate": {rate}'))
    with pytest.raises(ConfigError, match="seed_0"):
        load_results(tmp_path)


def test_the_shipped_figures_are_the_papers() -> None:
    tables_of_paper = yaml.safe_load((ROOT / "tests" / "data" / "paper_tables.yaml").read_text())
    paper = load_paper()
    for task, row in tables_of_paper["table_2_success_percent"].items():
        for algo in ("sac", "hac", "hits", "tbc_hrl"):
            found = paper.success(task, algo.replace("_", "-"))
            assert found is not None
            assert found == pytest.approx([x / 100 for x in row[algo]])
    for task, row in tables_of_paper["table_3_ablation_percent"].items():
        for name, variant in (("no_ndbcnet", "no-ndbc"), ("no_ts", "no-ts")):
            assert paper.success(task, f"tbc-hrl {variant}") == pytest.approx([x / 100 for x in row[name]])
    steps = {t: row["training_steps"] for t, row in tables_of_paper["table_1_environments"].items()}
    assert paper.steps == steps
    assert paper.success("Pendulum", "tbc-hrl searched") is None


def test_every_committed_row_has_a_description() -> None:
    results, descriptions = load_results(ROOT / "results"), load_descriptions(ROOT / "results")
    missing = [(t, m) for t, methods in results.items() for m in methods if not describe(descriptions, t, m)]
    assert missing == []
    assert describe(descriptions, "Nowhere", "tbc-hrl no-ts").startswith("ablation")
    assert describe(descriptions, "Nowhere", "tbc-hrl unheard-of") == ""


def test_episodes_pair_by_the_seed_they_were_evaluated_on(tmp_path: Path) -> None:
    """Outcomes that are opposite half by half: blocks of pairs differ more than two rows that are taken apart."""
    fake_run(tmp_path, "A", "tbc-hrl", 100, 0.5, outcomes="1" * 50 + "0" * 50)
    fake_run(tmp_path, "A", "hits", 100, 0.5, outcomes="0" * 50 + "1" * 50)
    fake_run(tmp_path, "A", "hac", 100, 0.5, outcomes="0" * 50 + "1" * 50, eval_seed=7)
    methods = load_results(tmp_path)["A"]
    paired, apart = (difference_of(methods["tbc-hrl"], methods[other]) for other in ("hits", "hac"))
    assert paired.mean == apart.mean == 0.0
    assert paired.low < apart.low - 0.1
    assert paired.high > apart.high + 0.1
