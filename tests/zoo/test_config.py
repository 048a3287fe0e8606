"""Configurations: merging, checking, and every value against the paper's tables."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest
import yaml

from sb3_tbc import TBCHRL
from sb3_tbc.errors import ConfigError
from sb3_tbc.report.conditions import condition_values, differences
from sb3_tbc.report.runs import Run
from sb3_tbc.settings import merge
from sb3_tbc.zoo.algorithms import build_model
from sb3_tbc.zoo.config import RunConfig, config_file, load_config, parse_overrides, read_file
from sb3_tbc.zoo.environments import make_envs, task_names

TABLES = yaml.safe_load((Path(__file__).parents[1] / "data" / "paper_tables.yaml").read_text())
TASKS = sorted(TABLES["table_1_environments"])
WINDOW_CAPS = {  # episode length / action budget, as in the public HiTS files
    "AntFourRooms": 31.8182,
    "Drawbridge": 200.0,
    "Pendulum": 45.4545,
    "Platforms": 50.0,
    "Tennis2D": 62.5,
    "UR5Reacher": 25.0,
}
COLUMN = {"tbc-hrl": "TBC-HRL", "hits": "HiTS", "hac": "HAC"}
PEERS = yaml.safe_load((Path(__file__).parents[1] / "data" / "peer_hyperparameters.yaml").read_text())


def entropy(value: Any) -> Any:
    """Table A2's ``target`` is automatic temperature."""
    return "auto" if isinstance(value, str) and value.startswith(("auto", "target")) else value


@pytest.mark.parametrize("task", TASKS)
@pytest.mark.parametrize("algo", sorted(COLUMN))
def test_paper_configuration_is_table_a2(algo: str, task: str) -> None:
    row = TABLES["table_a2_hyperparameters"][COLUMN[algo]][task]
    run = load_config(algo, task, "paper")
    assert run.n_timesteps == TABLES["table_1_environments"][task]["training_steps"]
    assert run.model["max_options"] == row["max_actions"]
    if algo == "hac":
        assert run.model["dt_max"] == (27 if task == "AntFourRooms" else -1)
    else:
        assert run.model["dt_max"] == row["dt_max"]
    assert run.model.get("kappa") == row.get("kappa")
    assert run.model["n_hindsight_goals"] == row["hindsight"]
    for level, alpha in zip(("low", "high"), row["alpha"], strict=True):
        settings = run.model[level]
        assert settings["learning_rate"] == float(row["lr"])
        assert settings["batch_size"] == row["batch"]
        assert settings["tau"] == float(row["polyak"])
        assert entropy(settings["ent_coef"]) == entropy(alpha)
        assert "n_hindsight_goals" not in settings


@pytest.mark.parametrize("task", TASKS)
def test_flat_paper_configuration_is_table_a2(task: str) -> None:
    row = TABLES["table_a2_hyperparameters"]["SAC"][task]
    run = load_config("sac", task, "paper")
    assert run.n_timesteps == TABLES["table_1_environments"][task]["training_steps"]
    model = run.model
    assert (model["learning_rate"], model["batch_size"], model["tau"]) == (row["lr"], row["batch"], row["polyak"])
    assert model["n_hindsight_goals"] == row["hindsight"]
    assert entropy(model["ent_coef"]) == entropy(row["alpha"][0])


@pytest.mark.parametrize("task", TASKS)
def test_peers_settings_where_the_paper_is_silent(task: str) -> None:
    """Discounts, widths, update ratios, hindsight places, target entropies of the public files."""
    for algo in ("hac", "sac"):
        model, levels = load_config(algo, task, "paper").model, PEERS[task][algo]
        assert model["gradient_ratio"] == levels[0]["grad_steps_per_env_step"]
        assert algo == "sac" or model["learning_starts"] == levels[0]["learning_starts"]
        for name, peer in zip(("low", "high") if algo == "hac" else ("flat",), levels, strict=True):
            ours = model if algo == "sac" else {**model[name], **model[name]["policy_kwargs"]}
            widths = ours["net_arch"] if algo == "hac" else model["policy_kwargs"]["net_arch"]
            assert widths == peer["hidden_layers"]
            assert ours["gamma"] == peer["gamma"]
            if "target_entropy" in peer:
                assert ours["target_entropy"] == peer["target_entropy"]
            strategy = ours.get("goal_strategy", model["goal_strategy"])
            assert strategy == {"Tennis2DGSS": "event"}.get(*[peer["goal_sampling_strategy"]] * 2)
        if algo == "hac":
            assert model["max_options"] == levels[1]["max_n_actions"]


