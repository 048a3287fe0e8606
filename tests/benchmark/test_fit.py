"""What ``benchmark fit`` and ``benchmark record`` do: skills, actors by description, R2 at the best rate."""

from __future__ import annotations

from pathlib import Path

import gymnasium as gym
import numpy as np
import pytest
import torch as th

import sb3_tbc.benchmark.command
from sb3_tbc import TBCHRL
from sb3_tbc.benchmark import fit, skills
from sb3_tbc.benchmark.circuits import paper_numbers
from sb3_tbc.benchmark.skills import Skill, delay_skill, load_skill, skill_names
from sb3_tbc.errors import ConfigError
from sb3_tbc.ndbc.network import NDBCNet
from sb3_tbc.zoo.environments import make_envs


def linear_skill(n_inputs: int = 4, n_outputs: int = 2) -> Skill:
    inputs = th.randn(600, n_inputs, generator=th.Generator().manual_seed(0))
    targets = inputs @ th.randn(n_inputs, n_outputs, generator=th.Generator().manual_seed(1))
    targets = targets / targets.std(dim=0)
    return Skill("Pendulum", inputs[:500], targets[:500], inputs[500:], targets[500:])


@pytest.mark.parametrize("name", skill_names())
def test_every_skill_can_be_learnt_from_and_judged_on(name: str) -> None:
    skill = load_skill(name)
    assert len(skill.inputs) == len(skill.targets) > len(skill.later_inputs) == len(skill.later_targets) > 200
    assert all(th.isfinite(part).all() for part in skill[1:])
    if not name.startswith("delay"):
        spread = skill.targets.std(dim=0)
        th.testing.assert_close(spread[spread > 0.5], th.ones_like(spread[spread > 0.5]))
        file = Path(skills.__file__).parent / "skills" / f"{name}.npz"
        assert file.stat().st_size < 1_000_000


@pytest.mark.parametrize("steps", [1, 3, 30])
def test_a_delay_is_a_delay(steps: int) -> None:
    skill = delay_skill(steps, n_learnt=5, n_later=3)
    assert skill.inputs.shape == (5, 50, 1)
    assert th.equal(skill.targets[:, steps:], skill.inputs[:, :-steps])
    assert not skill.targets[:, :steps].any()
    assert not th.equal(skill.later_inputs, skill.inputs[:3])


def test_an_unknown_skill_is_refused() -> None:
    for name in ("Tennis", "delay0", "delay50", "delayx"):
        with pytest.raises(ConfigError, match="no skill"):
            load_skill(name)


def test_actors_are_made_as_described() -> None:
    skill, numbers = linear_skill(), paper_numbers("Pendulum")
    nets = {text: fit.parse_actor(text).make(skill, 0) for text in (
        "paper", "lean", "lean,reflex", "lean,full", "lean,inter=9,sub_steps=6", "lean,slow", "mlp", "mlp:24x14",
        "mlp:500", "gru:16")}  # fmt: skip
    circuits = {text: net for text, net in nets.items() if isinstance(net, NDBCNet)}
    assert [net.wiring.inter for net in circuits.values()] == [6, 6, 6, 6, 9, 6]
    assert nets["paper"].synapses == "paper"
    assert nets["lean"].synapses == "lean"
    assert nets["lean,reflex"].wiring.sensory_to == ("inter", "command", "motor")
    assert np.count_nonzero(nets["lean,full"].wiring.sensory) == 4 * numbers["inter"]
    assert nets["lean,inter=9,sub_steps=6"].sub_steps == 6
    assert nets["lean,slow"].cell.log_capacitance
    size = fit.count(nets["paper"])
    assert fit.count(nets["mlp"]) == pytest.approx(size, rel=0.01)
    assert fit.count(nets["mlp:500"]) == pytest.approx(500, rel=0.01)
    assert fit.count(nets["mlp:24x14"]) == 5 * 24 + 25 * 14 + 15 * 2
    assert fit.count(nets["lean"]) < 0.75 * size
    for net in nets.values():
        assert net(skill.inputs[:3])[0].shape == (3, 2)
    assert nets["gru:16"](th.zeros(2, 7, 4))[0].shape == (2, 7, 2)


@pytest.mark.parametrize(
    "text", ["", "fat", "lean:3", "lean,inter", "lean,colour=3", "mlp:0x3", "mlp:axb", "gru", "mlp,full"]
)
def test_what_describes_no_actor_is_refused(text: str) -> None:
    with pytest.raises(ConfigError, match="actor"):
        fit.parse_actor(text)


def test_r2_is_of_the_best_rate() -> None:
    skill, actor = linear_skill(), fit.parse_actor("mlp:8x8")._replace(rates=(1e-5, 1e-2))
    result = fit.best_of(actor, skill, (1, 200), (0, 1))
    assert result.rates[200] == 1e-2
    assert 0.8 < result.r2[200] <= 1.0
    perfect = th.nn.Module()
    perfect.forward = lambda inputs: (skill.later_targets, None)  # type: ignore[method-assign]
    assert fit.judge(perfect, skill) == 1.0


def test_the_command_prints_a_table(capsys: pytest.CaptureFixture[str], tmp_path: Path) -> None:
    arguments = ["fit", "--tasks", "Pendulum", "delay3", "--actors", "lean,rate=3e-2", "gru:4", "--steps", "2", "1"]
    assert sb3_tbc.benchmark.command.benchmark([*arguments, "--json", str(tmp_path / "fit.json")]) == 0
    printed = capsys.readouterr().out
    rows = [line for line in printed.splitlines() if line.startswith("|")]
    assert rows[0] == "| skill | actor | parameters | 1 | 2 |"
    assert len(rows) == 6
    assert "| delay3 | gru:4 |" in printed
    assert "(0.03)" in printed
    assert (tmp_path / "fit.json").is_file()


def test_a_low_level_is_recorded(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(skills, "MAX_ROWS", 700)
    env = gym.make("sb3_tbc/Pendulum-v0")
    model = TBCHRL("MultiInputPolicy", env, seed=0, compile=False, low={"policy_kwargs": {"ndbc": None}})
    venv = make_envs("sb3_tbc/Pendulum-v0", 1, 0)
    recording = skills.record(model, venv, every=2)
    assert recording["inputs"].dtype == np.float16
    assert recording["inputs"].shape == (700, model.low.observation_space.shape[0])
    assert 0 < recording["learnt"] <= 0.85 * 700
    seen = th.from_numpy(recording["inputs"].astype(np.float32) * model.layout.low_scale())
    means = model.low.policy.average_actor.step(seen.float(), th.zeros(700, 0))[0]
    np.testing.assert_allclose(recording["means"], means.detach().numpy(), atol=0.02)
    circuit = TBCHRL("MultiInputPolicy", env, seed=0, compile=False)
    with pytest.raises(ConfigError, match="is a circuit"):
        skills.record(circuit, venv)
    monkeypatch.setattr(skills, "MAX_ROWS", 10)
    with pytest.raises(ConfigError, match="no episode ended"):
        skills.record(model, venv)
