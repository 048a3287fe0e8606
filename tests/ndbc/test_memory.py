"""Slow neurons: time constants as they are asked for, and a circuit that remembers."""

from __future__ import annotations

import copy

import numpy as np
import pytest
import torch as th
from hypothesis import given, settings
from hypothesis import strategies as st

from sb3_tbc.benchmark.skills import delay_skill
from sb3_tbc.ndbc.network import SYNAPSES, NDBCNet
from sb3_tbc.ndbc.wiring import NDBCWiring


def make(seed: int = 0, command: int = 30, **kwargs: object) -> NDBCNet:
    return NDBCNet(3, 1, NDBCWiring(3, 10, command, 4, 4, 6, 10, 4, seed=seed), seed=seed, **kwargs)


@given(st.integers(0, 1000), st.sampled_from(SYNAPSES), st.floats(0.05, 20.0), st.floats(1.0, 100.0))
@settings(max_examples=30, deadline=None)
def test_time_constants_are_drawn_in_their_range(seed: int, synapses: str, low: float, factor: float) -> None:
    net = make(seed, synapses=synapses, time_constants={"command": (low, low * factor), "motor": None})
    plain = make(seed, synapses=synapses)
    with th.no_grad():
        net.cell.threshold.zero_()
        net.cell.current_weight.zero_()
        if synapses == "paper":
            net.cell.sensory_threshold.zero_()
    found = net.time_constants(th.zeros(1, 3), net.initial_state(1))[0]  # every logistic is half open
    command = found[net.wiring.layer("command")]
    assert (command >= low * (1 - 1e-4)).all()
    assert (command <= low * factor * (1 + 1e-4)).all()
    values = [n.cell.values().capacitance for n in (net, plain)]
    for name in ("inter", "motor"):
        layer = net.wiring.layer(name)
        th.testing.assert_close(values[0][layer], values[1][layer], atol=1e-5, rtol=1e-4)
    if factor > 10.0:
        logs = (command / low).log() / np.log(factor)
        assert logs.min() < 0.35
        assert logs.max() > 0.65


def test_time_constants_are_trained_by_factors_and_stay_positive() -> None:
    net = make(time_constants={"command": (10.0, 10.0)})
    before = net.cell.values().capacitance.detach().clone()
    optimizer = th.optim.Adam(net.parameters(), lr=0.1)
    inputs = th.randn(16, 8, 3)
    for _ in range(20):
        loss = (net(inputs)[0] - inputs.cumsum(dim=1).sum(dim=-1, keepdim=True)).square().mean()
        optimizer.zero_grad()
        loss.backward()
        optimizer.step()
    after = net.cell.values().capacitance.detach()
    change = (after / before).log()[net.wiring.layer("command")]
    assert (after > 0).all()
    assert float(change.abs().max()) > 0.5


def test_slow_neurons_need_no_more_sub_steps() -> None:
    errors = []
    for constants in (None, {"inter": (3.0, 30.0), "command": (3.0, 30.0), "motor": (3.0, 30.0)}):
        net = make(time_constants=constants)
        exact = copy.deepcopy(net)
        exact.sub_steps = 300
        inputs, state = th.randn(32, 3), 0.5 * th.randn(32, net.state_dim)
        with th.no_grad():
            moved = (exact(inputs, state)[1] - state).norm()
            errors.append(float((net(inputs, state)[1] - exact(inputs, state)[1]).norm() / moved))
    assert errors[1] < 0.1
    assert errors[1] < errors[0]


def test_a_fresh_slow_circuit_remembers_what_a_fast_one_forgets() -> None:
    left = []
    for constants in (None, {"command": (3.0, 30.0)}):
        net = make(time_constants=constants, sub_steps=3)
        inputs, state = th.zeros(1, 5, 3), th.zeros(1, net.state_dim)
        with th.no_grad():
            difference = net(inputs, state + 1.0)[0] - net(inputs, state)[0]
        left.append(float(difference[0, -1].abs().max()))
    assert left[0] < 1e-3
    assert left[1] > 20 * left[0]


@pytest.mark.parametrize(
    "wrong", [{"sensory": (1, 2)}, {"command": (0.0, 1.0)}, {"command": (2.0, 1.0)}, {"inter": (1,)}]
)
def test_a_wrong_range_is_named(wrong: dict[str, tuple[float, ...]]) -> None:
    with pytest.raises(ValueError, match=next(iter(wrong))):
        make(time_constants=wrong)
    with pytest.raises(ValueError, match="initial_gains"):
        make(initial_gains=(3.0, 1.0))
    for option in ({"time_constants": {"command": (1.0, 2.0)}}, {"initial_gains": (1.0, 2.0)}):
        with pytest.raises(ValueError, match="dynamics='conductance'"):
            make(dynamics="dissipative", **option)


def delay_error(seed: int, **kwargs: object) -> tuple[int, float]:
    """Parameters and mean squared error on a delay of ten steps after 400 Adam steps at 1e-2."""
    wiring = NDBCWiring(1, 2, 12, 2, 12, 4, 75, 4, seed=seed, sensory_to=("inter", "command"))
    net = NDBCNet(1, 1, wiring, seed=seed, synapses="lean", **kwargs)
    skill, generator = delay_skill(10), th.Generator().manual_seed(seed)
    optimizer = th.optim.Adam(net.parameters(), lr=1e-2)
    for _ in range(400):
        rows = th.randint(len(skill.inputs), (32,), generator=generator)
        loss = (net(skill.inputs[rows])[0] - skill.targets[rows]).square().mean()
        optimizer.zero_grad()
        loss.backward()
        th.nn.utils.clip_grad_norm_(net.parameters(), 1.0)
        optimizer.step()
    with th.no_grad():
        error = (net(skill.later_inputs)[0] - skill.later_targets).square().mean()
    return sum(p.numel() for p in net.parameters()), float(error)


@pytest.mark.slow
def test_slow_neurons_learn_a_delay_that_fast_ones_cannot() -> None:
    parameters, slow = delay_error(0, time_constants={"command": (0.5, 3.0)}, initial_gains=(6.0, 12.0))
    assert parameters <= 235
    assert slow < 0.04  # measured: .023 to .029; the variance is .27
    assert delay_error(0)[1] > 0.2
