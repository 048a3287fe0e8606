"""Wiring: counts of table A1, clipping, reach, polarity, plain data."""

from __future__ import annotations

import json
import logging

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from sb3_tbc.ndbc.drawing import dead_ends
from sb3_tbc.ndbc.wiring import LAYERS, NDBCWiring

TABLE_A1 = {
    "AntFourRooms": (12, 10, 8, 5, 8, 2, 6),
    "UR5Reacher": (6, 4, 3, 4, 5, 2, 5),
    "Drawbridge": (6, 6, 1, 3, 4, 3, 4),
    "Tennis2D": (8, 6, 3, 4, 6, 4, 6),
    "Pendulum": (6, 6, 1, 3, 4, 1, 4),
    "Platforms": (6, 6, 1, 4, 5, 3, 5),
}  # inter, command, motor, sensory fan-out, inter fan-out, recurrent command synapses, motor fan-in (paper, table A1)


def blocks(wiring: NDBCWiring) -> dict[str, np.ndarray]:
    inter, command, motor = (wiring.layer(name) for name in LAYERS)
    return {
        "inter->command": wiring.recurrent[inter, command],
        "command->command": wiring.recurrent[command, command],
        "command->motor": wiring.recurrent[command, motor],
    }


@pytest.mark.parametrize("task", TABLE_A1)
def test_table_a1_fans_are_met_exactly_or_clipped_with_a_note(task: str, caplog: pytest.LogCaptureFixture) -> None:
    inter, command, _, sensory_fan, inter_fan, recurrent, motor_fan = TABLE_A1[task]
    with caplog.at_level(logging.INFO, logger="sb3_tbc"):
        wiring = NDBCWiring(9, *TABLE_A1[task], seed=3)
    part = blocks(wiring)
    assert (np.count_nonzero(wiring.sensory, axis=1) == min(sensory_fan, inter)).all()
    assert (np.count_nonzero(part["inter->command"], axis=1) == min(inter_fan, command)).all()
    assert np.count_nonzero(part["command->command"]) == recurrent
    assert (np.count_nonzero(part["command->motor"], axis=0) == min(motor_fan, command)).all()
    clipped = inter_fan > command or motor_fan > command
    assert clipped == bool(wiring.notes) == ("clipped" in caplog.text)
    if task == "UR5Reacher":
        assert len(wiring.notes) == 2


@given(st.integers(1, 12), st.integers(1, 8), st.integers(1, 8), st.integers(1, 5), st.data())
@settings(max_examples=60, deadline=None)
def test_layers_reach_and_polarity(n_inputs: int, inter: int, command: int, motor: int, data: st.DataObject) -> None:
    fans = [data.draw(st.integers(least, 9)) for least in (1, 1, 0, 1)]
    wiring = NDBCWiring(n_inputs, inter, command, motor, *fans, seed=data.draw(st.integers(0, 99)))
    incoming = np.count_nonzero(wiring.sensory, axis=0) + np.count_nonzero(wiring.recurrent, axis=0)
    assert (incoming >= 1).all()
    assert set(np.unique(wiring.sensory)) | set(np.unique(wiring.recurrent)) <= {-1, 0, 1}
    assert not wiring.sensory[:, inter:].any(), "sensory neurons project to inter neurons only"
    inside = sum(np.count_nonzero(block) for block in blocks(wiring).values())
    assert inside == np.count_nonzero(wiring.recurrent), "no synapse outside the four-layer scheme"
    assert not np.diag(wiring.recurrent).any(), "no autapses"
    assert NDBCWiring.from_dict(json.loads(json.dumps(wiring.to_dict()))) == wiring


@given(st.integers(1, 6), st.integers(1, 7), st.integers(1, 3), st.data())
@settings(max_examples=60, deadline=None)
def test_relaxation_order_goes_with_the_synapses(inter: int, command: int, motor: int, data: st.DataObject) -> None:
    synapses, seed = data.draw(st.integers(0, 12)), data.draw(st.integers(0, 99))
    wiring = NDBCWiring(3, inter, command, motor, 2, 3, synapses, 2, seed=seed)
    groups = wiring.relaxation_order()
    place = {neuron: k for k, group in enumerate(groups) for neuron in group}
    assert sorted(place) == list(range(wiring.n_neurons))
    assert groups[0] == tuple(range(inter))
    assert not any(wiring.recurrent[np.ix_(group, group)].any() for group in groups), "a group hears itself"
    back = {(int(i), int(j)) for i, j in np.argwhere(wiring.recurrent) if place[i] > place[j]}
    assert all(wiring.layer_of(i) == wiring.layer_of(j) == "command" for i, j in back), "only loops are opened"


