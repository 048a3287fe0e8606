"""What is proved of the dynamics, checked over random weights, inputs and steps."""

from __future__ import annotations

import math

import numpy as np
import pytest
import torch as th
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.typing import NDArray
from random_nets import FORM, FORMS, SEEDS, random_net
from scipy.integrate import solve_ivp

from sb3_tbc.errors import NonFiniteError
from sb3_tbc.ndbc.closed_form import ClosedFormNDBC
from sb3_tbc.ndbc.diagnostics import check_finite
from sb3_tbc.ndbc.frozen import FrozenNDBC
from sb3_tbc.ndbc.network import DYNAMICS, NDBCNet
from sb3_tbc.ndbc.stepping import StepRule, recurrent_block


def derivative(net: NDBCNet, inputs: NDArray[np.float64]) -> object:
    """dV/dt of one sample, written synapse by synapse from the equation, not from the cell's matrices."""
    cell, wiring = net.cell, net.wiring
    value = {name: v.detach().numpy() for name, v in cell.values()._asdict().items()}
    fixed = {name: p.detach().numpy() for name, p in cell.named_parameters()}
    u = inputs * net.input_gain.numpy()
    lean = net.synapses == "lean"
    current = fixed["current_bias"].copy()
    wired = [(True, i, j, wiring.sensory[i, j]) for i, j in np.argwhere(wiring.sensory)]
    for k, (_, i, j, _) in enumerate(wired):
        current[j] += fixed["current_weight"][k] * u[i]
    synapses = [] if lean else wired
    synapses += [(False, i, j, wiring.recurrent[i, j]) for i, j in np.argwhere(wiring.recurrent)]
    if lean:
        value["conductance"], value["reversal"] = np.abs(fixed["synapse"]), np.ones(len(synapses))
        synapses = [(*s[:3], np.sign(x)) for s, x in zip(synapses, fixed["synapse"], strict=True)]
    else:
        sensed = 1 / (1 + np.exp(fixed["sensory_threshold"] - value["sensory_gain"] * u))

    def rate(_: float, potentials: NDArray[np.float64]) -> NDArray[np.float64]:
        flow = value["leak"] * (fixed["leak_potential"] - potentials)
        m = len(current)
        flow[:m] += value["input_conductance"] * (np.tanh(current) - potentials[:m])
        for k, (sensory, i, j, sign) in enumerate(synapses):
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


@given(SEEDS, FORM, st.integers(1, 6), st.floats(0.01, 100.0), st.floats(0.1, 10.0))
@settings(max_examples=100, deadline=None)
def test_potentials_stay_in_their_bound(
    seed: int, form: dict[str, object], sub_steps: int, interval: float, size: float
) -> None:
    net = random_net(seed, spread=2.0, sub_steps=sub_steps, **form)
    generator = th.Generator().manual_seed(seed)
    state = size * th.randn(8, net.state_dim, generator=generator)
    inputs = 10 * size * th.randn(8, 5, 3, generator=generator)
    low, high = net.cell.bounds(state.min(dim=0).values, state.max(dim=0).values)
    with th.no_grad():
        trace = net.unroll(inputs, state, interval=th.full((8, 5), interval))
    slack = 1e-5 * (1 + th.maximum(low.abs(), high.abs()))
    assert (trace >= low - slack).all()
    assert (trace <= high + slack).all()


@pytest.mark.parametrize("form", FORMS)
def test_the_bound_is_reached_by_what_pulls_there(form: dict[str, object]) -> None:
    net = random_net(0, spread=0.0, **form)
    low, high = net.cell.bounds()
    with th.no_grad():
        net.cell.current_bias[:] = 40.0
        net.cell.raw_input_conductance[:] = 1e4
        pulled = net(th.zeros(1, 3))[1][0, : net.cell.n_driven]
    assert (low <= -1.0)[: net.cell.n_driven].all()
    assert (high >= 1.0)[: net.cell.n_driven].all()
    assert (pulled > 0.99).all(), "the input current reaches every layer of sensory_to"


@given(SEEDS, FORM)
@settings(max_examples=12, deadline=None)
def test_halving_the_step_converges_at_first_order(seed: int, form: dict[str, object]) -> None:
    net = random_net(seed, spread=0.5, **form).double()
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
    assert abs(orders[-1] - 1.0) < 0.15
    assert np.abs(orders - 1.0).max() < 0.5  # the coarsest steps may still be far from the limit