@pytest.mark.parametrize("task", TASKS)
def test_wiring_is_table_a1(task: str) -> None:
    table = TABLES["table_a1_ndbcnet"][task]
    paper, tuned = (load_config("tbc-hrl", task, c).model["low"]["policy_kwargs"]["ndbc"] for c in ("paper", "tuned"))
    assert {k: paper[k] for k in table} == table
    # `tuned` may depart in the fans, and has larger circuits for the ant's eight motors and for the racket
    layers = ("motor",) if task in ("AntFourRooms", "Tennis2D") else ("inter", "command", "motor")
    assert {k: tuned[k] for k in layers} == {k: table[k] for k in layers}


@pytest.mark.parametrize("task", [*TASKS, "Other-v0"])
def test_paper_is_what_the_text_says(task: str) -> None:
    model = load_config("tbc-hrl", task, "paper").model
    said = {
        "window_end": "reached",  # algorithm 1, line 20
        "duration": "joint",  # section 4.1
        "whole_budgets": True,  # section 4.1
        "low_reward": "dense",  # section 4.1: "updated at every step"
        "target": "smdp",
        "memory": "window",
        "keep_original": True,  # algorithm 1, lines 26 and 30
        "relabel_tolerance": 0.05,  # section 4.2
        "completion_bonus": 1.0,  # sections 4.2 and 4.5
        "duration_cost": 0.0,
    }
    assert {name: model[name] for name in said} == said
    assert model["duration_loss_coef"] > 0  # section 4.2; what makes kappa count
    assert model["low"]["policy_kwargs"]["ndbc"]["adaptive_step"] is True  # equation 17
    assert model["low"]["average_decay"] == model["high"]["average_decay"] == 0


def test_kappa_has_an_effect_in_the_paper_configuration() -> None:
    """What the duration loss draws time budgets toward is in proportion to kappa (equation 1)."""
    budgets = []
    for kappa in (0.6, 1.2):
        run = load_config("tbc-hrl", "Pendulum", "paper", parse_overrides(["compile:false", f"kappa:{kappa}"]))
        env = make_envs(task_names()["Pendulum"], 1, 0, run.env_kwargs)
        try:
            model, seen = build_model(run, env, seed=0), env.reset()
        finally:
            env.close()
        assert isinstance(model, TBCHRL)
        assert model.high.label_coef == run.model["duration_loss_coef"] > 0
        teacher, subgoals = model.replay_buffer.high.teacher, model.layout.subgoals
        assert teacher is not None
        local, here = subgoals.local(seen).astype(np.float32), subgoals.achieved(seen).astype(np.float32)
        budgets.append(model.rules.budget(teacher(model.layout.high(seen), local, here)))
    np.testing.assert_allclose(budgets[1], 2 * budgets[0], rtol=1e-5)


def test_paper_reading_of_the_window_end() -> None:
    assert load_config("tbc-hrl", "Pendulum", "paper").model["window_end"] == "reached"
    assert load_config("hits", "Pendulum", "paper").model["window_end"] == "timed"
    assert load_config("hits", "Pendulum").model["low"]["policy_kwargs"]["ndbc"] is None


def test_tuned_is_the_default_where_it_exists(tmp_path: Path) -> None:
    assert load_config("tbc-hrl", "Pendulum").config == "tuned"
    untuned = tmp_path / "hits.yml"
    untuned.write_text("default: {n_timesteps: 10}")
    assert load_config("hits", "UR5Reacher", path=untuned).config == "paper"
    assert load_config("tbc-hrl", "Pendulum") == load_config("tbc-hrl", "Pendulum", "tuned")


def test_deep_merge_keeps_sisters() -> None:
    base = {"low": {"gamma": 0.99, "policy_kwargs": {"net_arch": [3], "ndbc": {"inter": 2}}}, "n": 1}
    change = {"low": {"tau": 0.1, "policy_kwargs": {"ndbc": None}}}
    expected = {"low": {"gamma": 0.99, "tau": 0.1, "policy_kwargs": {"net_arch": [3], "ndbc": None}}, "n": 1}
    assert merge(base, change) == expected
    assert base["low"]["policy_kwargs"] == {"net_arch": [3], "ndbc": {"inter": 2}}