def test_a_single_recurrent_synapse_is_heard_at_its_end() -> None:
    wiring = NDBCWiring(9, *TABLE_A1["Pendulum"])
    place = {neuron: k for k, group in enumerate(wiring.relaxation_order()) for neuron in group}
    assert all(place[i] < place[j] for i, j in np.argwhere(wiring.recurrent).tolist())


def test_seed_decides_the_draw() -> None:
    numbers = TABLE_A1["AntFourRooms"]
    assert NDBCWiring(9, *numbers, seed=1) == NDBCWiring(9, *numbers, seed=1)
    assert NDBCWiring(9, *numbers, seed=1) != NDBCWiring(9, *numbers, seed=2)


def test_from_numbers_as_plain_data() -> None:
    names = ("inter", "command", "motor", "sensory_fanout", "inter_fanout", "recurrent_command_synapses", "motor_fanin")
    numbers = dict(zip(names, TABLE_A1["Pendulum"], strict=True))
    assert NDBCWiring.from_dict({"n_inputs": 6, **numbers}) == NDBCWiring(6, **numbers)


@pytest.mark.parametrize(
    ("change", "named"), [({"inter": 0}, "inter"), ({"motor_fanin": 0}, "motor_fanin"), ({"command": 2.5}, "command")]
)
def test_a_wrong_size_is_named(change: dict[str, float], named: str) -> None:
    names = ("inter", "command", "motor", "sensory_fanout", "inter_fanout", "recurrent_command_synapses", "motor_fanin")
    numbers = dict(zip(names, TABLE_A1["Pendulum"], strict=True)) | change
    with pytest.raises(ValueError, match=named):
        NDBCWiring(6, **numbers)


@pytest.mark.parametrize("layers", [("inter", "command"), ("inter", "command", "motor")])
def test_reflexes_are_added_to_the_same_wiring(layers: tuple[str, ...]) -> None:
    plain, reflex = (NDBCWiring(9, *TABLE_A1["AntFourRooms"], seed=2, sensory_to=to) for to in (("inter",), layers))
    inter = plain.layer("inter")
    np.testing.assert_array_equal(plain.recurrent, reflex.recurrent)
    np.testing.assert_array_equal(plain.sensory[:, inter], reflex.sensory[:, inter])
    for name in layers:
        block = reflex.sensory[:, reflex.layer(name)]
        assert (np.count_nonzero(block, axis=1) >= min(5, block.shape[1])).all()
        assert block.any(axis=0).all(), "every neuron of the layer is reached"
    assert reflex.n_driven == reflex.layer(layers[-1]).stop
    assert not reflex.sensory[:, reflex.n_driven :].any()
    assert NDBCWiring.from_dict(json.loads(json.dumps(reflex.to_dict()))) == reflex
    assert "sensory_to" in repr(reflex)
    data = reflex.to_dict()
    del data["sensory_to"]
    with pytest.raises(ValueError, match="sensory_to"):
        NDBCWiring.from_dict(data)


@pytest.mark.parametrize("layers", [("motor",), ("inter", "motor"), (), ("command", "inter"), ("inter", "sensory")])
def test_other_targets_of_sensory_neurons_are_refused(layers: tuple[str, ...]) -> None:
    with pytest.raises(ValueError, match=r"sensory_to must be one of \['inter'\]"):
        NDBCWiring(9, *TABLE_A1["Pendulum"], sensory_to=layers)


def test_a_synapse_to_nowhere_is_refused() -> None:
    data = NDBCWiring(6, *TABLE_A1["Pendulum"]).to_dict()
    data["synapses"].append([0, 13, 1])
    with pytest.raises(ValueError, match="13, 1"):
        NDBCWiring.from_dict(data)


