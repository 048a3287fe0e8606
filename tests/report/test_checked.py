"""Runs that contradict themselves are refused before any of it is averaged."""

from __future__ import annotations

import re
from pathlib import Path

import pytest
from made_up_runs import fake_run

from sb3_tbc.errors import ConfigError
from sb3_tbc.report.runs import DESCRIPTIONS, REFERENCES, TUNING_SEEDS, TUNING_TRIALS, load_descriptions, load_results
from sb3_tbc.zoo.ledger import to_json

HEAD = "timesteps,success_rate,episodes,mean_length,subgoal_success,mean_window,wall_time\n"


@pytest.mark.parametrize(("steps", "told"), [((0, 5), "0 after 0"), ((5, 5), "5 after 5"), ((1, 9, 4), "4 after 9")])
def test_a_curve_whose_steps_do_not_rise_is_refused(steps: tuple[int, ...], told: str, tmp_path: Path) -> None:
    folder = fake_run(tmp_path, "A", "tbc-hrl", 0, 1.0)
    folder.evaluations.write_text(HEAD + "".join(f"{step},1,10,10,0.5,4,1\n" for step in steps))
    with pytest.raises(ConfigError, match=f"seed_0: evaluations.csv must have steps above 0 that rise, got {told}"):
        load_results(tmp_path)


@pytest.mark.parametrize(
    ("row", "told"),
    [
        ("4000,0.55,10,10,0.5,4,4", "evaluations.csv, step 4000: success_rate is 0.55, which is no share of 10 ep"),
        ("4000,1,0,10,0.5,4,4", "evaluations.csv must have episodes above 0, got 0 at step 4000"),
        ("4001,1,10,10,0.5,4,4", "evaluations.csv ends at step 4001, but final.json is of 4000 steps"),
        ("4000,1,10,10,0.5", "it has not as many values as there are columns"),
        ("4000,1,10,10,0.5,4,4,4", "it has not as many values as there are columns"),
        ("3000.5,1,10,10,0.5,4,4", "timesteps must be a whole number, got 3000.5"),
        ("4000,1,10,nan,0.5,4,4", "mean_length must be a finite number of at least 0, got nan"),
        ("4000,1,10,10,0.5,4,-1", "wall_time must be a finite number of at least 0, got -1.0"),
        ("4000,0.8,10,10,0.5,4,4", "best_success_rate is 1.0, but 0.8 by evaluations.csv"),
    ],
)
def test_a_curve_that_contradicts_itself_or_the_result_is_refused(row: str, told: str, tmp_path: Path) -> None:
    folder = fake_run(tmp_path, "A", "tbc-hrl", 0, 1.0)
    folder.evaluations.write_text(f"{HEAD}1000,0.5,10,10,nan,nan,1\n{row}\n")
    with pytest.raises(ConfigError, match=f"seed_0.*{re.escape(told)}"):
        load_results(tmp_path)


@pytest.mark.parametrize(
    ("final", "told"),
    [
        ({"outcomes": "1" * 9 + "0" * 91}, "outcomes holds 9 successes in 100 episodes, but success_rate is 0.9"),
        ({"outcomes": "1" * 9 + "0"}, "outcomes holds 9 successes in 10 episodes, but n_episodes is 100"),
        ({"n_episodes": 25}, "success_rate is 0.9, which is no share of 25 episodes"),
        ({"stable_share": 0.5}, "stable_share is 0.5, but 1.0 by evaluations.csv"),
        ({"worst_after_first_90": None}, "worst_after_first_90 is None, but 0.9 by evaluations.csv"),
    ],
)
def test_a_result_that_contradicts_itself_is_refused(final: dict[str, object], told: str, tmp_path: Path) -> None:
    folder = fake_run(tmp_path, "A", "tbc-hrl", 0, 0.9)
    (folder.path / "final.json").write_text(to_json({**folder.read_final(), **final}))
    with pytest.raises(ConfigError, match=f"seed_0: {re.escape(told)}: one of them was changed"):
        load_results(tmp_path)


def test_versions_of_later_parts_that_are_no_list(tmp_path: Path) -> None:
    (fake_run(tmp_path, "A", "tbc-hrl", 0, 0.9).path / "versions.json").write_text('{"resumed": 5}')
    with pytest.raises(ConfigError, match=r"seed_0: versions\.json: resumed must be a list, got int"):
        load_results(tmp_path)


def test_tables_of_comments_alone_are_empty(tmp_path: Path) -> None:
    fake_run(tmp_path, "A", "tbc-hrl", 0, 0.9)
    for name in (DESCRIPTIONS, REFERENCES, TUNING_SEEDS, TUNING_TRIALS):
        (tmp_path / name).write_text("# A: {tbc-hrl: ...}\n")
    assert list(load_results(tmp_path)) == ["A"]
    assert load_descriptions(tmp_path) == {}
