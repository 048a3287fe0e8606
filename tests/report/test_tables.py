"""Tables from made-up runs: what is compared with what, and figures that a plausible mistake would change."""

from __future__ import annotations

import re
import shutil
from pathlib import Path

import numpy as np
import pytest
import yaml
from made_up_runs import fake_run
from sb3_tbc.tasks import make_task

from sb3_tbc import stats
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
    mean_curve,
    strongest_baselines,
)
from sb3_tbc.report.conditions import notes_of_row
from sb3_tbc.report.page import to_html
from sb3_tbc.report.paper import load_paper
from sb3_tbc.report.runs import (
    BEGIN_ALIKE,
    Curve,
    describe,
    failed_runs,
    load_descriptions,
    load_results,
    on_union_of_steps,
)
from sb3_tbc.report.sections import load_report

ROOT = Path(__file__).parents[2]


def row_of(root: Path, method: str) -> dict[str, str]:
    header, *rows = tables.success_table(load_results(root))
    (found,) = [row for row in rows if row[1] == method]
    return dict(zip(header, found, strict=True))


def test_final_success_is_the_last_evaluation_not_the_best(tmp_path: Path) -> None:
    fake_run(tmp_path, "A", "tbc-hrl", 0, 0.4, curve=[0.2, 1.0, 0.5, 0.4])
    assert row_of(tmp_path, "tbc-hrl")["success"] == "0.400"


def test_a_copy_of_a_run_is_not_counted_again(tmp_path: Path) -> None:
    run = fake_run(tmp_path, "A", "tbc-hrl", 0, 0.4).path
    shutil.copytree(run, run.with_name("seed_0 (copy)"))
    shutil.copytree(run, run.with_name("seed_old"))
    (run.with_name("seed_0 (copy)") / "final.json").rename(run.with_name("seed_0 (copy)") / "failed.json")
    assert row_of(tmp_path, "tbc-hrl")["seeds"] == "1"
    assert failed_runs(tmp_path) == []


@pytest.mark.parametrize(
    ("place", "told"),
    [
        ("B/tbc-hrl/full/seed_0", "task 'A', but its folder of 'B'"),
        ("A/hits/full/seed_0", "algo 'tbc-hrl', but its folder of 'hits'"),
        ("A/tbc-hrl/full-old/seed_0", "variant 'full', but its folder of 'full-old'"),
        ("A/tbc-hrl/full/seed_1", "seed '0', but its folder of '1'"),
        ("A/tbc-hrl/full/seed_00", "seed '0', but its folder of '00'"),
    ],
)
def test_a_run_in_the_place_of_another_is_refused(place: str, told: str, tmp_path: Path) -> None:
    run = fake_run(tmp_path, "A", "tbc-hrl", 0, 0.4).path
    shutil.copytree(run, tmp_path / place)
    with pytest.raises(ConfigError, match=re.escape(f"{place}: its final.json is of {told}; rename the folder, or")):
        load_results(tmp_path)


def test_an_environment_s_id_names_its_folder(tmp_path: Path) -> None:
    fake_run(tmp_path, "my_module:ns/Env-v0", "tbc-hrl", 0, 0.4)
    assert list(load_results(tmp_path)) == ["my_module:ns/Env-v0"]


def test_worst_is_the_lowest_of_all_seeds_not_their_mean(tmp_path: Path) -> None:
    for seed, lowest in enumerate((0.9, 0.2, 0.7)):
        fake_run(tmp_path, "A", "tbc-hrl", seed, 1.0, curve=[0.0, 1.0, lowest, 1.0])
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


