"""What ``benchmark fit`` and ``benchmark record`` do: skills, actors by description, R2 at the best rate."""

from __future__ import annotations

from pathlib import Path

import gymnasium as gym
import numpy as np
import pytest
import torch as th

import sb3_tbc.benchmark.command
from sb3_tbc import TBCHRL
from sb3_tbc.benchmark import actors, conditioning, fit, skills
from sb3_tbc.benchmark.actors import parse_actor
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
    nets = {text: parse_actor(text).make(skill, 0) for text in (
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
    size = actors.count(nets["paper"])
    assert actors.count(nets["mlp"]) == pytest.approx(size, rel=0.01)
    assert actors.count(nets["mlp:500"]) == pytest.approx(500, rel=0.01)
    assert actors.count(nets["mlp:24x14"]) == 5 * 24 + 25 * 14 + 15 * 2
    assert actors.count(nets["lean"]) < 0.75 * size
    for net in nets.values():
        assert net(skill.inputs[:3])[0].shape == (3, 2)
    assert nets["gru:16"](th.zeros(2, 7, 4))[0].shape == (2, 7, 2)


@pytest.mark.parametrize(
    "text", ["", "fat", "lean:3", "lean,inter", "lean,colour=3", "mlp:0x3", "mlp:axb", "gru", "mlp,full",
             "lean,rate=fast", "mlp,rate=0", "lean,rate_motors=3", "paper,rate=inf", "mlp:\u00b2",
             "mlp,optimizer=sgd", "mlp,rate_gains=3", "gru:0"]
)  # fmt: skip
def test_what_describes_no_actor_is_refused(text: str) -> None:
    with pytest.raises(ConfigError, match="actor"):
        parse_actor(text)


def test_an_mlp_that_would_be_smaller_than_asked_for_is_refused() -> None:
    with pytest.raises(ConfigError, match="MLP of 999999999 parameters is too large"):
        fit.best_of(parse_actor("mlp:999999999"), load_skill("delay3"), [1], [0])


@pytest.mark.parametrize("text", ["paper,inter=0", "paper,readout=foo"])
def test_a_circuit_that_cannot_be_made_is_refused_by_its_description(text: str) -> None:
    with pytest.raises(ConfigError, match=f"actor '{text}': (inter|readout) must be "):
        fit.best_of(parse_actor(text), load_skill("delay3"), [1], [0])


def learn_alone(actor: actors.Actor, rate: float, skill: Skill, steps: int, seed: int) -> float:
    """R2 of one averaged network, learnt in the plain way."""
    network, generator = actor.make(skill, seed), th.Generator().manual_seed(seed)
    average, optimizer = actor.make(skill, seed), th.optim.Adam(network.parameters(), lr=rate)
    for step in range(1, steps + 1):
        rows = th.randint(len(skill.inputs), (256,), generator=generator)
        optimizer.zero_grad()
        (network(skill.inputs[rows])[0] - skill.targets[rows]).square().mean().backward()
        th.nn.utils.clip_grad_norm_(network.parameters(), 1.0)
        optimizer.step()
        for kept, new in zip(average.parameters(), network.parameters(), strict=True):
            kept.data.lerp_(new.data, 1 - (1 + step) / (10 + step))
    with th.no_grad():
        return fit.explained(average(skill.later_inputs)[0], skill.later_targets)


@pytest.mark.parametrize("text", ["lean,reflex", "mlp:8x8"])
def test_networks_that_learn_side_by_side_learn_what_each_learns_alone(text: str) -> None:
    skill, actor = linear_skill(), parse_actor(text)._replace(rates=(1e-2, 1e-1))
    for rate, reached in fit.learn(actor, skill, (1, 20), seed=3).items():
        for steps, fitted in reached.items():
            assert fitted.later == pytest.approx(learn_alone(actor, rate, skill, steps, 3), abs=1e-4)


def test_what_was_learnt_by_heart_shows() -> None:
    skill = linear_skill()
    skill = skill._replace(later_targets=th.randn(100, 2, generator=th.Generator().manual_seed(5)))
    result = fit.best_of(parse_actor("mlp:8x8,rate=1e-2"), skill, (200,), (0,))
    assert result.r2_learnt[200] > 0.8
    assert result.r2[200] < 0.2


@pytest.mark.parametrize("option", ["relative", "unshunted"])
def test_conditioning_starts_from_the_same_circuit_or_one_with_weaker_inputs(option: str) -> None:
    skill = linear_skill()
    plain, changed = (parse_actor(text).make(skill, 0) for text in ("paper", f"paper,{option}"))
    with th.no_grad():
        before, after = plain.cell.values(), changed.cell.values()
    n_sensory = np.count_nonzero(plain.wiring.sensory)
    if option == "relative":
        for one, other in zip(before, after, strict=True):
            th.testing.assert_close(one, other)
        th.testing.assert_close(plain(skill.inputs)[0], changed(skill.inputs)[0], atol=1e-4, rtol=1e-4)
        assert actors.count(plain) == actors.count(changed)
    else:
        assert (after.conductance[:n_sensory] < 0.7 * before.conductance[:n_sensory]).all()
        th.testing.assert_close(before.conductance[n_sensory:], after.conductance[n_sensory:])


def test_a_relative_step_changes_a_synapse_by_a_factor_and_keeps_its_sign() -> None:
    net = parse_actor("lean,relative").make(linear_skill(), 0)
    before = net.cell.synapse.detach().clone()
    with th.no_grad():
        net.cell.parametrizations.synapse.original.sub_(3.0)
    th.testing.assert_close(net.cell.synapse.detach(), before * np.exp(-3.0).item())


@pytest.mark.parametrize("kind", ["paper", "lean"])
def test_a_centred_circuit_has_its_logistics_half_open_and_no_mean(kind: str) -> None:
    skill = linear_skill()
    skill = skill._replace(inputs=skill.inputs + 2.0)
    net = parse_actor(f"{kind},centred").make(skill, 0)
    with th.no_grad():
        outputs, potentials = net(skill.inputs[:256])
        heard = potentials.mean(dim=0)[: net.cell.n_presynaptic]
        opened = th.sigmoid(heard * net.cell.arrays().gain - net.cell.threshold)
    assert outputs.mean(dim=0).abs().max() < 1e-5
    assert (opened - 0.5).abs().max() < 0.15  # thresholds are drawn within half a unit


def test_standardised_inputs_have_mean_0_and_deviation_1_inside() -> None:
    skill = linear_skill()
    skill = skill._replace(inputs=3.0 * skill.inputs + 2.0)
    net = parse_actor("lean,standard").make(skill, 0)
    seen: list[th.Tensor] = []
    net.network.register_forward_pre_hook(lambda _, args: seen.append(args[0]))
    net(skill.inputs)
    th.testing.assert_close(seen[0].mean(dim=0), th.zeros(4), atol=1e-4, rtol=0)
    th.testing.assert_close(seen[0].std(dim=0), th.ones(4), atol=1e-4, rtol=0)


def test_groups_of_parameters_learn_at_rates_of_their_own() -> None:
    skill, actor = linear_skill(), parse_actor("lean,rate_gains=3,rate_readout=0.5")
    names = [name for name, _ in actor.make(skill, 0).named_parameters()]
    groups = {name: conditioning.group_of(name) for name in names}
    assert groups["cell.raw_gain"] == groups["cell.threshold"] == "gains"
    assert groups["cell.synapse"] == groups["cell.current_weight"] == "synapses"
    assert groups["readout_weight"] == "readout"
    assert groups["cell.raw_leak"] == "other"
    weights = {name: th.zeros(2, 3) for name in names}
    fit._updater(actor._replace(rates=(1e-2, 1e-1)), weights)({name: th.ones(2, 3) for name in names})
    factors = {"gains": 3.0, "readout": 0.5}
    for name, moved in weights.items():
        expected = -factors.get(groups[name], 1.0) * th.tensor([[1e-2], [1e-1]])
        th.testing.assert_close(moved, expected.expand(2, 3), atol=0, rtol=1e-3)


@pytest.mark.parametrize("text", ["lean,reflex,equal", "lean,equal"])
def test_equal_circuits_have_as_many_parameters_as_the_paper_s(text: str) -> None:
    skill = linear_skill()
    wanted = actors.count(parse_actor("paper").make(skill, 0))
    assert actors.count(parse_actor(text).make(skill, 0)) == pytest.approx(wanted, rel=0.02)


def test_a_network_that_diverges_is_not_the_best(monkeypatch: pytest.MonkeyPatch) -> None:
    found = {rate: {5: fit.Fit(later, 0.3)} for rate, later in ((1e-2, np.nan), (1e-1, 0.2), (1.0, np.nan))}
    monkeypatch.setattr(fit, "learn", lambda *_: found)
    assert fit.best_of(parse_actor("lean")._replace(rates=tuple(found)), linear_skill(), (5,), (0,)).rates == {5: 1e-1}


def test_r2_is_of_the_best_rate() -> None:
    skill, actor = linear_skill(), parse_actor("mlp:8x8")._replace(rates=(1e-5, 1e-2))
    result = fit.best_of(actor, skill, (1, 200), (0, 1))
    assert result.rates[200] == 1e-2
    assert 0.8 < result.r2[200] <= 1.0
    assert fit.explained(skill.later_targets, skill.later_targets) == 1.0
    assert fit.explained(th.zeros(100, 2) + skill.later_targets.mean(dim=0), skill.later_targets) == pytest.approx(0.0)


def test_the_command_prints_a_table(capsys: pytest.CaptureFixture[str], tmp_path: Path) -> None:
    arguments = ["fit", "--tasks", "Pendulum", "delay3", "--actors", "lean,rate=3e-2", "gru:4", "--steps", "2", "1"]
    assert sb3_tbc.benchmark.command.benchmark([*arguments, "--json", str(tmp_path / "fit.json")]) == 0
    printed = capsys.readouterr().out
    rows = [line for line in printed.splitlines() if line.startswith("|")]
    assert rows[0] == "| skill | actor | parameters | 1 | 2 | learnt from |"
    assert len(rows) == 6
    assert "| delay3 | gru:4 |" in printed
    assert "(0.03)" in printed
    assert (tmp_path / "fit.json").is_file()


@pytest.mark.parametrize("policy", [{"ndbc": None}, {}], ids=["mlp", "circuit"])
def test_a_low_level_is_recorded(policy: dict[str, None], monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(skills, "MAX_ROWS", 700)
    env = gym.make("sb3_tbc/Pendulum-v0")
    model = TBCHRL("MultiInputPolicy", env, seed=0, compile=False, low={"policy_kwargs": policy})
    venv = make_envs("sb3_tbc/Pendulum-v0", 1, 0)
    recording = skills.record(model, venv, every=2)
    assert recording["inputs"].dtype == np.float16
    assert recording["inputs"].shape == (700, model.low.observation_space.shape[0])
    assert 0 < recording["learnt"] <= 0.85 * 700
    seen = th.from_numpy(recording["inputs"].astype(np.float32) * model.layout.low_scale())
    actor = model.low.policy.average_actor
    means = actor.step(seen.float(), th.zeros(700, actor.state_dim))[0]
    np.testing.assert_allclose(recording["means"], means.detach().numpy(), atol=0.02)
    remembers = TBCHRL("MultiInputPolicy", env, seed=0, compile=False, memory="window")
    with pytest.raises(ConfigError, match="remembers"):
        skills.record(remembers, venv)
    monkeypatch.setattr(skills, "MAX_ROWS", 10)
    with pytest.raises(ConfigError, match="no episode ended"):
        skills.record(model, venv)
