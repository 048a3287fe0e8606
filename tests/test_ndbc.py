"""NDBCNet: shapes, memory, and agreement of its several forms."""

from __future__ import annotations

import numpy as np
import torch as th
from torch.fx.experimental.proxy_tensor import make_fx

from sb3_tbc.ndbc.frozen import FrozenNDBC
from sb3_tbc.ndbc.network import NDBCNet
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
