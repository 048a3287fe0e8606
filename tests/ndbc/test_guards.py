"""What a network survives and what it refuses: broken states, empty batches, wrong intervals, foreign weights."""

from __future__ import annotations

import copy
from collections.abc import Callable

import numpy as np
import pytest
import torch as th
from hypothesis import given, settings
from hypothesis import strategies as st
from random_nets import FORMS, SEEDS, random_net

from sb3_tbc import NDBCNet, NDBCWiring
from sb3_tbc.ndbc.frozen import FrozenNDBC

KINDS = [{"dynamics": "dissipative"}, *FORMS]


@given(SEEDS, st.sampled_from(KINDS), st.integers(0, 4))
@settings(max_examples=30, deadline=None)
def test_a_reset_heals_a_state_that_is_not_a_number(seed: int, kind: dict[str, object], broken: int) -> None:
    net = random_net(seed, **kind)
    generator = th.Generator().manual_seed(seed)
    inputs, mask = th.randn(3, 5, 3, generator=generator), th.ones(3, 5)
    state = th.randn(3, net.state_dim, generator=generator)
    state[1], mask[1, 0] = float("nan"), 0.0
    outputs, last = net(inputs, state, mask)
    outputs.sum().backward()
    assert th.isfinite(outputs).all()
    assert th.isfinite(last).all()
    assert all(th.isfinite(p.grad).all() for p in net.parameters())
    th.testing.assert_close(net(inputs[:, 0], state, mask[:, 0])[0], outputs[:, 0])
    inputs[2, broken], mask[2, min(broken + 1, 4)] = float("inf") * 0.0, 0.0
    healed = net.unroll(inputs, state, mask)[2, broken + 1 :]
    assert th.isfinite(healed).all()


@given(SEEDS, st.sampled_from(KINDS), st.integers(1, 6))
@settings(max_examples=30, deadline=None)
def test_intervals_of_zero_leave_the_state_and_negative_ones_are_refused(
    seed: int, kind: dict[str, object], sub_steps: int
) -> None:
    net = random_net(seed, sub_steps=sub_steps, **kind)
    inputs, state = th.randn(4, 3), th.randn(4, net.state_dim).requires_grad_()
    interval = th.tensor([0.0, 1.0, 0.0, 0.5])
    later = net(inputs, state, interval=interval)[1]
    assert th.equal(later[[0, 2]], state[[0, 2]])
    th.testing.assert_close(later[1], net(inputs, state)[1][1])
    later.sum().backward()
    assert th.isfinite(state.grad).all()
    for wrong in (-1e-6, float("nan")):
        with pytest.raises(ValueError, match="interval must not be negative"):
            net(inputs, state, interval=th.tensor([1.0, wrong, 1.0, 1.0]))


@pytest.mark.parametrize("kind", KINDS)
def test_second_derivatives_are_right_for_steps_and_refused_for_sequences(kind: dict[str, object]) -> None:
    net = random_net(0, spread=0.3, **kind).double()
    x = th.randn(1, 1, 3, dtype=th.double, generator=th.Generator().manual_seed(0))
    hessian = th.autograd.functional.hessian(lambda u: net(u[:, 0])[0].sum(), x).reshape(3, 3)
    delta = 1e-5
    for i in range(3):
        step = th.zeros_like(x)
        step[0, 0, i] = delta
        ends = [th.autograd.functional.jacobian(lambda u: net(u[:, 0])[0].sum(), y) for y in (x + step, x - step)]
        th.testing.assert_close(hessian[i], (ends[0] - ends[1]).flatten() / (2 * delta), atol=1e-6, rtol=1e-4)
    if "dynamics" in kind:
        whole = th.autograd.functional.hessian(lambda u: net(u)[0].sum(), x).reshape(3, 3)
        th.testing.assert_close(whole, hessian)
        return
    for loss in (lambda u: net(u)[0].sum(), lambda u: net(u)[0].square().sum()):
        with pytest.raises(RuntimeError, match="no second derivatives of sequences"):
            th.autograd.functional.hessian(loss, x)


