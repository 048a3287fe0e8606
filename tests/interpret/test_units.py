"""Units act as the agent does, and lesions do what they say."""

from __future__ import annotations

import copy

import numpy as np
import pytest
import torch as th
from gymnasium import spaces

from sb3_tbc import TBCHRL
from sb3_tbc.interpret.episodes import HeldOutEpisodes, Trace, outcome_of
from sb3_tbc.interpret.lesions import activity, plan_lesions, relative_drop, run_lesions
from sb3_tbc.interpret.time_constants import memory_share, time_constants
from sb3_tbc.interpret.units import CircuitUnits, MLPUnits, clamp, no_lesion, units_of
from sb3_tbc.level.actors import NDBCActor
from sb3_tbc.tbc_hrl.evaluation import evaluate_hierarchical
from sb3_tbc.zoo.environments import make_envs
from sb3_tbc.zoo.runner import HELD_OUT

ROWS = 40


def circuit(dynamics: str = "conductance", **ndbc: object) -> CircuitUnits:
    """A small circuit with drawn weights and three inputs."""
    th.manual_seed(0)
    box, act = spaces.Box(-1, 1, (3,)), spaces.Box(-1, 1, (2,))
    numbers = {"inter": 4, "command": 3, "motor": 2, "sensory_fanout": 2, "inter_fanout": 2, "motor_fanin": 2}
    actor = NDBCActor(
        box, act, th.nn.Flatten(), 3, {**numbers, "recurrent_command_synapses": 1, "dynamics": dynamics, **ndbc}, 3.0
    )
    return CircuitUnits(actor)


def rows(units: CircuitUnits) -> tuple[np.ndarray, np.ndarray]:
    rng = np.random.default_rng(0)
    return rng.uniform(-1, 1, (ROWS, 3)).astype(np.float32), rng.normal(0, 0.3, (ROWS, units.state_dim))


@pytest.mark.parametrize("dynamics", ["conductance", "dissipative"])
def test_without_a_lesion_the_circuit_steps_as_the_network(dynamics: str) -> None:
    units = circuit(dynamics)
    inputs, state = rows(units)
    action, after, activations = units.step(inputs, state, no_lesion(units))
    outputs, expected = units.net(th.as_tensor(inputs).double(), th.as_tensor(state).double())
    np.testing.assert_allclose(activations, expected.detach().numpy(), atol=1e-12)
    np.testing.assert_allclose(after, activations, atol=1e-6)
    np.testing.assert_allclose(action, np.tanh(outputs.detach().numpy()[:, :2].clip(-3, 3)), atol=1e-6)


@pytest.mark.parametrize("dynamics", ["conductance", "dissipative"])
def test_a_lesion_that_cannot_matter_and_one_that_must(dynamics: str) -> None:
    """A neuron that nobody hears may be clamped to anything; the only one that is read may not."""
    units = circuit(dynamics)
    inputs, state = rows(units)
    silent, loud = 7, 8  # both motor neurons, which pass nothing on
    with th.no_grad():
        units.net.readout_weight.zero_()
        units.net.readout_weight[:, loud] = 1.0
    whole = units.step(inputs, state, no_lesion(units))[0]
    value = np.full(9, 0.5)
    np.testing.assert_array_equal(units.step(inputs, state, clamp(units, [silent], value))[0], whole)
    clamped = units.step(inputs, state, clamp(units, [loud], value))[0]
    assert np.ptp(clamped, axis=0).max() == 0.0
    assert np.abs(clamped - whole).max() > 0.01


def test_being_read_and_passing_on_are_told_apart() -> None:
    """An unread neuron still drives the others; a clamped one does not."""
    units = circuit()
    inputs, state = rows(units)
    with th.no_grad():
        units.net.readout_weight.zero_()
        units.net.readout_weight[:, 7:] = 1.0  # motor neurons alone are read
    which = next(i for i in range(4, 7) if units.net.wiring.recurrent[i, 7:].any())  # a command neuron that drives them
    held = clamp(units, [which], units.rest)
    unread = no_lesion(units)._replace(unread=held.held)
    whole = units.step(inputs, state, no_lesion(units))
    np.testing.assert_array_equal(units.step(inputs, state, unread)[0], whole[0])
    assert np.abs(units.step(inputs, state, held)[2] - whole[2])[:, 7:].max() > 1e-3


@pytest.mark.parametrize("dynamics", ["conductance", "dissipative"])
def test_cutting_all_synapses_of_a_neuron_leaves_it_alone(dynamics: str) -> None:
    units = circuit(dynamics)
    inputs, state = rows(units)
    names = units.synapses()
    assert len(names) == units.net.wiring.n_synapses
    cut = units
    for index, (_, after, _) in enumerate(names):
        if after == "inter1":
            cut = cut.without_synapse(index)
    inter1 = cut.names.index("inter1")
    before = units.step(inputs, np.zeros_like(state), no_lesion(units))[2][:, inter1]
    alone = cut.step(inputs, np.zeros_like(state), no_lesion(cut))[2][:, inter1]
    assert np.ptp(before) > 1e-3
    assert np.ptp(alone) < 1e-12  # inputs no longer reach it


