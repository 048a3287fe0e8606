"""What is proved of the dynamics, checked over random weights, inputs and steps."""

from __future__ import annotations

import numpy as np
import pytest
import torch as th
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.typing import NDArray
from scipy.integrate import solve_ivp

from sb3_tbc.ndbc.closed_form import ClosedFormNDBC
from sb3_tbc.ndbc.network import NDBCNet
from sb3_tbc.ndbc.wiring import NDBCWiring

SEEDS = st.integers(0, 10_000)


def random_net(seed: int, spread: float = 1.0, **kwargs: object) -> NDBCNet:
    """A small network whose free parameters were all pushed around by ``spread`` standard deviations."""
    wiring = NDBCWiring(3, inter=4, command=4, motor=2, sensory_fanout=2, inter_fanout=3,
                        recurrent_command_synapses=3, motor_fanin=3, seed=seed)  # fmt: skip
    net = NDBCNet(3, 2, wiring, seed=seed, **kwargs)  # type: ignore[arg-type]
    generator = th.Generator().manual_seed(seed + 1)
    with th.no_grad():
        for parameter in net.parameters():
            parameter += spread * th.randn(parameter.shape, generator=generator)
    return net


def derivative(net: NDBCNet, inputs: NDArray[np.float64]) -> object:
    """dV/dt of one sample, written synapse by synapse from the equation, not from the cell's matrices."""
    cell, wiring = net.cell, net.wiring
    value = {name: v.detach().numpy() for name, v in cell.values()._asdict().items()}
    fixed = {name: p.detach().numpy() for name, p in cell.named_parameters()}
    u = inputs * net.input_gain.numpy()
    sensed = 1 / (1 + np.exp(fixed["sensory_threshold"] - value["sensory_gain"] * u))
    current = fixed["current_bias"].copy()
    synapses = [(True, i, j) for i, j in np.argwhere(wiring.sensory)]
    synapses += [(False, i, j) for i, j in np.argwhere(wiring.recurrent)]
    for k, (_, i, j) in enumerate(s for s in synapses if s[0]):
        current[j] += fixed["current_weight"][k] * u[i]

    def rate(_: float, potentials: NDArray[np.float64]) -> NDArray[np.float64]:
        flow = value["leak"] * (fixed["leak_potential"] - potentials)
        m = len(current)
        flow[:m] += value["input_conductance"] * (np.tanh(current) - potentials[:m])
        for k, (sensory, i, j) in enumerate(synapses):
            sign = (wiring.sensory if sensory else wiring.recurrent)[i, j]
            release = (
                sensed[i] if sensory else 1 / (1 + np.exp(fixed["threshold"][i] - value["gain"][i] * potentials[i]))
            )
            flow[j] += value["conductance"][k] * release * (sign * value["reversal"][k] - potentials[j])
        return flow / value["capacitance"]

    return rate


def exact(
    net: NDBCNet, inputs: NDArray[np.float64], state: NDArray[np.float64], duration: float = 1.0
) -> NDArray[np.float64]:
    return solve_ivp(derivative(net, inputs), (0.0, duration), state, rtol=1e-10, atol=1e-12, method="LSODA").y[:, -1]


@given(SEEDS, st.integers(1, 6), st.floats(0.01, 100.0), st.floats(0.1, 10.0))
@settings(max_examples=60, deadline=None)
def test_potentials_stay_in_their_bound(seed: int, sub_steps: int, interval: float, size: float) -> None:
    net = random_net(seed, spread=2.0, sub_steps=sub_steps)
    generator = th.Generator().manual_seed(seed)
    state = size * th.randn(8, net.state_dim, generator=generator)
    inputs = 10 * size * th.randn(8, 5, 3, generator=generator)
    low, high = net.cell.bounds(state.min(dim=0).values, state.max(dim=0).values)
    with th.no_grad():
        trace = net.unroll(inputs, state, interval=th.full((8, 5), interval))
    slack = 1e-5 * (1 + th.maximum(low.abs(), high.abs()))
    assert (trace >= low - slack).all()
    assert (trace <= high + slack).all()


