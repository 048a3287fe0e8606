"""NDBCNet: shapes, memory, and agreement of its several forms."""

from __future__ import annotations

import numpy as np
import pytest
import torch as th
from torch.fx.experimental.proxy_tensor import make_fx

from sb3_tbc.errors import NonFiniteError
from sb3_tbc.ndbc.diagnostics import check_finite, count_parameters
from sb3_tbc.ndbc.frozen import FrozenNDBC
from sb3_tbc.ndbc.network import NDBCNet
from sb3_tbc.ndbc.stepping import recurrent_block
from sb3_tbc.ndbc.wiring import NDBCWiring


def small_net(seed: int = 0, n_outputs: int = 2, **kwargs: object) -> NDBCNet:
    wiring = NDBCWiring(6, inter=6, command=6, motor=1, sensory_fanout=3, inter_fanout=4,
                        recurrent_command_synapses=1, motor_fanin=4, seed=seed)  # fmt: skip
    return NDBCNet(6, n_outputs, wiring, seed=seed, **kwargs)


def test_sequence_equals_steps_and_resets_equal_fresh_runs() -> None:
    net = small_net()
    inputs = th.randn(5, 7, 6)
    mask = (th.rand(5, 7) > 0.3).float()
    outputs, last = net(inputs, mask=mask)
    state = net.initial_state(5)
    for t in range(7):
        output, state = net(inputs[:, t], state, mask[:, t])
        th.testing.assert_close(output, outputs[:, t])
    th.testing.assert_close(state, last)
    for i in range(5):
        starts = [0, *[t for t in range(7) if mask[i, t] == 0]]
        for start, stop in zip(starts, [*starts[1:], 7], strict=True):
            if stop > start:
                th.testing.assert_close(net(inputs[i : i + 1, start:stop])[0][0], outputs[i, start:stop])


def test_frozen_equals_torch() -> None:
    net = small_net(input_scale=[1.0, 2.0, 8.0, 1.0, 1.0, 0.5])
    frozen = FrozenNDBC(net)
    inputs, state = (
        np.random.default_rng(0).normal(size=(2, 3, 6)).astype(np.float32),
        np.zeros((3, net.state_dim), np.float32),
    )
    torch_state = th.from_numpy(state)
    for x in inputs:
        output, state = frozen(x, state)
        torch_output, torch_state = net(th.from_numpy(x), torch_state)
        np.testing.assert_allclose(output, torch_output.detach().numpy(), atol=1e-5)
        np.testing.assert_allclose(state, torch_state.detach().numpy(), atol=1e-5)
    assert output.dtype == np.float32


def test_traceable_with_functional_call() -> None:
    net = small_net()
    parameters = {name: p.detach().clone().requires_grad_() for name, p in net.named_parameters()}

    def gradients(values: dict[str, th.Tensor], x: th.Tensor, state: th.Tensor) -> list[th.Tensor]:
        outputs, _ = th.func.functional_call(net, values, (x, state))
        return list(th.autograd.grad(outputs.square().mean(), list(values.values())))

    x, state = th.randn(8, 6), net.initial_state(8)
    traced = make_fx(gradients)(parameters, x, state)
    for ours, reference in zip(traced(parameters, x, state), gradients(parameters, x, state), strict=True):
        th.testing.assert_close(ours, reference)
    assert all(g.abs().sum() > 0 for g in gradients(parameters, x, state))


def test_step_rule_chooses_sub_steps_from_the_lipschitz_proxy() -> None:
    net = small_net(adaptive_step={"refresh_every": 10, "power_iterations": 200})
    exact = th.linalg.matrix_norm(recurrent_block(net.cell.arrays()), 2).item()
    assert net.lipschitz.evaluate(net.cell, 200) == pytest.approx(exact, rel=1e-3)
    assert net.sub_steps == net.step_rule.sub_steps(exact)
    with th.no_grad():
        net.cell.raw_gain += 20.0
    assert not net.after_update(9), "the proxy is refreshed every ten updates only"
    assert net.after_update(1)
    assert net.sub_steps == net.step_rule.max_sub_steps == 6
    with th.no_grad():
        net.cell.raw_gain -= 40.0
    assert net.after_update(10)
    assert net.sub_steps == 3
    with pytest.raises(ValueError, match="delta_min"):
        small_net(adaptive_step={"delta_min": 0.5, "delta_max": 0.2})


def test_half_step_check_splits_only_the_samples_that_move_far() -> None:
    check = {"half_step_check": True, "absolute_tolerance": 2.0, "relative_tolerance": 0.0, "eta": 1e6}
    checked, plain = small_net(adaptive_step=check), small_net()
    inputs, state = th.zeros(4, 6), th.zeros(4, plain.state_dim)
    state[2:] = 3.0  # far from rest: the first sub-step is long
    expected = plain(inputs, state)[1]
    plain.sub_steps = 6
    finer = plain(inputs, state)[1]
    result = checked(inputs, state)[1]
    th.testing.assert_close(result, th.cat([expected[:2], finer[2:]]))
    th.testing.assert_close(checked(inputs.unsqueeze(1), state)[1], result)
    with pytest.raises(ValueError, match="half_step_check"):
        FrozenNDBC(checked)