def test_order_default_task_tuned_command_line(tmp_path: Path) -> None:
    path = tmp_path / "a.yml"
    path.write_text(
        "default: {n_timesteps: 10, dt_min: 1, low: {gamma: 0.9, tau: 0.1}, tuned: {dt_min: 2}}\n"
        "T: {low: {gamma: 0.8}, tuned: {low: {gamma: 0.7}}}\n"
    )
    paper = load_config("x", "T", "paper", path=path)
    assert paper.model == {"dt_min": 1, "low": {"gamma": 0.8, "tau": 0.1}}
    tuned = load_config("x", "T", path=path, overrides=parse_overrides(["low.tau:5e-1", "n_timesteps:2e1"]))
    assert tuned.model == {"dt_min": 2, "low": {"gamma": 0.7, "tau": 0.5}}
    assert tuned.n_timesteps == 20
    assert isinstance(tuned.n_timesteps, int)
    assert load_config("x", "AnotherEnv-v0", "paper", path=path).model["dt_min"] == 1


@pytest.mark.parametrize(
    ("given", "message"),
    [
        ("env_kwargs.limit:.inf", r"env_kwargs\.limit must be a finite number, text, .*, got inf"),
        ("env_kwargs.walls:[1, {x: .nan}]", r"env_kwargs\.walls\[1\]\.x must be a finite number, text, .*, got nan"),
        ("env_kwargs.day:2026-01-02", r"env_kwargs\.day must be .*, got datetime.date\(2026, 1, 2\); a date needs quo"),
        ("env_kwargs.set:{1: a}", r"env_kwargs\.set must have texts as keys, got 1; put quotes around it"),
    ],
)
def test_arguments_that_a_result_cannot_hold_are_refused_at_once(tmp_path: Path, given: str, message: str) -> None:
    with pytest.raises(ConfigError, match=f"--hyperparams: {message}"):
        parse_overrides([given])
    path, (name, _, value) = tmp_path / "a.yml", given.partition(":")
    path.write_text(f"T: {{n_timesteps: 10, env_kwargs: {{{name.partition('.')[2]}: {value}}}}}\n")
    with pytest.raises(ConfigError, match=rf"a\.yml, section T: {message}"):
        load_config("x", "T", path=path)


def test_quoted_text_stays_text(tmp_path: Path) -> None:
    assert parse_overrides(['env_kwargs.map:"007"']) == {"env_kwargs": {"map": "007"}}
    assert parse_overrides(["env_kwargs.map:'3e-4'"]) == {"env_kwargs": {"map": "3e-4"}}
    names = parse_overrides(['subgoals.names:["1","2"]'])["subgoals"]["names"]
    assert list(names) == ["1", "2"]
    path = tmp_path / "a.yml"
    path.write_text("T: {n_timesteps: 10, env_kwargs: {map: '1e5', rate: 1e5, note: 1e5 or so}}\n")
    assert load_config("x", "T", path=path).env_kwargs == {"map": "1e5", "rate": 1e5, "note": "1e5 or so"}
    with pytest.raises(ConfigError, match=r"low\.learning_rate must be .*, got '3e-4'"):
        parse_overrides(['low.learning_rate:"3e-4"'])


def test_null_stands_for_the_default_of_a_run_key(tmp_path: Path) -> None:
    shipped = load_config("tbc-hrl", "Pendulum")
    assert load_config("tbc-hrl", "Pendulum", overrides=parse_overrides(["n_envs:null"])) == shipped
    run = load_config("tbc-hrl", "UR5Reacher", overrides=parse_overrides(["env_kwargs:null"]))
    assert load_config("tbc-hrl", "UR5Reacher").env_kwargs == {"observation": "compact"}
    assert run.env_kwargs == {}
    with pytest.raises(ConfigError, match=r"n_timesteps must be a number of environment steps, got null in --hyper"):
        load_config("tbc-hrl", "Pendulum", overrides=parse_overrides(["n_timesteps:null"]))
    path = tmp_path / "a.yml"
    path.write_text("default: {n_timesteps: 10}\nT: {n_envs: null, env_kwargs: null}\nU: {n_timesteps: null}\n")
    assert load_config("tbc-hrl", "T", path=path) == RunConfig("tbc-hrl", "T", "paper", 10)
    with pytest.raises(ConfigError, match=r"got null in --hyperparams or in .*a\.yml; leave it out there"):
        load_config("tbc-hrl", "U", path=path)