@pytest.mark.parametrize("seed", [0, 1, 2])
def test_halving_the_step_converges_at_first_order(seed: int) -> None:
    net = random_net(seed, spread=0.5).double()
    rng = np.random.default_rng(seed)
    inputs, state = rng.normal(size=3), 0.5 * rng.normal(size=net.state_dim)
    reference = exact(net, inputs, state)
    errors = []
    for sub_steps in (64, 128, 256, 512):
        net.sub_steps = sub_steps
        with th.no_grad():
            stepped = net(th.from_numpy(inputs)[None], th.from_numpy(state)[None])[1][0].numpy()
        errors.append(np.abs(stepped - reference).max())
    orders = np.log2(np.array(errors[:-1]) / np.array(errors[1:]))
    np.testing.assert_allclose(orders, 1.0, atol=0.15)


@given(SEEDS, st.floats(0.2, 3.0), st.floats(0.0, 2.0), st.floats(0.1, 3.0))
@settings(max_examples=40, deadline=None)
def test_closed_form_error_bound_holds(seed: int, size: float, spread: float, duration: float) -> None:
    net = random_net(seed, spread=spread).double()
    closed = ClosedFormNDBC(net, dtype=np.float64)
    rng = np.random.default_rng(seed)
    inputs, state = size * rng.normal(size=(1, 3)), size * rng.normal(size=(1, net.state_dim))
    potentials = closed._relax(inputs, state, duration).after(duration)[0]
    error = np.abs(potentials - exact(net, inputs[0], state[0], duration))
    for pieces, passes in ((1, 1), (4, 3), (32, 8)):
        assert (error <= closed.error_bound(inputs, state, duration, pieces, passes)[0] + 1e-7).all()
    assert error[net.wiring.layer("inter")].max() < 1e-7, "inter neurons hear only inputs: the form is exact for them"


def test_closed_form_error_bound_says_something() -> None:
    ratios = []
    for seed in range(20):
        net = random_net(seed, spread=0.5).double()
        closed = ClosedFormNDBC(net, dtype=np.float64)
        rng = np.random.default_rng(seed)
        inputs, state = rng.normal(size=(1, 3)), rng.normal(size=(1, net.state_dim))
        error = np.abs(closed(inputs, state)[1][0] - exact(net, inputs[0], state[0]))
        ratios.append(closed.error_bound(inputs, state)[0].max() / error.max())
    assert np.median(ratios) < 4.0


@given(SEEDS, st.integers(1, 6), st.floats(0.0, 5.0))
@settings(max_examples=40, deadline=None)
def test_a_contraction_factor_below_one_bounds_the_state(seed: int, sub_steps: int, size: float) -> None:
    net = random_net(seed, spread=0.5, sub_steps=sub_steps, dynamics="dissipative", max_rho=0.97)
    certificate = net.certificate()
    assert certificate.rho <= 0.97 + 1e-6
    generator = th.Generator().manual_seed(seed)
    inputs, state = size * th.randn(4, 30, 3, generator=generator), th.randn(4, net.state_dim, generator=generator)
    with th.no_grad():
        trace = net.unroll(inputs, state)
    bound = certificate.state_bound(float(inputs.norm(dim=-1).max()), float(state.norm(dim=-1).max()))
    assert float(trace.norm(dim=-1).max()) <= bound * (1 + 1e-5)


def test_the_certificate_is_reported_and_kept_during_training() -> None:
    free, kept = (random_net(0, 0.5, dynamics="dissipative", max_rho=rho) for rho in (None, 0.95))
    assert free.certificate().rho > 1.0
    assert free.certificate().state_bound(1.0) == float("inf")
    optimizer = th.optim.Adam(kept.parameters(), lr=0.1)
    for _ in range(30):
        loss = -kept(th.randn(16, 3))[0].square().mean()
        optimizer.zero_grad()
        loss.backward()
        optimizer.step()
        assert kept.certificate().rho <= 0.95 + 1e-6
    with pytest.raises(ValueError, match="max_rho"):
        random_net(0, dynamics="dissipative", max_rho=0.5)