@given(SEEDS, FORM, st.floats(0.2, 3.0), st.floats(0.0, 2.0), st.floats(0.1, 3.0))
@settings(max_examples=60, deadline=None)
def test_closed_form_error_bound_holds(
    seed: int, form: dict[str, object], size: float, spread: float, duration: float
) -> None:
    net = random_net(seed, spread=spread, **form).double()
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


@given(SEEDS, st.sampled_from(DYNAMICS), st.integers(1, 3))
@settings(max_examples=8, deadline=None)
def test_gradients_agree_with_finite_differences(seed: int, dynamics: str, sub_steps: int) -> None:
    net = random_net(seed, spread=0.3, dynamics=dynamics, sub_steps=sub_steps).double()
    names, tensors = zip(*net.named_parameters(), strict=True)
    generator = th.Generator().manual_seed(seed)
    inputs, state = (
        th.randn(shape, generator=generator).double().requires_grad_() for shape in ((2, 3, 3), (2, net.state_dim))
    )
    mask = (th.rand(2, 3, generator=generator) > 0.4).double()

    def run(inputs: th.Tensor, state: th.Tensor, *values: th.Tensor) -> tuple[th.Tensor, th.Tensor]:
        return th.func.functional_call(net, dict(zip(names, values, strict=True)), (inputs, state, mask))

    assert th.autograd.gradcheck(run, (inputs, state, *tensors))


@given(SEEDS, st.sampled_from(DYNAMICS), st.floats(0.1, 20.0))
@settings(max_examples=8, deadline=None)
def test_gradients_stay_finite_over_a_thousand_steps(seed: int, dynamics: str, size: float) -> None:
    net = random_net(seed, dynamics=dynamics)
    inputs = (size * th.randn(2, 1000, 3, generator=th.Generator().manual_seed(seed))).requires_grad_()
    state = net.initial_state(2).requires_grad_()
    outputs, _ = net(inputs, state)
    outputs.square().sum().backward()
    assert all(bool(th.isfinite(p.grad).all()) for p in (*net.parameters(), inputs, state))


def train(net: NDBCNet, updates: int, rate: float) -> None:
    optimizer = th.optim.AdamW(net.parameters(), lr=rate, weight_decay=0.1)
    for _ in range(updates):
        loss = (net(th.randn(32, 3))[0] - 1.0).square().mean()
        optimizer.zero_grad()
        loss.backward()
        optimizer.step()


@given(SEEDS, st.integers(0, 40), st.floats(1e-3, 0.1))
@settings(max_examples=15, deadline=None)
def test_masked_synapses_stay_exactly_zero_and_polarity_is_kept(seed: int, updates: int, rate: float) -> None:
    net = random_net(seed)
    train(net, updates, rate)
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


@given(SEEDS, st.integers(0, 40), st.floats(1e-3, 0.1), st.booleans())
@settings(max_examples=15, deadline=None)
def test_a_lean_synapse_is_one_number_and_missing_ones_stay_zero(
    seed: int, updates: int, rate: float, reflexes: bool
) -> None:
    layers = ("inter", "command", "motor") if reflexes else ("inter",)
    net = random_net(seed, synapses="lean", sensory_to=layers)
    train(net, updates, rate)
    arrays, n, wiring = net.cell.arrays(), net.state_dim, net.wiring
    pulled, conductance = arrays.recurrent.detach().split(n, dim=1)
    assert th.equal(pulled.abs(), conductance), "a reversal potential of +1 or -1"
    np.testing.assert_array_equal(conductance.numpy() != 0, wiring.recurrent[: len(conductance)] != 0)
    np.testing.assert_array_equal(
        arrays.current_weight.detach().numpy() != 0, wiring.sensory[:, : wiring.n_driven] != 0
    )
    per_pair = {"synapse": np.count_nonzero(wiring.recurrent), "current_weight": np.count_nonzero(wiring.sensory)}
    assert {name: net.cell.get_parameter(name).numel() for name in per_pair} == per_pair
    rest = {name for name, p in net.cell.named_parameters() if p.numel() > n}
    assert rest <= set(per_pair), "everything else belongs to a neuron"
    sensory, recurrent = net.cell.signs(wiring)
    np.testing.assert_array_equal(np.sign(pulled.numpy()), recurrent[: len(pulled)])
    np.testing.assert_array_equal(np.sign(arrays.current_weight.detach().numpy()), sensory[:, : wiring.n_driven])