@pytest.mark.parametrize("kind", KINDS)
def test_function_transforms_work_on_steps(kind: dict[str, object]) -> None:
    net = random_net(0, **kind)
    x = th.randn(5, 3)
    th.testing.assert_close(th.func.vmap(lambda u: net(u[None])[0][0])(x), net(x)[0], atol=1e-5, rtol=1e-5)
    jacobian = th.func.vmap(th.func.jacrev(lambda u: net(u[None])[0][0]))(x)
    assert jacobian.shape == (5, 2, 3)
    if "dynamics" not in kind:
        with pytest.raises(RuntimeError, match="functorch"):
            th.func.jacrev(lambda u: net(u)[0])(x[:, None])


@pytest.mark.parametrize("kind", KINDS)
def test_batches_may_be_empty(kind: dict[str, object]) -> None:
    net = random_net(0, **kind)
    outputs, state = net(th.zeros(0, 3))
    assert outputs.shape == (0, 2)
    assert state.shape == (0, net.state_dim)
    outputs, state = net(th.zeros(0, 4, 3), mask=th.ones(0, 4))
    assert outputs.shape == (0, 4, 2)
    outputs.sum().backward()
    outputs, state = net(th.zeros(2, 0, 3), 0.3 * th.ones(2, net.state_dim))
    assert outputs.shape == (2, 0, 2)
    th.testing.assert_close(state, 0.3 * th.ones(2, net.state_dim))
    frozen = FrozenNDBC(net)(np.zeros((0, 3), np.float32), np.zeros((0, net.state_dim), np.float32))
    assert frozen[0].shape == (0, 2)


@pytest.mark.parametrize("kind", KINDS)
def test_weights_of_another_wiring_are_refused(kind: dict[str, object]) -> None:
    net, other = random_net(0, **kind), random_net(7, **kind)
    before = copy.deepcopy(other.state_dict())
    with pytest.raises(RuntimeError, match=r"another wiring|size mismatch"):
        other.load_state_dict(net.state_dict())
    assert all(th.equal(before[name], value) for name, value in other.state_dict().items()), "nothing was changed"
    same = random_net(0, spread=0.1, **kind)
    same.load_state_dict(net.state_dict())
    th.testing.assert_close(same(th.ones(1, 3))[0], net(th.ones(1, 3))[0])


WIRING = NDBCWiring(3, 4, 4, 2, 2, 2, 1, 2)


@pytest.mark.parametrize("name", ["inputs", "state", "mask", "interval"])
@pytest.mark.parametrize("broken", [lambda x: x.numpy(), lambda x: x.tolist(), lambda x: x.double(), lambda x: x * 1j])
def test_what_is_no_tensor_of_the_networks_type_is_told(name: str, broken: Callable[[th.Tensor], object]) -> None:
    net = NDBCNet(3, 2, WIRING)
    parts = {"inputs": th.zeros(2, 3), "state": net.initial_state(2), "mask": th.ones(2), "interval": th.ones(2)}
    net(**parts)
    wrong = broken(parts[name])
    if name == "mask" and isinstance(wrong, th.Tensor):
        net(**{**parts, name: wrong})  # only whether it is zero counts
        return
    with pytest.raises(TypeError, match=rf"{name} (must be a tensor, got|is of torch\.\w+, the network of)"):
        net(**{**parts, name: wrong})


@pytest.mark.parametrize("seed", [-1, 1.5, "a", True])
def test_seeds_that_are_none(seed: object) -> None:
    for make in (lambda **k: NDBCWiring(3, 4, 4, 2, 2, 2, 1, 2, **k), lambda **k: NDBCNet(3, 2, WIRING, **k)):
        with pytest.raises(ValueError, match="seed must be a whole number of at least 0"):
            make(seed=seed)


def test_a_truth_value_is_no_size() -> None:
    with pytest.raises(ValueError, match="inter must be a whole number"):
        NDBCWiring(3, True, 4, 2, 2, 2, 1, 2)
    with pytest.raises(ValueError, match="motor_fanin must be a whole number"):
        NDBCWiring(3, 4, 4, 2, 2, 2, 1, True)