def test_recorded_episodes_are_those_of_the_evaluation(agent: TBCHRL, traces: list[Trace]) -> None:
    env = make_envs("sb3_tbc/Pendulum-v0", len(traces), None, {})
    expected = evaluate_hierarchical(agent, env, len(traces), seed=HELD_OUT)
    outcome = outcome_of([t.episode for t in traces])
    np.testing.assert_array_equal(outcome.success, expected.successes)
    np.testing.assert_array_equal(outcome.length, expected.lengths)
    np.testing.assert_allclose(outcome.subgoals, expected.subgoal_success)


def test_traces_fit_together(traces: list[Trace]) -> None:
    for trace in traces:
        steps = trace.episode.length
        assert {len(trace.inputs), len(trace.activations), len(trace.phase), len(trace.steps_left)} == {steps}
        assert trace.phase.min() == 0.0
        assert trace.phase.max() < 1.0
        np.testing.assert_allclose(trace.inputs[:, -1], np.clip(trace.steps_left / (1000 / 22), 0, 1), atol=1e-6)


def test_lesions_of_a_trained_agent(episodes: HeldOutEpisodes, units: CircuitUnits, traces: list[Trace]) -> None:
    """Clamping everything ends all success; clamping nothing changes nothing."""
    whole = outcome_of([t.episode for t in traces])
    plans = plan_lesions(units, traces, most=2, n_random=1, max_alone=1)
    most_active = units.names[int(activity(units, traces).argmax())]
    assert next(p.names for p in plans if p.what == "top") == (most_active,)
    nothing = plans[0]._replace(what="nothing", lesion=no_lesion(units))
    everything = plans[0]._replace(what="all", lesion=clamp(units, range(13), units.rest))
    first, last = run_lesions(episodes, units, traces, whole, [nothing, everything])
    assert first.success is not None
    assert last.success is not None
    assert (first.success.drop, first.action_change) == (0.0, 0.0)
    assert last.success.drop == 1.0
    assert last.action_change > 0.1


def test_relative_drop_and_its_interval() -> None:
    whole, lesioned = np.ones(400), np.repeat([1.0, 0.0], [300, 100])
    drop = relative_drop(whole, lesioned)
    assert drop is not None
    assert drop.drop == 0.25
    assert drop.low == pytest.approx(0.25 - 1.96 * np.sqrt(0.25 * 0.75 / 400), abs=0.01)
    assert drop.high == pytest.approx(0.25 + 1.96 * np.sqrt(0.25 * 0.75 / 400), abs=0.01)
    assert relative_drop(np.zeros(5), np.zeros(5)) is None


def test_memory_share_of_a_slow_and_of_a_fast_circuit(units: CircuitUnits, traces: list[Trace]) -> None:
    """Large capacitances make memory; without a membrane from before there is none."""
    assert memory_share(units, traces).share == 0.0  # the agent resets its membranes at each step
    slow = copy.copy(units)
    slow.net = copy.deepcopy(units.net)
    with th.no_grad():
        slow.net.cell.raw_capacitance += 30.0
    remembered = [t._replace(before=np.roll(t.activations, 1, axis=0)) for t in traces]
    assert memory_share(slow, remembered).share > 0.1
    assert time_constants(slow, traces).median.min() > time_constants(units, traces).median.max()


def test_hidden_units_of_an_mlp_are_units_too() -> None:
    th.manual_seed(0)
    env = make_envs("sb3_tbc/Pendulum-v0", 1, 0, {})
    low = {"policy_kwargs": {"net_arch": [8, 6], "ndbc": None}}
    model = TBCHRL("MultiInputPolicy", env, low=low, compile=False)
    units = units_of(model)
    assert isinstance(units, MLPUnits)
    assert units.names[8:10] == ("hidden1.0", "hidden1.1")
    inputs = np.random.default_rng(0).normal(size=(20, 6)).astype(np.float32)
    none = np.zeros((20, 0), dtype=np.float32)
    expected, _ = model.low.acting.act(inputs, none, True, np.random.default_rng(0), average=True)
    np.testing.assert_allclose(units.step(inputs, none, no_lesion(units))[0], expected, atol=1e-6)
    held = clamp(units, range(8, 14), units.rest)
    assert np.ptp(units.step(inputs, none, held)[0]) == 0.0  # the whole last layer
    first = no_lesion(units)._replace(unread=np.arange(14) < 8)
    np.testing.assert_allclose(units.step(inputs, none, first)[0], expected, atol=1e-6)  # not read directly anyway