@given(SEEDS, FORM, st.integers(1, 6))
@settings(max_examples=40, deadline=None)
def test_all_forms_of_a_network_compute_the_same(seed: int, form: dict[str, object], sub_steps: int) -> None:
    net = random_net(seed, spread=0.5, sub_steps=sub_steps, **form)
    frozen, generator = FrozenNDBC(net), th.Generator().manual_seed(seed)
    inputs, state = th.randn(4, 5, 3, generator=generator), th.randn(4, net.state_dim, generator=generator)
    outputs, last = net(inputs, state)
    outputs.sum().backward()
    gradients = [p.grad.clone() for p in net.parameters()]
    net.zero_grad()
    stepped, potentials, numpy_state = 0.0, state, state.numpy()
    for t in range(5):
        output, potentials = net(inputs[:, t], potentials)
        numpy_output, numpy_state = frozen(inputs[:, t].numpy(), numpy_state)
        th.testing.assert_close(output, outputs[:, t], atol=1e-4, rtol=1e-4)
        np.testing.assert_allclose(numpy_output, output.detach().numpy(), atol=1e-4)
        stepped = stepped + output.sum()
    th.testing.assert_close(potentials, last, atol=1e-4, rtol=1e-4)
    stepped.backward()
    for name, gradient in zip(dict(net.named_parameters()), gradients, strict=True):
        th.testing.assert_close(gradient, net.get_parameter(name).grad, atol=2e-3, rtol=2e-3)


def test_k_of_the_step_rule_travels_with_the_weights() -> None:
    rule = {"eta": 3.0, "refresh_every": 10, "power_iterations": 1}
    net, other = (random_net(seed, spread, adaptive_step=rule) for seed, spread in ((1, 0.5), (1, 0.0)))
    net.after_update(7)
    net.sub_steps = 5  # whatever the power iteration had come to when the weights were saved
    other.load_state_dict(net.state_dict())
    assert other.sub_steps == 5
    assert [n.after_update(2) for n in (net, other)] == [False, False]
    assert net.after_update(1) == other.after_update(1)
    assert net.sub_steps == other.sub_steps
    older = {name: value for name, value in net.state_dict().items() if not name.startswith("step_")}
    other.load_state_dict(older)
    assert 3 <= other.sub_steps <= 6


@given(SEEDS, st.sampled_from(DYNAMICS), st.integers(1, 8), st.integers(1, 6))
@settings(max_examples=30, deadline=None)
def test_resets_per_sample_equal_one_at_a_time(seed: int, dynamics: str, steps: int, sub_steps: int) -> None:
    net = random_net(seed, dynamics=dynamics, sub_steps=sub_steps)
    generator = th.Generator().manual_seed(seed)
    inputs, state = th.randn(4, steps, 3, generator=generator), th.randn(4, net.state_dim, generator=generator)
    mask = (th.rand(4, steps, generator=generator) > 0.3).float()
    outputs, last = net(inputs, state, mask)
    for i in range(4):
        potentials = state[i : i + 1]
        for t in range(steps):
            potentials = potentials if mask[i, t] else net.initial_state(1)
            output, potentials = net(inputs[i : i + 1, t], potentials)
            th.testing.assert_close(output[0], outputs[i, t])
        th.testing.assert_close(potentials[0], last[i])


RULES = st.builds(
    lambda eta, shortest, share, check: StepRule(
        eta=eta, delta_min=shortest, delta_max=shortest + share * (1.0 - shortest), half_step_check=check
    ),
    st.floats(0.1, 50.0), st.floats(0.05, 1.0), st.floats(0.0, 1.0), st.booleans(),
)  # fmt: skip


@given(RULES, st.floats(0.0, 1e6), st.floats(1.0, 100.0))
def test_the_step_rule_is_bounded_and_shortens_steps_of_steeper_networks(
    rule: StepRule, lipschitz: float, steeper: float
) -> None:
    sub_steps = rule.sub_steps(lipschitz)
    assert math.ceil(1.0 / rule.delta_max - 1e-9) <= sub_steps <= rule.max_sub_steps == rule.sub_steps(1e12)
    assert sub_steps <= rule.sub_steps(steeper * lipschitz)
    delta = rule.eta / (lipschitz + rule.epsilon)
    if rule.delta_min < delta < rule.delta_max:
        assert sub_steps - 1 < 1.0 / delta + 1e-9
        assert sub_steps >= 1.0 / delta - 1e-6


