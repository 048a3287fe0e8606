"""The drawn circuit carries the task's names, and its currents are those that move the neurons."""

from __future__ import annotations

import numpy as np
import pytest

from sb3_tbc import TBCHRL
from sb3_tbc.interpret.drawing import draw_agent, mean_currents, picture_of
from sb3_tbc.interpret.episodes import Trace
from sb3_tbc.interpret.names import action_names, input_names
from sb3_tbc.interpret.units import CircuitUnits
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


def test_the_picture(agent: TBCHRL, units: CircuitUnits, traces: list[Trace]) -> None:
    pytest.importorskip("matplotlib")
    words = {text.get_text() for text in draw_agent(agent, "Pendulum", units, traces).texts}
    assert {"sin angle", "subgoal velocity", "time left", "torque"} <= words
    assert picture_of(agent, "Pendulum", units, traces).startswith(b"\x89PNG")
