"""The command, end to end on the agents of the package, and its answers to what it cannot do."""

from __future__ import annotations

import json
from pathlib import Path

import gymnasium as gym
import numpy as np
import pytest
import torch as th

import sb3_tbc
from sb3_tbc import TBCHRL, SubgoalSpace, evaluate
from sb3_tbc.errors import ConfigError
from sb3_tbc.interpret import command as interpret
from sb3_tbc.interpret.features import space_of
from sb3_tbc.pretrained import load_pretrained, pretrained_names, pretrained_path
from sb3_tbc.zoo.algorithms import RUN_INFO, read_zip
from sb3_tbc.zoo.environments import make_envs
from tests.corridor import Corridor

SHORT = ["--n-episodes", "2", "--n-random", "1", "--max-alone", "2"]
CIRCUIT = {"inter": 4, "command": 4, "motor": 1, "sensory_fanout": 3, "inter_fanout": 3, "motor_fanin": 3}
CIRCUIT["recurrent_command_synapses"] = 1


def saved(tmp_path: Path, **settings: object) -> Path:
    """An untrained agent, saved as the runner saves one."""
    th.manual_seed(0)
    env = make_envs("sb3_tbc/Pendulum-v0", 1, 0, {})
    model = TBCHRL("MultiInputPolicy", env, compile=False, max_options=3, **settings)
    info = {"task": "Pendulum", "algo": "tbc-hrl", "variant": "full", "config": "custom", "seed": 0}
    setattr(model, RUN_INFO, {**info, "env_id": "sb3_tbc/Pendulum-v0", "env_kwargs": {}})
    model.save(tmp_path / "agent.zip")
    return tmp_path / "agent.zip"


