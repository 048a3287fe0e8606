"""Agents under disturbances: what is disturbed, how smoothness is measured, and that harm shows."""

from __future__ import annotations

import json
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import gymnasium as gym
import numpy as np
import pytest
from stable_baselines3 import SAC

from sb3_tbc.benchmark import robustness
from sb3_tbc.benchmark.command import benchmark
from sb3_tbc.benchmark.robustness import disturbances, measure
from sb3_tbc.errors import ConfigError
from sb3_tbc.pretrained import model_path
from sb3_tbc.tbc_hrl import TBCHRL
from sb3_tbc.tbc_hrl.evaluation import evaluate_agent
from sb3_tbc.zoo.algorithms import RUN_INFO, environment_of, load_model, read_zip
from sb3_tbc.zoo.environments import make_envs
from sb3_tbc.zoo.runner import evaluation_envs


@pytest.fixture
def few(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(robustness, "NOISES", (0.5,))
    monkeypatch.setattr(robustness, "DELAYS", ())
    monkeypatch.setattr(robustness, "FACTORS", (1.3,))


def test_disturbances_begin_with_none_and_name_every_quantity() -> None:
    found = dict(disturbances(["mass", "gravity"]))
    assert next(iter(found)) == "none"
    assert found["none"] == {}
    assert found["mass x 0.7"] == {"dynamics_scale": {"mass": 0.7}}
    assert len(found) == 1 + len(robustness.NOISES) + len(robustness.DELAYS) + 4


def test_roughness_is_the_mean_change_of_an_action() -> None:
    one = SimpleNamespace(actions=np.array([[0.0, 0.0], [1.0, 0.0], [1.0, -0.5]]))
    other = SimpleNamespace(actions=np.array([[0.3, 0.3]]))
    assert robustness.roughness([one, other]) == pytest.approx((1.0 + 0.5) / 4)  # type: ignore[list-item]
    assert np.isnan(robustness.roughness([other]))  # type: ignore[list-item]


def test_a_good_agent_suffers_from_noise_and_is_what_evaluate_says_without(few: None) -> None:
    path = Path(model_path("pretrained:Pendulum"))
    rows = {row.disturbance: row for row in measure(path, 10, seed=4)}
    env_id, env_kwargs = environment_of(path, read_zip(path))
    venv = evaluation_envs(env_id, 10, 4, env_kwargs)
    plain = evaluate_agent(load_model(path, venv), venv, 10, seed=4)
    assert rows["none"].successes == plain.successes.sum() >= 9
    assert rows["noise 0.5"].successes < rows["none"].successes
    assert rows["noise 0.5"].roughness > rows["none"].roughness
    assert rows["none"].interval[0] < rows["none"].successes / 10 <= rows["none"].interval[1]


def test_disturbances_come_on_top_of_what_an_agent_was_trained_with(
    few: None, tmp_path: Path, monkeypatch: Any
) -> None:
    own = {"hide_velocities": True, "dynamics_scale": {"gravity": 0.9}, "observation_noise": 0.1}
    model = TBCHRL("MultiInputPolicy", make_envs("sb3_tbc/Pendulum-v0", 1, 0, {"perturb": own}), compile=False)
    setattr(model, RUN_INFO, {"env_id": "sb3_tbc/Pendulum-v0", "env_kwargs": {"perturb": own}})
    model.save(tmp_path / "agent.zip")
    tried = []

    def noted(model: TBCHRL, env_id: str, env_kwargs: dict[str, Any], *rest: int) -> list[Any]:
        tried.append(env_kwargs["perturb"])
        return [SimpleNamespace(success=False, actions=np.zeros((2, 1)))]

    monkeypatch.setattr(robustness, "episodes_under", noted)
    measure(tmp_path / "agent.zip", 1, seed=0)
    assert tried[0] == own
    assert tried[1] == {**own, "observation_noise": 0.5}
    assert {**own, "dynamics_scale": {"gravity": 0.9, "mass": 1.3}} in tried
    assert {**own, "dynamics_scale": {"gravity": 1.3}} in tried


def test_the_command_prints_agents_side_by_side(few: None, capsys: Any, tmp_path: Path) -> None:
    out = tmp_path / "figures.json"
    agents = ["pretrained:Pendulum"] * 2
    assert benchmark(["robustness", *agents, "--n-episodes", "2", "--json", str(out)]) == 0
    printed = capsys.readouterr().out
    assert "success 1" in printed
    assert "95 % Wilson 1" in printed
    assert "mass x 1.3" in printed
    rows = json.loads(out.read_text())["rows"]
    assert len(rows) == 2 * (2 + 4)
    half = len(rows) // 2
    assert [row["successes"] for row in rows[:half]] == [row["successes"] for row in rows[half:]]


@pytest.mark.parametrize("other", ["Drawbridge", "Tennis2D"])  # the second has the same names of quantities
def test_agents_of_different_tasks_are_refused(other: str, few: None) -> None:
    with pytest.raises(ConfigError, match="different tasks"):
        benchmark(["robustness", "pretrained:Pendulum", f"pretrained:{other}", "--n-episodes", "1"])


@pytest.mark.parametrize("what", ["robustness", "record"])
def test_an_agent_saved_without_its_environment_needs_env(what: str, tmp_path: Path) -> None:
    env = gym.make("sb3_tbc/Pendulum-v0")
    SAC("MultiInputPolicy", env, buffer_size=10).save(tmp_path / "sac.zip")
    TBCHRL("MultiInputPolicy", env, compile=False).save(tmp_path / "plain.zip")
    with pytest.raises(ConfigError, match=r"another algorithm .*Load others with the class that saved them"):
        benchmark([what, str(tmp_path / "sac.zip")])
    with pytest.raises(ConfigError, match="does not say on which environment it was trained; pass --env"):
        benchmark([what, str(tmp_path / "plain.zip")])
    with pytest.raises(ConfigError, match="unknown environment 'Pendulun'"):
        benchmark([what, str(tmp_path / "plain.zip"), "--env", "Pendulun"])