def test_from_ncps_keeps_every_synapse() -> None:
    ncps = pytest.importorskip("ncps.wirings")
    theirs = ncps.AutoNCP(20, 3, seed=7)
    with pytest.raises(ValueError, match="build"):
        NDBCWiring.from_ncps(theirs)
    theirs.build(5)
    ours = NDBCWiring.from_ncps(theirs)
    assert (ours.n_inputs, ours.n_neurons, ours.motor) == (5, 20, 3)
    assert np.count_nonzero(ours.sensory) == np.count_nonzero(theirs.sensory_adjacency_matrix)
    motor = ours.layer("motor").start
    for i, j in np.argwhere(theirs.adjacency_matrix):  # ncps: motor neurons first, then command, then inter
        place = [motor + k if k < 3 else None for k in (i, j)]
        if place[1] is not None:
            assert theirs.adjacency_matrix[:, j].sum() == ours.recurrent[:, place[1]].sum()
    assert np.count_nonzero(ours.recurrent) == np.count_nonzero(theirs.adjacency_matrix)
    full = ncps.FullyConnected(8, 2)
    full.build(3)
    with pytest.raises(ValueError, match="NCP"):
        NDBCWiring.from_ncps(full)


def test_it_draws_every_synapse() -> None:
    pytest.importorskip("matplotlib").use("Agg")
    wiring = NDBCWiring(9, *TABLE_A1["UR5Reacher"], sensory_to=("inter", "command", "motor"))
    ax = wiring.draw(input_names=[f"input {i}" for i in range(9)])
    arrows = [text for text in ax.texts if getattr(text, "arrow_patch", None) is not None]
    assert len(arrows) == wiring.n_synapses
    assert sum(len(c.get_offsets()) for c in ax.collections) == wiring.n_inputs + wiring.n_neurons
    with pytest.raises(ValueError, match="9 input names"):
        wiring.draw(input_names=["one"])


def test_dead_ends_are_those_that_reach_no_output() -> None:
    wiring = NDBCWiring(3, 4, 3, 2, 2, 2, 0, 1, seed=0)
    wiring.recurrent[4] = 0  # command0 passes nothing on
    sensory, neurons = dead_ends(wiring)
    assert neurons[4]
    assert not neurons[wiring.layer("motor")].any()
    expected = [not any(neuron_reaches_motor(wiring, j) for j in np.flatnonzero(wiring.sensory[i])) for i in range(3)]
    assert sensory.tolist() == expected
    readout = np.zeros((wiring.n_neurons, 1))
    readout[4] = 1.0  # read directly, it is none
    assert not dead_ends(wiring, readout)[1][4]
    assert dead_ends(wiring, readout)[1][wiring.layer("motor")].all()  # motor neurons that nobody reads are


def neuron_reaches_motor(wiring: NDBCWiring, neuron: int) -> bool:
    seen, waiting = set(), [neuron]
    while waiting:
        k = waiting.pop()
        if k >= wiring.layer("motor").start:
            return True
        waiting += [int(j) for j in np.flatnonzero(wiring.recurrent[k]) if j not in seen]
        seen.add(k)
    return False


def test_drawing_shows_the_readout_and_what_is_used() -> None:
    pytest.importorskip("matplotlib")
    wiring = NDBCWiring(3, 4, 3, 2, 2, 2, 0, 1, seed=0)
    wiring.recurrent[4] = 0
    readout = np.zeros((9, 2))
    readout[7], readout[8] = (1.0, 0.0), (0.5, -2.0)
    used = np.ones((3, 9)), np.ones((9, 9))
    ax = wiring.draw(None, list("abc"), readout=readout, output_names=["pan", "lift"], used=used)
    words = [text.get_text() for text in ax.texts]
    assert {"a", "b", "c", "pan", "lift", "output (2)"} <= set(words)
    assert any("dead ends" in w for w in words)
    arrows = [t for t in ax.texts if getattr(t, "arrow_patch", None) is not None]
    assert len(arrows) == wiring.n_synapses + 3
    with pytest.raises(ValueError, match="output names"):
        wiring.draw(readout=readout, output_names=["pan"])
    with pytest.raises(ValueError, match="9 neurons"):
        wiring.draw(readout=readout[:5])
