"""Small random circuits of every form, for the tests of ndbc/."""

from __future__ import annotations

from collections.abc import Sequence

import torch as th
from hypothesis import strategies as st

from sb3_tbc.ndbc.network import SYNAPSES, NDBCNet
from sb3_tbc.ndbc.wiring import NDBCWiring

SEEDS = st.integers(0, 10_000)
FORMS = [
    {"synapses": synapses, "sensory_to": layers}
    for synapses in SYNAPSES
    for layers in (("inter",), ("inter", "command"), ("inter", "command", "motor"))
]
FORMS += [
    {
        "synapses": synapses,
        "time_constants": {"command": (0.3, 30.0), "motor": (2.0, 2.0)},
        "initial_gains": (6.0, 12.0),
    }
    for synapses in SYNAPSES
]
FORM = st.sampled_from(FORMS)


def random_net(seed: int, spread: float = 1.0, sensory_to: Sequence[str] = ("inter",), **kwargs: object) -> NDBCNet:
    """A small network whose free parameters were all pushed around by ``spread`` standard deviations."""
    wiring = NDBCWiring(3, inter=4, command=4, motor=2, sensory_fanout=2, inter_fanout=3,
                        recurrent_command_synapses=3, motor_fanin=3, seed=seed, sensory_to=sensory_to)  # fmt: skip
    net = NDBCNet(3, 2, wiring, seed=seed, **kwargs)  # type: ignore[arg-type]
    generator = th.Generator().manual_seed(seed + 1)
    with th.no_grad():
        for parameter in net.parameters():
            parameter += spread * th.randn(parameter.shape, generator=generator)
    return net
