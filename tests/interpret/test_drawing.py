"""The drawn circuit carries the task's names, and its currents are those that move the neurons."""

from __future__ import annotations

from types import SimpleNamespace

import numpy as np
import pytest
import torch as th

from sb3_tbc import TBCHRL
from sb3_tbc.interpret.drawing import draw_agent, mean_currents, picture_of
from sb3_tbc.interpret.episodes import Trace
from sb3_tbc.interpret.names import action_names, input_names
from sb3_tbc.interpret.units import CircuitUnits
from sb3_tbc.ndbc.network import SYNAPSES, NDBCNet
from sb3_tbc.ndbc.wiring import NDBCWiring
from sb3_tbc.pretrained import load_pretrained, pretrained_names


@pytest.mark.parametrize("task", pretrained_names())
def test_every_input_and_action_has_a_name_of_the_task(task: str) -> None:
    model = load_pretrained(task)
    assert isinstance(model, TBCHRL)
    names = input_names(task, model.layout)
    assert len(names) == model.low.policy.observation_space.shape[0]
    assert not any(name.startswith("state ") for name in names)
    assert len(action_names(task, model.action_space.shape[0])) == model.action_space.shape[0]


def test_a_synapse_that_is_not_there_carries_nothing(units: CircuitUnits, traces: list[Trace]) -> None:
    sensory, among = mean_currents(units, 1, traces)
    wiring = units.net.wiring
    assert (sensory[wiring.sensory == 0] == 0).all()
    assert (among[wiring.recurrent == 0] == 0).all()
    assert (sensory[wiring.sensory != 0] > 0).all()
    assert (among[wiring.recurrent != 0] > 0).all()
    cut = units.without_synapse(0)
    i, j = np.argwhere(wiring.sensory)[0]
    assert mean_currents(cut, 1, traces)[0][i, j] == 0.0


@pytest.mark.parametrize("synapses", SYNAPSES)
def test_input_currents_are_those_of_the_cell(synapses: str) -> None:
    wiring = NDBCWiring(1, 3, 2, 1, 3, 2, 1, 1, seed=0)
    net = NDBCNet(1, 2, wiring, seed=0, synapses=synapses)
    with th.no_grad():
        net.cell.current_bias.zero_()
        if synapses == "paper":
            net.cell.raw_conductance.fill_(-th.inf)  # its sensory synapses conduct besides
    u = np.array([[0.5], [-0.8]], np.float32)
    units = SimpleNamespace(net=net)
    trace = SimpleNamespace(inputs=u, activations=np.zeros((2, net.state_dim), np.float32))
    found, _ = mean_currents(units, 1, [trace])
    size = net.cell.values().input_conductance.detach().numpy()
    expected = size * np.abs(np.tanh(u @ net.cell.arrays().current_weight.detach().numpy())).mean(axis=0)
    np.testing.assert_allclose(found[0, : len(expected)], expected, rtol=1e-5)


def test_the_picture(agent: TBCHRL, units: CircuitUnits, traces: list[Trace]) -> None:
    pytest.importorskip("matplotlib")
    words = {text.get_text() for text in draw_agent(agent, "Pendulum", units, traces).texts}
    assert {"sin angle", "subgoal velocity", "time left", "torque"} <= words
    assert picture_of(agent, "Pendulum", units, traces).startswith(b"\x89PNG")
