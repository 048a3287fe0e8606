"""The circuit of a trained agent as a picture: its readout, its dead ends, and how much of it is used."""

from __future__ import annotations

import io
from collections.abc import Sequence
from typing import TYPE_CHECKING

import numpy as np
from scipy.special import expit

from sb3_tbc.arrays import FloatArray
from sb3_tbc.export.policy import Circuit, Dissipative, read_circuit
from sb3_tbc.extras import require
from sb3_tbc.interpret.episodes import Trace
from sb3_tbc.interpret.names import action_names, input_names
from sb3_tbc.interpret.units import CircuitUnits
from sb3_tbc.tbc_hrl import TBCHRL

if TYPE_CHECKING:
    from matplotlib.axes import Axes

MAX_STEPS = 500
"""Number of steps whose currents are averaged."""


def draw_agent(model: TBCHRL, task: str, units: CircuitUnits, traces: Sequence[Trace], ax: Axes | None = None) -> Axes:
    """Draw the circuit with the task's names; synapses are as thick as the mean size of their currents in episodes.

    :param model: the agent
    :param task: its short name
    :param units: its circuit
    :param traces: episodes
    :param ax: matplotlib axes; new ones by default
    :return: the axes
    """
    n_actions = int(model.action_space.shape[0])  # type: ignore[index]
    return units.net.draw(
        ax,
        input_names(task, model.views),
        readout=units.net.readout_weights()[:, :n_actions],  # the other outputs are standard deviations
        output_names=action_names(task, n_actions),
        used=mean_currents(units, n_actions, traces),
    )


def mean_currents(units: CircuitUnits, n_actions: int, traces: Sequence[Trace]) -> tuple[FloatArray, FloatArray]:
    """Mean size of the current through each synapse: from sensory neurons ``(I, N)``, and among neurons ``(N, N)``.

    A conductance carries ``w sigma (E - V)``; an input current is shared among inputs in proportion to their part of
    its argument.
    """
    numbers = read_circuit(units.net, n_actions)
    inputs, potentials = (np.concatenate([getattr(t, name) for t in traces]) for name in ("inputs", "activations"))
    some = np.linspace(0, len(inputs) - 1, min(len(inputs), MAX_STEPS)).astype(np.int64)
    u, v = inputs[some].astype(np.float64), potentials[some].astype(np.float64)
    if isinstance(numbers, Dissipative):
        sensory = np.abs(u).mean(axis=0)[:, None] * np.abs(numbers.input_weight)
        return sensory, np.abs(v).mean(axis=0)[:, None] * np.abs(numbers.recurrent)
    return _sensory(numbers, u, v), _recurrent(numbers, v)


def _sensory(numbers: Circuit, u: FloatArray, v: FloatArray) -> FloatArray:
    n, scaled = numbers.n_neurons, u * numbers.input_gain
    current = np.zeros((len(u), u.shape[1], n))
    n_sensing = len(numbers.sensory_gain)
    if n_sensing:
        sensed = expit(scaled * numbers.sensory_gain - numbers.sensory_threshold)[:, :, None]
        pull, conductance = np.split(numbers.from_inputs[:n_sensing], 2, axis=1)
        current += sensed * (pull - conductance * v[:, None, :])
    driven = len(numbers.current_bias)
    pulls = scaled @ numbers.current_weight + numbers.current_bias
    ratio = np.divide(np.tanh(pulls), pulls, out=np.ones_like(pulls), where=np.abs(pulls) > 1e-6)
    gain = np.array([numbers.from_inputs[n_sensing + j, j] for j in range(driven)])
    current[:, :, :driven] += (gain * ratio)[:, None, :] * scaled[:, :, None] * numbers.current_weight
    return np.asarray(np.abs(current).mean(axis=0))


def _recurrent(numbers: Circuit, v: FloatArray) -> FloatArray:
    n, heard = numbers.n_neurons, len(numbers.gain)
    released = expit(v[:, :heard] * numbers.gain - numbers.threshold)[:, :, None]
    pull, conductance = np.split(numbers.recurrent, 2, axis=1)
    used = np.zeros((n, n))
    used[:heard] = np.abs(released * (pull - conductance * v[:, None, :])).mean(axis=0)
    return used


def picture_of(model: TBCHRL, task: str, units: CircuitUnits, traces: Sequence[Trace]) -> bytes:
    """The same as a PNG picture.

    :raises MissingExtraError: without matplotlib
    """
    require("matplotlib", extra="plots", what="the picture of the circuit")
    from matplotlib.figure import Figure

    figure = Figure(figsize=(9.0, 5.0))
    draw_agent(model, task, units, traces, figure.add_axes((0.08, 0.02, 0.9, 0.94)))
    buffer = io.BytesIO()
    figure.savefig(buffer, format="png", dpi=130)
    return buffer.getvalue()
