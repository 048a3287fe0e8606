"""Search spaces: the tables' rows lie inside, what a trial suggests becomes a configuration, mistakes are told."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from sb3_tbc.errors import ConfigError
from sb3_tbc.tune.search_space import Parameter, apply, build_space, complete, load_space, project, restrict, suggest
from sb3_tbc.zoo.config import config_file, load_config, parse_overrides, read_file

ALGOS = ("tbc-hrl", "hits", "hac", "sac")
TASKS = sorted(set(read_file(config_file("tbc-hrl"))) - {"default", "other"})
TABLE_A1 = {"inter", "command", "motor", "sensory_fanout", "inter_fanout", "recurrent_command_synapses", "motor_fanin"}


class Drawn:
    """A trial whose choices hypothesis makes."""

    def __init__(self, draw: Any) -> None:
        self.draw = draw

    def suggest_float(self, name: str, low: float, high: float, *, step: float | None, log: bool) -> float:
        return float(self.draw(st.floats(low, high)))

    def suggest_int(self, name: str, low: int, high: int, *, step: int, log: bool) -> int:
        return int(self.draw(st.integers(low, high)))

    def suggest_categorical(self, name: str, choices: Any) -> Any:
        return self.draw(st.sampled_from(choices))


def active(space: tuple[Parameter, ...], values: dict[str, Any]) -> set[str]:
    """Parameters whose condition holds."""
    return {p.name for p in space if not p.when or values.get(p.when[0]) == p.when[1]}


@pytest.mark.parametrize("config", ["paper", "tuned"])
@pytest.mark.parametrize("task", TASKS)
@pytest.mark.parametrize("algo", ALGOS)
def test_every_shipped_row_lies_in_the_space(algo: str, task: str, config: str) -> None:
    run = complete(load_config(algo, task, config), 1)
    space = build_space(restrict(load_space(algo, task), run, (), {}))
    values = project(space, run)
    assert set(values) == active(space, values)
    again = apply(space, values, run)
    assert project(space, again) == values
    for level in ("low", "high") if algo != "sac" else ("",):
        had, has = (r.model[level] if level else r.model for r in (run, again))
        for key in ("batch_size", "tau"):
            assert has[key] == had[key]
        if not str(had["ent_coef"]).startswith("auto"):
            assert has["ent_coef"] == had["ent_coef"]
    assert again.model.get("max_options") == run.model.get("max_options")


def test_the_columns_of_tables_a1_and_a2_are_searched() -> None:
    space = {p.name: p for p in build_space(load_space("tbc-hrl", "Pendulum"))}
    assert {f"ndbc.{column}" for column in TABLE_A1} | {"ndbc.sub_steps", "memory"} <= set(space)
    assert {"max_options", "n_hindsight_goals", "batch_size", "tau", "kappa"} <= set(space)
    for level in ("low", "high"):
        assert {f"{level}.{k}" for k in ("learning_rate", "temperature", "ent_coef", "target_entropy")} <= set(space)
        assert space[f"{level}.learning_rate"].log
        assert space[f"{level}.ent_coef"].log
    assert space["tau"].log
    hits = {p.name for p in build_space(load_space("hits", "Pendulum"))}
    assert "memory" not in hits
    assert not any(name.startswith("ndbc") for name in hits)


@settings(max_examples=25, deadline=None)
@given(st.data())
def test_what_a_trial_suggests_can_be_read_back(data: Any) -> None:
    run = complete(load_config("tbc-hrl", "Pendulum"), 1)
    space = build_space(restrict(load_space("tbc-hrl", "Pendulum"), run, (), {}))
    values = suggest(space, Drawn(data.draw))
    assert set(values) == active(space, values)
    assert project(space, apply(space, values, run)) == values


def test_a_value_reaches_all_its_keys() -> None:
    run = load_config("tbc-hrl", "Pendulum", "paper")
    space = build_space(load_space("tbc-hrl", "Pendulum"))
    changed = apply(space, {"tau": 0.2, "ndbc.inter": 9, "memory": "episode", "low.temperature": "auto"}, run).model
    assert changed["low"]["tau"] == changed["high"]["tau"] == 0.2
    assert changed["low"]["policy_kwargs"]["ndbc"]["inter"] == 9
    assert changed["low"]["policy_kwargs"]["ndbc"]["command"] == 6
    assert changed["memory"] == "episode"
    assert changed["low"]["ent_coef"] == "auto"
    assert run.model["low"]["tau"] == 0.0139


@pytest.mark.parametrize(
    ("label", "n_envs", "env_kwargs"),
    [
        ({"env_kwargs": None}, 3, {"subgoals": {"low": [3.0], "thresholds": 0.1}}),
        ({"n_envs": None}, 1, {"a": 1, "subgoals": {"low": [3.0], "thresholds": 0.1}}),
        ({"subgoals.thresholds": 0.2}, 3, {"a": 1, "subgoals": {"low": [3.0], "thresholds": 0.2}}),
        ({"subgoals": None, "env_kwargs.b": 2}, 3, {"a": 1, "b": 2}),
    ],
)
def test_a_label_may_hold_keys_of_the_run(label: Any, n_envs: int, env_kwargs: Any) -> None:
    given = {"env_kwargs": {"a": 1}, "n_envs": 3, "subgoals": {"thresholds": 0.1, "low": [3.0]}}
    run = load_config("tbc-hrl", "Other-v0", overrides=given)
    changed = apply(build_space({"x": {"choices": {"other": label}}}), {"x": "other"}, run)
    assert (changed.n_envs, changed.env_kwargs, changed.model) == (n_envs, env_kwargs, run.model)
    with pytest.raises(ConfigError, match="n_timesteps must be a number of environment steps, got null in the search"):
        apply(build_space({"x": {"choices": {"none": {"n_timesteps": None}}}}), {"x": "none"}, run)


def test_a_threshold_of_subgoals_can_be_searched() -> None:
    run = load_config("tbc-hrl", "Other-v0", overrides={"subgoals": {"thresholds": 0.1}})
    space = build_space({"subgoals.thresholds": {"low": 0.05, "high": 0.5}})
    assert project(space, run) == {"subgoals.thresholds": 0.1}
    assert apply(space, {"subgoals.thresholds": 0.3}, run).env_kwargs == {"subgoals": {"thresholds": 0.3}}


def test_a_schedule_is_written_as_text() -> None:
    run = load_config("tbc-hrl", "UR5Reacher", "paper")
    space = build_space(load_space("tbc-hrl", "UR5Reacher"))
    falling = apply(space, {"learning_rate_schedule": "linear", "low.learning_rate": 1e-3}, run)
    assert falling.model["low"]["learning_rate"] == "lin_0.001"
    assert falling.model["high"]["learning_rate"] == "lin_0.0005216"  # not searched here, but scheduled too
    assert project(space, falling)["learning_rate_schedule"] == "linear"
    constant = apply(space, {"learning_rate_schedule": "constant"}, falling)
    assert constant.model["high"]["learning_rate"] == 5.216e-4


def test_an_actor_without_a_rate_of_its_own_has_its_critics() -> None:
    run = load_config("tbc-hrl", "Pendulum", "paper")
    space = build_space(load_space("tbc-hrl", "Pendulum"))
    assert project(space, run)["low.actor_learning_rate"] == project(space, run)["low.learning_rate"] == 6.763e-3
    changed = apply(space, {"learning_rate_schedule": "linear", "low.actor_learning_rate": 0.25}, run)
    assert changed.model["low"]["actor_learning_rate"] == "lin_0.25"
    assert changed.model["low"]["learning_rate"] == "lin_0.006763"


@pytest.mark.parametrize("schedule", ["constant", "linear"])
@pytest.mark.parametrize("algo", ["hits", "hac"])
def test_an_unset_actor_rate_follows_the_searched_one(algo: str, schedule: str) -> None:
    run = load_config(algo, "Pendulum")
    space = build_space(restrict(load_space(algo, "Pendulum"), run, (), {}))
    low = apply(space, {"learning_rate_schedule": schedule, "low.learning_rate": 0.00125}, run).model["low"]
    assert low["learning_rate"] == (0.00125 if schedule == "constant" else "lin_0.00125")
    assert low.get("actor_learning_rate") is None
    own = load_config(algo, "Pendulum", overrides=parse_overrides(["low.actor_learning_rate:0.01"]))
    space = build_space(restrict(load_space(algo, "Pendulum"), own, (), {}))  # as if a file had set it
    low = apply(space, {"learning_rate_schedule": schedule, "low.learning_rate": 0.00125}, own).model["low"]
    assert low["actor_learning_rate"] == (0.01 if schedule == "constant" else "lin_0.01")


def test_a_rate_of_the_command_line_stays_as_it_is() -> None:
    def changed(*fixed: str, algo: str = "tbc-hrl", schedule: str = "linear") -> dict[str, Any]:
        given = parse_overrides(fixed)
        run = load_config(algo, "Pendulum", "paper", given)
        space = build_space(restrict(load_space(algo, "Pendulum"), run, (), given))
        return apply(space, {"learning_rate_schedule": schedule}, run).model

    model = changed("low.learning_rate:1e-3")
    assert model["low"]["learning_rate"] == 1e-3
    assert str(model["high"]["learning_rate"]).startswith("lin_")
    assert changed("low.learning_rate:lin_1e-3", schedule="constant")["low"]["learning_rate"] == "lin_1e-3"
    both = ("low.learning_rate:1e-3", "high.learning_rate:1e-3")
    assert changed(*both)["high"]["learning_rate"] == 1e-3
    for algo, searched in (("tbc-hrl", True), ("hits", False)):  # only tbc-hrl searches the actor's rate as well
        run, given = load_config(algo, "Pendulum", overrides=parse_overrides(both)), parse_overrides(both)
        left = restrict(load_space(algo, "Pendulum"), run, (), given)
        assert ("learning_rate_schedule" in left) == searched


def test_a_value_outside_of_a_range_is_left_out() -> None:
    run = load_config("tbc-hrl", "Drawbridge", "paper")
    space = build_space(
        {"tau": {"low": 0.01, "high": 0.1, "keys": ["low.tau", "high.tau"]}, "max_options": {"low": 2, "high": 9}}
    )
    assert project(space, run) == {"max_options": 5}


def test_a_value_between_the_steps_of_a_range_is_left_out() -> None:
    run = load_config("tbc-hrl", "Pendulum", overrides={"low": {"gamma": 0.97}})
    for step, found in ((0.02, {}), (0.01, {"low.gamma": 0.97})):
        assert project(build_space({"low.gamma": {"low": 0.9, "high": 0.99, "step": step}}), run) == found


def test_the_users_file_changes_ranges(tmp_path: Path) -> None:
    path = tmp_path / "mine.yml"
    path.write_text("default: {tau: {high: 2e-1}, memory: null}\nPendulum: {batch_size: {low: 64, high: 128}}\n")
    space = {p.name: p for p in build_space(load_space("tbc-hrl", "Pendulum", path))}
    assert (space["tau"].low, space["tau"].high, space["tau"].log) == (5e-5, 0.2, True)
    assert "memory" not in space
    assert space["batch_size"].choices == ()
    assert space["batch_size"].whole
    assert space["batch_size"].keys == ("low.batch_size", "high.batch_size")
    assert {p.name: p for p in build_space(load_space("tbc-hrl", "Tennis2D", path))}["batch_size"].choices


def test_what_the_command_line_fixes_is_not_searched() -> None:
    run, declared = load_config("tbc-hrl", "Pendulum"), load_space("tbc-hrl", "Pendulum")
    left = restrict(declared, run, (), parse_overrides(["low.tau:0.1", "memory:none", "low.ent_coef:0.3"]))
    assert left["tau"]["keys"] == ["high.tau"]
    assert not {"memory", "low.ent_coef", "low.temperature"} & set(left)
    few = restrict(declared, run, ["*learning_rate", "low.target_entropy", "low.ent_coef"], {})
    rates = {"low.learning_rate", "low.actor_learning_rate", "high.learning_rate"}
    assert set(few) == {*rates, "low.target_entropy"}  # Pendulum's low level is auto
    assert "when" not in few["low.target_entropy"]
    with pytest.raises(
        ConfigError, match=r"'low\.lerning_rate' matches no parameter; did you mean 'low\.learning_rate'"
    ):
        restrict(declared, run, ["low.lerning_rate"], {})
    with pytest.raises(ConfigError, match="nothing is left"):
        restrict(declared, run, ["memory"], {"memory": "none"})


def test_no_circuit_no_circuit_parameters() -> None:
    run = load_config("tbc-hrl", "Pendulum", overrides={"low": {"policy_kwargs": {"ndbc": None}}})
    assert not any(name.startswith("ndbc") for name in restrict(load_space("tbc-hrl", "Pendulum"), run, (), {}))


def test_kappa_is_searched_where_it_acts() -> None:
    declared = load_space("tbc-hrl", "Pendulum")
    for change, acts in (
        ({"duration": "rule"}, True),
        ({"duration_loss_coef": 0.1}, True),
        ({"duration": "joint"}, False),
    ):
        base = {"duration": "joint", "duration_loss_coef": 0.0, **change}
        run = load_config("tbc-hrl", "Pendulum", overrides=base)
        assert ("kappa" in restrict(declared, run, (), {})) == acts


def test_an_unknown_task_gets_the_agents_own_circuit() -> None:
    circuit = complete(load_config("tbc-hrl", "Other-v0"), 3).model["low"]["policy_kwargs"]["ndbc"]
    assert circuit["motor"] == 3
    assert set(circuit) >= TABLE_A1 | {"sub_steps"}
    start = project(build_space(load_space("tbc-hrl", "Other-v0")), load_config("tbc-hrl", "Other-v0"))
    assert "max_options" not in start  # it follows from the task's time limit; the search draws one
    hits = load_config("hits", "Other-v0")
    assert complete(hits, 3) == hits


def test_whole_floats_are_ends_of_whole_ranges(tmp_path: Path) -> None:
    path = tmp_path / "mine.yml"
    sizes = "low.buffer_size: {low: 1000, high: 1e5}, high.buffer_size: {low: 1e3, high: 1.0e+4}"
    path.write_text(f"default: {{{sizes}, low.gamma: {{low: 0.0, high: 1.0}}}}\n")
    run, declared = load_config("hits", "Pendulum"), load_space("hits", "Pendulum", path)
    space = {p.name: p for p in build_space(declared)}
    assert all(space[f"{level}.buffer_size"].whole for level in ("low", "high"))
    assert not space["low.gamma"].whole
    assert type(space["low.buffer_size"].high) is int
    model = apply(build_space(declared), {"low.buffer_size": space["low.buffer_size"].high}, run).model
    assert model["low"]["buffer_size"] == 100_000


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("default: {tau: {lo: 1}}", r"tau: unknown field 'lo'; did you mean 'low'"),
        ("default: {x: {low: 2, high: 1}}", r"x needs low and high with low <= high"),
        ("default: {x: {low: 0, high: 1, log: true}}", r"must begin above 0"),
        ("default: {low.lerning_rate: {low: 1, high: 2}}", r"unknown setting 'low.lerning_rate'; did you mean"),
        ("default: {memory: {choices: [window, both]}}", r"memory must be one of"),
        ("default: {low.ent_coef: {when: {low.temp: fixed}}}", r"'when' must name a parameter above it"),
        (
            "default: {low.temperature: null}",
            r"take the condition away with low\.ent_coef: {when: null}",
        ),
        (
            "default: {low.ent_coef: {when: {low.temperature: fixd}}}",
            r"a value that low\.temperature can have, got 'fixd'",
        ),
        ("default: {low.gamma: {low: .9, high: 1, when: {max_options: 500}}}", r"that max_options can have, got 500"),
        ("default: {low.gamma: {low: .9, high: .99, log: 'no'}}", r"log must be true or false, got 'no'"),
        ("default: {x: {low: .9, high: .99, keys: low.gamma}}", r"keys must be a list of settings.*got 'low\.gamma'"),
        ("default: {x: {low: .9, high: .99, keys: [3]}}", r"keys must be a list of settings.*got \[3\]"),
        ("default: {n_timesteps: {low: 1000, high: 2000}}", r"n_timesteps cannot be searched.*give --n-timesteps"),
        ("default: {x: {choices: {a: {n_timesteps: 9}}}}", r"x: n_timesteps cannot be searched"),
        ("default: {learning_rate_schedule: {choices: [cosine]}}", r"must be among constant, linear"),
        ("default: {learning_rate_schedule: {keys: [low.tau]}}", r"keys must be among low\.learning_rate, low\.actor"),
        ("default: {learning_rate_schedule: {low: 0, high: 1}}", r"learning_rate_schedule needs choices"),
        ("default: {low.gamma: {low: .9, high: 1.5}}", r"low\.gamma must be a number from 0 to 1, got 1\.5"),
        ("default: {low.buffer_size: {low: 1000, high: 99999.5}}", r"low\.buffer_size must be a whole number"),
        ("default: {low.gamma: {low: .9, high: .inf}}", r"needs low and high"),
        ("default: {low.gamma: {low: .9, high: .99, step: 0}}", r"step must be a number above 0, got 0;"),
        ("default: {low.gamma: {low: .9, high: .99, step: wide}}", r"step must be a number above 0, got 'wide';"),
        (
            "default: {n_hindsight_goals: {low: 3, high: 9, step: 0.5}}",
            r"step must be whole where low and high are, got 0\.5",
        ),
        ("default: {tau: 3}", r"tau must have fields"),
        ("default: 3", r"expected sections"),
        ("default: {a: [}", r"cannot read .*: it is no YAML"),
    ],
)
def test_mistakes_in_a_file(tmp_path: Path, text: str, message: str) -> None:
    path = tmp_path / "mine.yml"
    path.write_text(text)
    with pytest.raises(ConfigError, match=message):
        load_space("tbc-hrl", "Pendulum", path)


def test_a_file_without_a_section_for_the_task_is_refused(tmp_path: Path) -> None:
    (tmp_path / "space.yml").write_text("Pendulm: {low.tau: null}")
    with pytest.raises(ConfigError, match=r"needs a section default or one named Pendulum, it has Pendulm$"):
        load_space("tbc-hrl", "Pendulum", tmp_path / "space.yml")
