"""The dissipative cell against equations 20 and 21, written out synapse by synapse in NumPy."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
import torch as th
from hypothesis import given, settings
from numpy.typing import NDArray
from random_nets import SEEDS, random_net

from sb3_tbc.ndbc.dissipative import DissipativeCell
from sb3_tbc.ndbc.network import NDBCNet


def by_hand(net: NDBCNet) -> tuple[NDArray[np.float64], NDArray[np.float64], NDArray[np.float64]]:
    """W ``(I, N)``, U ``(N, N)`` and K ``(N,)`` from the free parameters; synapses lead from row to column."""
    cell, wiring = net.cell, net.wiring
    assert isinstance(cell, DissipativeCell)
    positive = {n: np.logaddexp(0, p.detach().double().numpy()) for n, p in cell.named_parameters() if n != "bias"}
    weight, recurrent = np.zeros(wiring.sensory.shape), np.zeros(wiring.recurrent.shape)
    for k, (i, j) in enumerate(np.argwhere(wiring.sensory)):
        weight[i, j] = wiring.sensory[i, j] * positive["raw_input_weight"][k]
    for k, (i, j) in enumerate(np.argwhere(wiring.recurrent)):
        recurrent[i, j] = wiring.recurrent[i, j] * positive["raw_weight"][k]
    return weight, recurrent, positive["raw_damping"] + cell.min_damping


@given(SEEDS)
@settings(max_examples=20, deadline=None)
def test_one_step_is_equation_20(seed: int) -> None:
    net = random_net(seed, dynamics="dissipative", sub_steps=1)
    weight, recurrent, damping = by_hand(net)
    rng = np.random.default_rng(seed)
    inputs, state = rng.normal(size=3), rng.normal(size=net.state_dim)
    bias = net.cell.bias.detach().numpy()  # type: ignore[union-attr]
    driven = weight.T @ (inputs * net.input_gain.numpy()) + recurrent.T @ state + bias  # what arrives at each neuron
    expected = (state + np.tanh(driven)) / (1.0 + damping)
    single = (th.as_tensor(x[None], dtype=th.float32) for x in (inputs, state))
    np.testing.assert_allclose(net(*single)[1][0].detach().numpy(), expected, atol=1e-5)


@given(SEEDS)
@settings(max_examples=20, deadline=None)
def test_neurons_hear_their_presynaptic_ones_only(seed: int) -> None:
    """Where one neuron influences another, by differentiation, the wiring has a synapse of that sign."""
    net = random_net(seed, dynamics="dissipative", sub_steps=1)
    state = 0.1 * th.randn(net.state_dim, generator=th.Generator().manual_seed(seed))
    influence = th.autograd.functional.jacobian(lambda x: net(th.zeros(1, 3), x[None])[1][0], state).numpy().T
    np.fill_diagonal(influence, 0.0)
    np.testing.assert_array_equal(np.sign(influence), net.wiring.recurrent)


@pytest.mark.parametrize("rule", [{}, {"adaptive_step": {"half_step_check": True}}])
def test_a_limit_of_rho_holds_for_each_length_of_step(rule: dict[str, object]) -> None:
    """A sample's step does not depend on the steps beside it; a short one may not use the room of a long one."""
    net = random_net(0, 3.0, dynamics="dissipative", max_rho=0.97, **rule)
    lengths = th.tensor([0.0, 0.5, 1.0, 2.0])
    inputs, state = th.zeros(4, 3), th.linspace(-1.0, 1.0, 4 * net.state_dim).view(4, -1)
    together = net(inputs, state, interval=lengths)[1]
    alone = [net(inputs[i : i + 1], state[i : i + 1], interval=lengths[i : i + 1])[1] for i in range(4)]
    th.testing.assert_close(together, th.cat(alone), rtol=0.0, atol=1e-6)


def test_a_limit_of_rho_leaves_room_with_the_most_sub_steps_that_adaptive_step_may_take() -> None:
    """Silent synapses get no gradient; they were so for good where K grew from 3, which leaves room, to 6."""
    with pytest.raises(ValueError, match=r"with adaptive_step, up to 6 sub-steps, .* it must exceed 0\.923"):
        random_net(0, dynamics="dissipative", max_rho=0.9, adaptive_step=True)
    random_net(0, dynamics="dissipative", max_rho=0.9, adaptive_step={"delta_min": 1 / 3})
    net = random_net(0, 3.0, dynamics="dissipative", max_rho=0.93, adaptive_step=True)
    cell: Any = net.cell
    with th.no_grad():
        cell.raw_damping.fill_(-20.0)  # the smallest damping there is
        cell.raw_weight.fill_(10.0)
    net.refresh_step()
    arrays = cell.arrays()
    assert net.sub_steps == 6
    assert float(cell.enforced(arrays, cell.step_terms(arrays, 1 / 6)).abs().max()) > 0.0
    net(th.ones(1, 4, 3))[0].sum().backward()
    assert float(cell.raw_damping.grad.abs().sum()) > 0.0


@pytest.mark.parametrize("sub_steps", [1, 3])
@given(seed=SEEDS)
@settings(max_examples=20, deadline=None)
def test_the_certificate_is_equation_21(seed: int, sub_steps: int) -> None:
    net = random_net(seed, dynamics="dissipative", sub_steps=sub_steps)
    weight, recurrent, damping = by_hand(net)
    eta, certificate = 1.0 / sub_steps, net.certificate()
    shrink = 1.0 / (1.0 + eta * damping.min())
    assert certificate.rho == pytest.approx(shrink * (1.0 + eta * np.linalg.norm(recurrent, 2)), rel=1e-5)
    assert certificate.c == pytest.approx(shrink * eta * np.linalg.norm(weight, 2), rel=1e-5)
    bias = net.cell.bias.detach().numpy()  # type: ignore[union-attr]
    assert certificate.d == pytest.approx(shrink * eta * np.linalg.norm(bias), rel=1e-5)
    bound = certificate.state_bound(2.0, 0.5)
    assert bound == (
        np.inf if certificate.rho >= 1 else max(0.5, (certificate.c * 2 + certificate.d) / (1 - certificate.rho))
    )


@pytest.mark.parametrize("scale", [0.05, 1.0, 20.0])
@given(seed=SEEDS)
@settings(max_examples=10, deadline=None)
def test_the_certificate_holds_for_inputs_before_they_are_scaled(seed: int, scale: float) -> None:
    net = random_net(seed, dynamics="dissipative", max_rho=0.95, input_scale=[scale] * 3)
    with th.no_grad():
        net.cell.raw_input_weight -= 4.0  # type: ignore[union-attr, operator]  # weak, so that inputs alone bound
        net.cell.bias.zero_()  # type: ignore[union-attr, operator]
    inputs = 0.3 * th.randn(1, 3, generator=th.Generator().manual_seed(seed))
    bound, state, largest = net.certificate().state_bound(float(inputs.norm())), net.initial_state(1), 0.0
    for _ in range(50):
        state = net(inputs, state)[1]
        largest = max(largest, float(state.norm()))
    assert largest <= bound * (1 + 1e-6)