def test_figures_of_a_trained_agent(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    out, png = tmp_path / "o.json", tmp_path / "o.png"
    assert interpret.main(["pretrained:Pendulum", *SHORT, "--json", str(out), "--png", str(png)]) == 0
    text = capsys.readouterr().out
    for words in ("2 held-out episodes", "12.8%", "memory: none", "time constants", "shifted in time"):
        assert words in text
    assert png.read_bytes().startswith(b"\x89PNG")
    plain = json.loads(out.read_text())
    assert plain["task"] == "Pendulum"
    assert plain["memory_share"] is None
    assert len(plain["unit_names"]) == len(plain["activity"]) == len(plain["information"]["bits"]) == 13
    kinds = [(lesion["what"], lesion["clamped_to"]) for lesion in plain["lesions"]]
    assert {what for what, _ in kinds} == {"top", "random", "alone", "unread", "layer"}
    assert kinds.count(("top", "rest")) == kinds.count(("top", "mean")) == 5


def test_the_number_of_clamped_units_is_that_of_a_circuit_with_few(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    circuit = {**CIRCUIT, "inter": 2, "command": 1, "recurrent_command_synapses": 0}
    assert interpret.main([str(saved(tmp_path, low={"policy_kwargs": {"ndbc": circuit}})), *SHORT]) == 0
    text = capsys.readouterr().out
    assert "4 most active clamped to rest" in text
    assert "(4 random)" in text
    assert "5 most active" not in text


def test_an_mlp_in_the_circuits_place(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    path = saved(tmp_path, low={"policy_kwargs": {"net_arch": [6, 6], "ndbc": None}})
    assert interpret.main([str(path), *SHORT]) == 0
    text = capsys.readouterr().out
    assert "MLP: its hidden units, 12 units" in text
    assert "an MLP has none" in text
    assert "never succeeds" in text
    assert interpret.main([str(path), *SHORT, "--synapses"]) == 2
    assert capsys.readouterr().err.count("\n") == 1


@pytest.mark.parametrize("dynamics", ["conductance", "dissipative"])
def test_memory_is_measured_where_there_is_some(
    dynamics: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    path = saved(tmp_path, memory="window", low={"policy_kwargs": {"ndbc": {**CIRCUIT, "dynamics": dynamics}}})
    out = tmp_path / "o.json"
    assert interpret.main([str(path), *SHORT, "--json", str(out)]) == 0
    assert "without the membrane of the step before" in capsys.readouterr().out
    plain = json.loads(out.read_text())
    assert plain["dynamics"] == dynamics
    assert plain["memory_share"]["share"] > 0.0
    assert [lesion["what"] for lesion in plain["lesions"]].count("memory") == 1


def test_a_task_without_features_of_its_own(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """One subgoal coordinate, no pictures, no names: speed, energy, distance and time are left."""
    gym.register("InsideCorridor-v0", Corridor, disable_env_checker=True)
    try:
        env = make_envs("InsideCorridor-v0", 1, 0, {})
        model = TBCHRL("MultiInputPolicy", env, compile=False, max_options=3)
        info = {"task": "InsideCorridor-v0", "algo": "tbc-hrl", "variant": "full", "config": "custom", "seed": 0}
        setattr(model, RUN_INFO, {**info, "env_id": "InsideCorridor-v0", "env_kwargs": {}})
        model.save(tmp_path / "agent.zip")
        out = {f"--{kind}": tmp_path / f"out.{kind}" for kind in ("json", "png", "html")}
        files = [str(part) for pair in out.items() for part in pair]
        assert interpret.main([str(tmp_path / "agent.zip"), *SHORT, *files]) == 0
    finally:
        del gym.registry["InsideCorridor-v0"]
    features = json.loads(out["--json"].read_text())["correlation"]["features"]
    assert features == ["speed", "energy", "distance to subgoal", "remaining time"]
    assert '"live":null' in out["--html"].read_text(encoding="utf-8")


@pytest.mark.parametrize(
    ("argument", "words"),
    [("pretrained:Pendulumm", "Pendulum"), ("absent.zip", "no such file")],
)
def test_mistakes_are_one_line(argument: str, words: str, capsys: pytest.CaptureFixture[str]) -> None:
    try:
        status = interpret.main([argument])
    except SystemExit as stopped:
        status = int(stopped.code or 0)
    error = capsys.readouterr().err
    assert status == 2
    assert words in error
    assert error.count("\n") == 1


@pytest.mark.parametrize(
    ("settings", "words"),
    [
        ({"low": {"policy_kwargs": {"net_arch": [], "ndbc": None}}}, "without hidden layers: it has no units"),
        ({"window_end": "reconsider"}, "from an export, but an agent with window_end"),
        ({"duration": "rule"}, "from an export, but duration="),
    ],
)
def test_agents_without_units_or_page_are_refused_before_the_episodes(
    settings: dict[str, object], words: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    path = saved(tmp_path, **settings)
    assert interpret.main([str(path), *SHORT, "--html", str(tmp_path / "p.html")]) == 2
    said = capsys.readouterr()
    assert words in said.err
    assert said.err.count("\n") == 1
    assert said.out == ""


@pytest.mark.parametrize("name", pretrained_names())
def test_every_agent_of_the_package_has_a_card_that_is_true(name: str, capsys: pytest.CaptureFixture[str]) -> None:
    path = pretrained_path(name)
    card = path.with_suffix(".md").read_text(encoding="utf-8")
    steps = read_zip(path)["num_timesteps"]
    assert f"{steps:,} environment steps" in card
    for words in ("Known failings", "licence", "95 % Wilson interval", "seed"):
        assert words in card
    assert isinstance(load_pretrained(name), TBCHRL)


def test_a_pretrained_agent_does_what_its_card_says(capsys: pytest.CaptureFixture[str], tmp_path: Path) -> None:
    out = tmp_path / "e.json"
    assert evaluate.main(["pretrained:Pendulum", "--n-episodes", "20", "--json", str(out)]) == 0
    assert json.loads(out.read_text())["success_rate"] >= 0.9
    assert sb3_tbc.load_pretrained("Pendulum").num_timesteps == 100_000
    with pytest.raises(ConfigError, match="Drawbridge"):
        sb3_tbc.load_pretrained("Drawbrige")


def test_subgoals_of_the_agents_own_are_what_is_drawn(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """One coordinate in place of the task's two."""
    angle = SubgoalSpace.from_slices(
        [-3.2], [3.2], [0.2], achieved=[("achieved_goal", 0, 1)], local_scale=[1.0, 1.0, 8.0], names=["angle"]
    )
    path, page = saved(tmp_path, subgoals=angle), tmp_path / "page.html"
    assert interpret.main([str(path), *SHORT, "--html", str(page), "--png", str(tmp_path / "o.png")]) == 0
    assert "speed" in capsys.readouterr().out
    assert '"live":null' in page.read_text(encoding="utf-8")


def test_speed_along_one_coordinate() -> None:
    space = space_of("", SubgoalSpace.from_slices([-1], [1], [0.1], local_scale=[1.0], names=["x"]))
    assert space.speed is not None
    points = np.array([[0.0], [0.5], [0.4], [1.0]])
    np.testing.assert_allclose(space.speed(points, points)[:-1], [0.5, 0.1, 0.6])
