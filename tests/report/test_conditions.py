"""Conditions in which rows differ, and what a row's notes say."""

from __future__ import annotations

import json
import re
from pathlib import Path

import pytest
from made_up_runs import fake_run

from sb3_tbc.errors import ConfigError
from sb3_tbc.report import tables
from sb3_tbc.report.conditions import notes_of_row, unequal_conditions
from sb3_tbc.report.runs import load_results
from sb3_tbc.settings import merge
from sb3_tbc.zoo.config import load_config


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


def test_tuning_effort_is_a_condition(tmp_path: Path) -> None:
    for method in ("tbc-hrl", "hits", "sac"):
        fake_run(tmp_path, "A", method, 0, 1.0, config={"model": {}})
    (tmp_path / "tuning_trials.yml").write_text("A: {tbc-hrl: 40, hits: 3}\n")
    results = load_results(tmp_path)
    assert "settings tried: 3 (40)" in unequal_conditions(results)["A"]["hits"]
    assert not any("tried" in said for said in unequal_conditions(results)["A"].get("sac", []))  # was not counted
    assert "settings tried: 3 (40)" in notes_of_row(results["A"]["hits"], results["A"])


@pytest.mark.parametrize("count", ["-1", "true", "[3]", "'3'", "2.5", ""])
def test_tuning_trials_that_are_no_number(count: str, tmp_path: Path) -> None:
    fake_run(tmp_path, "A", "sac", 0, 1.0)
    (tmp_path / "tuning_trials.yml").write_text(f"A:\n  sac: {count}\n")
    with pytest.raises(
        ConfigError, match=r"tuning_trials.yml: A, sac must be the number of settings tried, 0 or more, got "
    ):
        load_results(tmp_path)


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