@given(SEEDS, st.floats(0.0, 3.0), st.floats(0.1, 20.0))
@settings(max_examples=40, deadline=None)
def test_k_follows_the_spectral_norm_of_the_recurrent_block(seed: int, spread: float, eta: float) -> None:
    net = random_net(seed, spread=spread, adaptive_step={"eta": eta, "refresh_every": 5, "power_iterations": 300})
    assert net.step_rule is not None
    assert 3 <= net.sub_steps <= net.step_rule.max_sub_steps == 6
    block = recurrent_block(net.cell.arrays())
    exact_norm = float(th.linalg.matrix_norm(block.detach().double(), 2))
    assert not net.after_update(4)
    net.after_update(1)
    assert net.lipschitz.evaluate(net.cell, 300) <= exact_norm * (1 + 1e-4)
    around = {net.step_rule.sub_steps(factor * exact_norm) for factor in (0.98, 1.0, 1.0001)}
    assert net.sub_steps in around
    plain = random_net(seed, spread=spread, sub_steps=net.sub_steps)
    inputs = th.randn(4, 3, generator=th.Generator().manual_seed(seed))
    th.testing.assert_close(net(inputs)[1], plain(inputs)[1])


@given(SEEDS, st.sampled_from(DYNAMICS), st.floats(0.0, 2.0), st.floats(0.0, 2.0), st.floats(0.05, 0.34))
@settings(max_examples=40, deadline=None)
def test_half_step_check_refines_exactly_the_samples_that_move_far(
    seed: int, dynamics: str, relative: float, absolute: float, shortest: float
) -> None:
    check = {"half_step_check": True, "relative_tolerance": relative, "absolute_tolerance": absolute, "eta": 1e9,
             "delta_min": shortest, "delta_max": max(shortest, 1 / 3)}  # fmt: skip
    net = random_net(seed, dynamics=dynamics, adaptive_step=check)
    rule = net.step_rule
    assert rule is not None
    generator = th.Generator().manual_seed(seed)
    inputs, state = th.randn(8, 3, generator=generator), 2 * th.randn(8, net.state_dim, generator=generator)
    result = net(inputs, state)[1]
    for i in range(8):
        sub_steps = net.sub_steps
        while sub_steps < rule.max_sub_steps and moves_too_far(net, rule, inputs[i], state[i], sub_steps):
            sub_steps = min(2 * sub_steps, rule.max_sub_steps)
        plain = random_net(seed, dynamics=dynamics, sub_steps=sub_steps)
        th.testing.assert_close(plain(inputs[i : i + 1], state[i : i + 1])[1][0], result[i])


def moves_too_far(net: NDBCNet, rule: StepRule, inputs: th.Tensor, state: th.Tensor, sub_steps: int) -> bool:
    """Whether some sub-step moves by more than the tolerances allow."""
    arrays = net.cell.arrays()
    step_terms = net.cell.step_terms(arrays, 1.0 / sub_steps)
    input_terms, current = net.cell.input_terms(inputs[None] * net.input_gain, arrays, step_terms), state[None]
    for _ in range(sub_steps):
        following = net.cell.step(current, input_terms, arrays, step_terms)
        if (following - current).norm() > rule.relative_tolerance * current.norm() + rule.absolute_tolerance:
            return True
        current = following
    return False


@given(SEEDS, st.sampled_from([float("nan"), float("inf"), -float("inf")]), st.integers(0, 4), st.data())
@settings(max_examples=40, deadline=None)
def test_a_non_finite_value_is_named(seed: int, value: float, step: int, data: st.DataObject) -> None:
    net = random_net(seed)
    inputs, first = th.randn(2, 5, 3), data.draw(st.integers(0, 1000))
    sample, unit = data.draw(st.integers(0, 1)), data.draw(st.integers(0, net.state_dim - 1))
    check_finite(net.wiring, inputs, net.unroll(inputs), net(inputs)[0])
    trace = net.unroll(inputs).detach()
    trace[sample, step:, unit] = value
    layer = net.wiring.layer_of(unit)
    place = f"high level, {layer} layer, step {first + step}: unit {unit - net.wiring.layer(layer).start} "
    with pytest.raises(NonFiniteError, match=f"{place}of sample {sample} is {value}"):
        check_finite(net.wiring, inputs, trace, level="high", step=first)
    inputs[sample, step, 1] = float("nan")
    with pytest.raises(NonFiniteError, match=f"low level, sensory layer, step {step}: unit 1 of sample {sample}"):
        check_finite(net.wiring, inputs, net.unroll(inputs), net(inputs)[0])


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