@pytest.mark.parametrize(
    ("ours", "theirs", "said", "verdict"),
    [
        ([0, 0, 0, 1], [0, 0], "trained for 2,000 only, ours needs 4,000", "not decided: too few steps"),
        ([0, 1, 1, 1], [0, 0], "not reached in 2,000", "sooner, not tested"),
        ([0, 0, 0, 1], [0, 1], "-2,000", "not sooner, not tested"),
        ([0, 0], [0, 0, 1, 1], "ours was trained for 2,000 only, the other needs 3,000", "not decided: too few steps"),
        ([0, 0, 0], [0, 0, 1, 1], "ours does not reach it", "not sooner, not tested"),
    ],
)
def test_a_curve_that_ends_early_proves_no_delay(
    ours: list[float], theirs: list[float], said: str, verdict: str, tmp_path: Path
) -> None:
    fake_run(tmp_path, "A", "tbc-hrl", 0, 1.0, curve=ours)
    fake_run(tmp_path, "A", "hits", 0, 1.0, curve=theirs)
    (row,) = against_baselines(load_results(tmp_path))
    assert str(row.gain) == said
    (claim,) = [claim for claim in claims(load_results(tmp_path)) if "common threshold" in claim.text]
    assert claim.verdict == verdict
    assert f"{said}, against hits" in claim.evidence


def test_a_threshold_is_not_reached_in_the_steps_of_the_shortest_seed(tmp_path: Path) -> None:
    """The mean curve ends there; longer seeds tell nothing of the mean beyond."""
    fake_run(tmp_path, "A", "tbc-hrl", 0, 1.0, curve=[1.0, 1.0, 1.0, 1.0])
    fake_run(tmp_path, "A", "hits", 0, 0.0, curve=[0.0, 0.0])
    fake_run(tmp_path, "A", "hits", 1, 0.0, curve=[0.0, 0.0, 0.0, 0.0])
    (row,) = against_baselines(load_results(tmp_path))
    assert str(row.gain) == "not reached in 2,000"


HEAD = "timesteps,success_rate,episodes,mean_length,subgoal_success,mean_window,wall_time\n"


@pytest.mark.parametrize(("uneven", "other"), [("tbc-hrl", "hits"), ("hits", "tbc-hrl")])
def test_seeds_without_a_common_step_have_no_mean_curve(uneven: str, other: str, tmp_path: Path) -> None:
    for seed, steps in enumerate((1000, 5000)):  # one ends before the other is evaluated for the first time
        folder = fake_run(tmp_path, "A", uneven, seed, 1.0, curve=[1.0] * 5, config={"eval_freq": steps})
        folder.evaluations.write_text(f"{HEAD}{steps},1,10,10,0.5,4,1\n")
    fake_run(tmp_path, "A", other, 0, 1.0)
    results = load_results(tmp_path)
    (row,) = against_baselines(results)
    assert row.gain is None
    assert mean_curve(results["A"][uneven]) is None
    assert to_html(load_report(tmp_path), tmp_path / "report.html").count('<svg class="curves"') == 1


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
        fake_run(tmp_path, "A", "tbc-hrl", seed, 1.0 if learns else 0.3)
        for other in ("hits", "hac"):
            fake_run(tmp_path, "A", other, seed, 0.95, curve=[1.0] * (425 + seed) + [0.0] * (75 - seed))
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