def test_non_finite_values_are_named() -> None:
    net = small_net()
    inputs = th.randn(3, 5, 6)
    inputs[1, 2, 0] = float("nan")
    trace = net.unroll(inputs)
    with pytest.raises(NonFiniteError, match=r"low level, sensory layer, step 102: unit 0 of sample 1 is nan"):
        check_finite(net.wiring, inputs, trace, net.read(trace), level="low", step=100)
    with pytest.raises(NonFiniteError, match=r"low level, inter layer, step 2:"):
        check_finite(net.wiring, state=trace)
    check_finite(net.wiring, inputs[0], trace[0], net.read(trace[0]))


def test_dissipative_frozen_equals_torch() -> None:
    net = small_net(dynamics="dissipative", max_rho=0.95)
    x, state = np.random.default_rng(0).normal(size=(3, 6)).astype(np.float32), net.initial_state(3).numpy()
    outputs, potentials = FrozenNDBC(net)(x, state)
    reference = net(th.from_numpy(x))
    np.testing.assert_allclose(outputs, reference[0].detach().numpy(), atol=1e-5)
    np.testing.assert_allclose(potentials, reference[1].detach().numpy(), atol=1e-5)


def test_parameter_count_against_the_mlp_it_replaces() -> None:
    count = count_parameters(small_net(), hidden=(32, 32))
    assert count.mlp == 6 * 32 + 32 + 32 * 32 + 32 + 32 * 2 + 2
    assert count.ndbc == sum(p.numel() for p in small_net().parameters())
    assert count.ratio < 0.25


def test_outputs_start_near_zero_mean() -> None:
    outputs = small_net(n_outputs=4)(2 * th.rand(4096, 6) - 1)[0]
    assert float(outputs.mean(dim=0).abs().max()) < 0.05
    assert float(outputs.std(dim=0).max()) < 0.5


@pytest.mark.parametrize(
    ("kwargs", "named"),
    [({"sub_steps": 0}, "sub_steps"), ({"sub_steps": 2.7}, "sub_steps"), ({"sub_steps": True}, "sub_steps"),
     ({"synapses": "fat"}, "fat"), ({"synapses": "lean", "dynamics": "dissipative"}, "lean"),
     ({"dynamics": "chaotic"}, "chaotic"), ({"readout": "none"}, "readout"),
     ({"input_scale": [1.0]}, "input_scale"), ({"max_rho": 0.9}, "max_rho"), ({"n_outputs": 0}, "n_outputs")],
)  # fmt: skip
def test_a_wrong_option_is_named(kwargs: dict[str, object], named: str) -> None:
    with pytest.raises(ValueError, match=named):
        small_net(**kwargs)


def test_a_wrong_shape_is_named() -> None:
    net = small_net()
    with pytest.raises(ValueError, match=r"got shape \(2, 5\)"):
        net(th.zeros(2, 5))
    with pytest.raises(ValueError, match="one entry per step"):
        net(th.zeros(2, 3, 6), mask=th.ones(2))


def test_a_lean_network_draws_the_polarities_it_has_come_to() -> None:
    pytest.importorskip("matplotlib").use("Agg")
    net = small_net(synapses="lean")
    with th.no_grad():
        net.cell.synapse[:] = -net.cell.synapse.abs()
        net.cell.current_weight[:] = net.cell.current_weight.abs()
    ax = net.draw(readout=None)
    arrows = [text.arrow_patch for text in ax.texts if getattr(text, "arrow_patch", None) is not None]
    assert len(arrows) == net.wiring.n_synapses
    colours = {arrow.get_edgecolor()[:3] for arrow in arrows}
    assert len(colours) == 2
    inhibitory = sum(arrow.get_edgecolor()[2] > arrow.get_edgecolor()[0] for arrow in arrows)
    assert inhibitory == np.count_nonzero(net.wiring.recurrent)
    assert small_net().draw() is not None


@pytest.mark.parametrize("synapses", ["paper", "lean"])
def test_a_cut_synapse_carries_nothing(synapses: str) -> None:
    net = small_net(synapses=synapses)
    pairs = [*np.argwhere(net.wiring.sensory).tolist(), *np.argwhere(net.wiring.recurrent).tolist()]
    n_sensory = np.count_nonzero(net.wiring.sensory)
    for index, (pre, post) in enumerate(pairs):
        cut = small_net(synapses=synapses)
        cut.cell.cut(index)
        before, after = net.cell.arrays(), cut.cell.arrays()
        changed = {
            (i, int(j) % net.state_dim, name)
            for name in ("current_weight", "from_inputs", "recurrent")
            for i, j in np.argwhere((getattr(before, name) != getattr(after, name)).numpy()).tolist()
        }
        names = {"recurrent"} if index >= n_sensory else {"current_weight"}
        names |= {"from_inputs"} if index < n_sensory and synapses == "paper" else set()
        assert changed == {(pre, post, name) for name in names}