def test_number_like_strings_become_numbers(tmp_path: Path) -> None:
    path = tmp_path / "a.yml"
    path.write_text("T: {n_timesteps: 1e3, low: {learning_rate: 3e-4, ent_coef: auto_0.1, batch_size: 1e2}}\n")
    low = load_config("x", "T", path=path).model["low"]
    assert low == {"learning_rate": 3e-4, "ent_coef": "auto_0.1", "batch_size": 100}


@pytest.mark.parametrize(
    ("text", "message"),
    [
        (
            "T: {low: {lerning_rate: 1}}",
            r"a\.yml, section T: unknown setting 'low\.lerning_rate'; did you mean 'learning_rate'",
        ),
        ("T: {max_option: 1}", r"a\.yml, section T: unknown setting 'max_option'; did you mean 'max_options'"),
        ("T: {tuned: {dt_mim: 1}}", r"tuned: unknown setting 'dt_mim'; did you mean 'dt_min'"),
        ("T: {window_end: soon}", r"window_end must be one of 'timed', 'reached', 'reconsider', got 'soon'"),
        ("T: {low: {batch_size: 1.5}}", r"low.batch_size must be a whole number from 1 to 1,000,000, got 1\.5"),
        ("T: {low: {gamma: true}}", r"low.gamma must be a number from 0 to 1, got True"),
        ("T: {low: 3}", r"low must be a section"),
        ("T: 3", r"expected sections"),
        ("T: {a: [}", r"cannot read .*a\.yml: it is no YAML"),
        ("T: {subgoals: {thresholds: 0.1}}", r"neither section T nor section default of .*a\.yml gives n_timesteps"),
        ("T: {n_timesteps: 0}", r"n_timesteps must be a whole number from 1 to"),
    ],
)
def test_mistakes_name_file_section_and_cure(tmp_path: Path, text: str, message: str) -> None:
    path = tmp_path / "a.yml"
    path.write_text(text)
    with pytest.raises(ConfigError, match=message):
        load_config("x", "T", path=path)


def test_command_line_values_are_data_not_code() -> None:
    assert parse_overrides(["low.policy_kwargs.net_arch:[64, 64]", "compile:false"]) == {
        "low": {"policy_kwargs": {"net_arch": [64, 64]}},
        "compile": False,
    }
    for item in ("low.gamma:__import__('os').getcwd()", "low.gamma:!!python/object/apply:os.getcwd []"):
        with pytest.raises(ConfigError):
            parse_overrides([item])
    with pytest.raises(ConfigError, match="takes key:value"):
        parse_overrides(["gamma"])
    with pytest.raises(ConfigError, match="did you mean 'learning_rate'"):
        parse_overrides(["low.learningrate:1"])


def test_unknown_names() -> None:
    with pytest.raises(ConfigError, match="did you mean 'tbc-hrl'"):
        config_file("tbc_hrl")
    with pytest.raises(ConfigError, match="paper, tuned"):
        load_config("tbc-hrl", "Pendulum", "best")


def test_a_run_configuration_survives_yaml() -> None:
    run = load_config("tbc-hrl", "UR5Reacher")
    assert RunConfig.from_dict(yaml.safe_load(yaml.safe_dump(run.to_dict()))) == run
    with pytest.raises(ConfigError, match=r"not a run's config\.yml"):
        RunConfig.from_dict({"algo": "x"})


@pytest.mark.parametrize("algo", [*sorted(COLUMN), "sac"])
def test_every_shipped_section_is_a_task(algo: str) -> None:
    others = set() if algo == "sac" else {"other"}
    assert set(read_file(config_file(algo))) == {"default", *others, *TASKS}


@pytest.mark.parametrize("algo", ["tbc-hrl", "hits", "hac"])
def test_other_environments_have_a_section_of_their_own(algo: str) -> None:
    assert load_config(algo, "FetchReach-v4").model["max_options"] == "auto"
    assert all(isinstance(load_config(algo, task).model["max_options"], int) for task in TASKS)