@pytest.mark.parametrize("dynamics", ["conductance", "dissipative"])
def test_gradients_agree_with_finite_differences(dynamics: str) -> None:
    net = random_net(1, spread=0.3, dynamics=dynamics, sub_steps=2).double()
    names, tensors = zip(*net.named_parameters(), strict=True)
    inputs, state = th.randn(2, 3, 3).double().requires_grad_(), th.randn(2, net.state_dim).double().requires_grad_()
    mask = th.tensor([[1.0, 0.0, 1.0], [1.0, 1.0, 0.0]]).double()

    def run(inputs: th.Tensor, state: th.Tensor, *values: th.Tensor) -> tuple[th.Tensor, th.Tensor]:
        return th.func.functional_call(net, dict(zip(names, values, strict=True)), (inputs, state, mask))

    assert th.autograd.gradcheck(run, (inputs, state, *tensors))


@pytest.mark.parametrize("dynamics", ["conductance", "dissipative"])
def test_gradients_stay_finite_over_a_thousand_steps(dynamics: str) -> None:
    net = random_net(3, dynamics=dynamics)
    inputs = (5 * th.randn(2, 1000, 3)).requires_grad_()
    state = net.initial_state(2).requires_grad_()
    outputs, _ = net(inputs, state)
    outputs.square().sum().backward()
    assert all(bool(th.isfinite(p.grad).all()) for p in (*net.parameters(), inputs, state))
    assert float(inputs.grad.abs().max()) < 1e3


def test_masked_synapses_stay_exactly_zero_and_polarity_is_kept() -> None:
    net = random_net(2)
    optimizer = th.optim.AdamW(net.parameters(), lr=0.05, weight_decay=0.1)
    for _ in range(50):
        loss = (net(th.randn(32, 3))[0] - 1.0).square().mean()
        optimizer.zero_grad()
        loss.backward()
        optimizer.step()
    arrays, n = net.cell.arrays(), net.state_dim
    sensory, recurrent = arrays.from_inputs[:3], arrays.recurrent
    wired = net.wiring.recurrent[: len(recurrent)]
    for matrix, signs in ((sensory, net.wiring.sensory), (recurrent, wired)):
        reversal, conductance = matrix[:, :n].detach().numpy(), matrix[:, n:].detach().numpy()
        np.testing.assert_array_equal(np.sign(reversal), signs)
        np.testing.assert_array_equal(np.sign(conductance), np.abs(signs))
    inter = net.wiring.layer("inter")
    np.testing.assert_array_equal(arrays.current_weight.detach().numpy() != 0, net.wiring.sensory[:, inter] != 0)
    trained = sum(p.numel() for p in net.cell.parameters())
    dense = sensory.numel() + recurrent.numel()
    assert trained < dense, "what the wiring leaves out has no parameter that could get a gradient"


def test_intervals_per_sample_equal_one_at_a_time() -> None:
    net = random_net(4)
    batch = net.state_dim  # a batch of as many samples as neurons is where a wrong broadcast goes unnoticed
    inputs, state, interval = th.randn(batch, 3), th.randn(batch, net.state_dim), 3 * th.rand(batch) + 0.01
    outputs, potentials = net(inputs, state, interval=interval)
    for i in range(batch):
        alone = net(inputs[i : i + 1], state[i : i + 1], interval=interval[i : i + 1])
        th.testing.assert_close(alone[0][0], outputs[i])
        th.testing.assert_close(alone[1][0], potentials[i])
    unit = net(inputs, state, interval=th.ones(batch))[0]
    th.testing.assert_close(unit, net(inputs, state)[0])


def test_time_constants_are_the_decay_of_each_potential() -> None:
    net = random_net(5).double()
    rng = np.random.default_rng(5)
    inputs, state = rng.normal(size=3), rng.normal(size=net.state_dim)
    rate = derivative(net, inputs)
    tau = net.time_constants(th.from_numpy(inputs)[None], th.from_numpy(state)[None])[0].numpy()
    for i in range(net.state_dim):
        step = np.zeros(net.state_dim)
        step[i] = 1e-4
        slope = (rate(0.0, state + step)[i] - rate(0.0, state - step)[i]) / 2e-4
        assert tau[i] == pytest.approx(-1.0 / slope, rel=1e-5)