def test_rows_of_former_settings_are_compared_with_ours_of_then(tmp_path: Path) -> None:
    cuts = {"model": {"n_hindsight_cuts": 5}}
    for seed in range(3):
        fake_run(tmp_path, "A", "tbc-hrl", seed, 1.0, config=cuts)
        fake_run(tmp_path, "A", "tbc-hrl", seed, 0.8, "no-hindsight-cuts")
        fake_run(tmp_path, "A", "tbc-hrl", seed, 0.7, "with-rule")
        fake_run(tmp_path, "A", "tbc-hrl", seed, 0.6, "no-cuts-no-ts")
        fake_run(tmp_path, "A", "tbc-hrl", seed, 0.9, "no-ndbc", config=cuts)
    before = {row.other: row for row in against_ablations(load_results(tmp_path))}
    assert before["tbc-hrl with-rule"].interval.mean == pytest.approx(0.3)
    assert before["tbc-hrl with-rule"].unequal == ("hindsight cuts: 0 (5)",)
    assert "tbc-hrl no-cuts-no-ts" not in before
    rows = "tbc-hrl no-hindsight-cuts: [tbc-hrl with-rule, tbc-hrl no-cuts-no-ts, tbc-hrl no-ndbc]"
    (tmp_path / "references.yml").write_text(f"A: {{{rows}}}\n")
    results = load_results(tmp_path)
    after = {row.other: row for row in against_ablations(results)}
    assert after["tbc-hrl with-rule"].interval.mean == pytest.approx(0.1)
    assert after["tbc-hrl with-rule"].unequal == ()
    assert after["tbc-hrl no-cuts-no-ts"].test.difference == pytest.approx(0.2)
    assert after["tbc-hrl no-hindsight-cuts"].interval.mean == pytest.approx(0.2)  # with the shipped agent, as before
    assert after["tbc-hrl no-hindsight-cuts"].unequal == ()  # in what it leaves out it is to differ
    assert after["tbc-hrl no-ndbc"].unequal == ("hindsight cuts: 5 (0)",)
    note = tables.comparison_table([after["tbc-hrl with-rule"]])[1][-1]
    assert note.startswith("ours is tbc-hrl no-hindsight-cuts")
    assert notes_of_row(results["A"]["tbc-hrl with-rule"], results["A"]) == []


@pytest.mark.parametrize(
    ("table", "told"),
    [
        ("A: {tbc-hrl: sac}", r"A, tbc-hrl must be a list of rows, as \[tbc-hrl no-ts\], got 'sac'"),
        ("A: {tbc-hrl: }", "A, tbc-hrl must be a list of rows, as .*, got None"),
        ("A: {tbc-hrl: [tbc-hrl no-ts]}", "A has no row tbc-hrl no-ts; it has sac, tbc-hrl"),
        ("A: {tbc-hrl other: [sac, 5]}", "A has no row tbc-hrl other, 5; it has sac, tbc-hrl"),
        ("B: {tbc-hrl: [sac]}", "B has no row tbc-hrl, sac; it has "),
    ],
)
def test_references_that_there_are_not(table: str, told: str, tmp_path: Path) -> None:
    for algo in ("tbc-hrl", "sac"):
        fake_run(tmp_path, "A", algo, 0, 1.0)
    (tmp_path / "references.yml").write_text(table)
    with pytest.raises(ConfigError, match=f"references.yml: {told}"):
        load_results(tmp_path)


def test_ablations_of_the_papers_settings_need_these(tmp_path: Path) -> None:
    fake_run(tmp_path, "A", "tbc-hrl", 0, 1.0)
    fake_run(tmp_path, "A", "tbc-hrl", 0, 0.4, "no-ts-paper")
    assert against_ablations(load_results(tmp_path)) == []


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


@pytest.mark.parametrize("eval_seed", [None, 7])
def test_episodes_of_which_no_seed_says_that_they_are_the_same_are_taken_apart(
    eval_seed: int | None, tmp_path: Path
) -> None:
    """Every run of ours was paired with the last one of the other side: the interval hung on the order of seeds."""
    first, second = "1" * 50 + "0" * 50, "0" * 50 + "1" * 50
    for seed, theirs in enumerate((first, second)):
        fake_run(tmp_path, "A", "tbc-hrl", seed, 0.5, outcomes=first, eval_seed=eval_seed)
        fake_run(tmp_path, "A", "hits", seed, 0.5, outcomes=theirs, eval_seed=eval_seed)
    ours, others = (load_results(tmp_path)["A"][method] for method in ("tbc-hrl", "hits"))
    assert difference_of(ours, others) == stats.difference(interval_of(ours), interval_of(others))


def test_seeds_that_were_never_evaluated_in_training_do_not_count_as_never_there(tmp_path: Path) -> None:
    for seed, curve in enumerate(([], [0.5, 0.95], [])):
        fake_run(tmp_path, "A", "tbc-hrl", seed, 1.0, curve=curve)
    runs = load_results(tmp_path)["A"]["tbc-hrl"]
    assert [tables.steps_to_90(chosen) for chosen in (runs, runs[:1])] == ["2 k", "-"]