def test_an_ablation_may_have_settings_of_its_own(tmp_path: Path) -> None:
    path = tmp_path / "x.yml"
    path.write_text(
        "default: {n_timesteps: 10}\n"
        "T: {low: {tau: 0.1}, tuned: {low: {learning_rate: 0.2}, no-ndbc: {low: {learning_rate: 0.3, tau: 0.5}}}}\n"
    )

    def low(config: str, ablation: str | None = None, *given: str) -> dict[str, Any]:
        low: dict[str, Any] = load_config("tbc-hrl", "T", config, parse_overrides(given), ablation, path).model["low"]
        return {name: low.get(name) for name in ("learning_rate", "tau")}

    assert low("tuned") == low("tuned", "no-rule") == {"learning_rate": 0.2, "tau": 0.1}
    assert low("tuned", "no-ndbc") == {"learning_rate": 0.3, "tau": 0.5}
    assert low("tuned", "no-ndbc", "low.tau:0.9") == {"learning_rate": 0.3, "tau": 0.9}
    assert low("paper", "no-ndbc") == {"learning_rate": None, "tau": 0.1}
    path.write_text("T: {n_timesteps: 10, tuned: {no-ndbc: {low: {learning_rat: 0.3}}}}\n")
    with pytest.raises(ConfigError, match=r"section T, tuned, no-ndbc: unknown setting 'low\.learning_rat'"):
        load_config("tbc-hrl", "T", path=path)


def test_what_is_tuned_for_other_environments_stays_with_them() -> None:
    tuned, paper = (load_config("tbc-hrl", "FetchReach-v4", config).model for config in ("tuned", "paper"))
    assert tuned["relative_subgoals"]
    assert "relative_subgoals" not in paper
    assert "relative_subgoals" not in load_config("tbc-hrl", "Pendulum").model


@pytest.mark.parametrize("config", ["paper", "tuned"])
@pytest.mark.parametrize("algo", sorted(COLUMN))
@pytest.mark.parametrize("task", TASKS)
def test_every_shipped_section_builds(task: str, algo: str, config: str) -> None:
    small = parse_overrides(["low.buffer_size:1000", "high.buffer_size:1000", "compile:false"])
    run = load_config(algo, task, config, small)
    env = make_envs(task_names()[task], 1, 0, run.env_kwargs)
    try:
        model = build_model(run, env, seed=0)
    finally:
        env.close()
    circuit = run.model["low"]["policy_kwargs"].get("ndbc")
    state_dim = model.low.policy.actor.state_dim
    assert state_dim == (0 if circuit is None else circuit["inter"] + circuit["command"] + circuit["motor"])
    assert model.rules.window_end == run.model["window_end"]
    cap = (
        {"AntFourRooms": 27.0, "Pendulum": 37.037}.get(task, WINDOW_CAPS[task]) if algo == "hac" else WINDOW_CAPS[task]
    )
    budgets = (
        load_config(algo, task, "paper").model["max_options"],
        run.model["max_options"],
    )  # `tuned` may have its own
    own = run.model["dt_max"]
    assert model.rules.dt_max == pytest.approx(cap * budgets[0] / budgets[1] if own == -1 else own, abs=2e-3)


@pytest.mark.parametrize("task", TASKS)
def test_every_flat_section_builds(task: str) -> None:
    run = load_config("sac", task, None, parse_overrides(["buffer_size:1000"]))
    env = make_envs(task_names()[task], 1, 0, run.env_kwargs)
    try:
        model = build_model(run, env, seed=0)
    finally:
        env.close()
    assert model.gradient_ratio == run.model["gradient_ratio"]


@pytest.mark.parametrize("task", sorted(set(read_file(config_file("tbc-hrl"))) - {"default", "other"}))
@pytest.mark.parametrize("algo", ["hits", "hac", "sac"])
def test_shipped_baselines_run_under_our_conditions(algo: str, task: str) -> None:
    """What the report compares conditions by finds nothing: observation, views, environments, updates, averages."""
    ours, theirs = (
        Run({"algo": name, "config": run.config, "n_timesteps": run.n_timesteps}, [], run.to_dict())
        for name, run in ((name, load_config(name, task)) for name in ("tbc-hrl", algo))
    )
    assert differences([theirs], [ours]) == []
    values = condition_values([theirs])
    assert values["settings"] == ["tuned"]
    assert values["weight averaging"][0] not in ("default", "0.0 and 0.0")
    assert values["updates per step"] == [load_config("tbc-hrl", task).model.get("gradient_ratio", 1.0)]
