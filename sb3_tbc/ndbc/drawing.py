"""A wiring as a picture: layers from left to right, excitatory synapses red, inhibitory blue. Needs matplotlib.

Neurons that cannot act on any output (dead ends) are drawn hollow. With weights of a readout, outputs are a fifth
column. With currents of a trained agent, the more a synapse is used, the thicker and darker it is.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING

import numpy as np

from sb3_tbc.aliases import Plain
from sb3_tbc.arrays import BoolArray, FloatArray
from sb3_tbc.extras import require
from sb3_tbc.ndbc.wiring import LAYERS, NDBCWiring

if TYPE_CHECKING:
    from matplotlib.axes import Axes

COLOURS = {"sensory": "#4d9221", "inter": "#7b7b7b", "command": "#c27ba0", "motor": "#e08214"}
EXCITATORY, INHIBITORY = "#c0392b", "#2c5aa0"
OUTPUT, DEAD = "#444444", "#999999"


def draw_wiring(
    wiring: NDBCWiring,
    ax: Axes | None = None,
    input_names: Sequence[str] | None = None,
    *,
    readout: FloatArray | None = None,
    output_names: Sequence[str] | None = None,
    used: tuple[FloatArray, FloatArray] | None = None,
) -> Axes:
    """Draw neurons, signed synapses and, where they are known, the readout's weights and how much each synapse is used.

    :param wiring: the wiring
    :param ax: matplotlib axes to draw into; new ones by default
    :param input_names: a name per sensory neuron
    :param readout: weight of each neuron on each output, ``(n_neurons, n_outputs)``; without it the motor neurons are
        those that are read
    :param output_names: a name per output
    :param used: mean size of the current through each synapse, from sensory neurons ``(n_inputs, n_neurons)`` and among
        neurons ``(n_neurons, n_neurons)``; all synapses look alike without it
    :return: the axes
    :raises ValueError: if a name or a weight is missing
    :raises MissingExtraError: without matplotlib
    """
    _check_names("input", input_names, wiring.n_inputs)
    if readout is not None and len(readout) != wiring.n_neurons:
        raise ValueError(f"readout needs a row for each of {wiring.n_neurons} neurons, got {len(readout)}")
    n_outputs = 0 if readout is None else readout.shape[1]
    _check_names("output", output_names, n_outputs)
    if ax is None:
        pyplot = require("matplotlib.pyplot", extra="plots", what="drawing a wiring")
        _, ax = pyplot.subplots(figsize=(7.0, 4.0))  # constrained layout takes minutes over so many arrows
    places = _places(wiring, n_outputs)
    ends = wiring.n_inputs + wiring.n_neurons
    sensory, neurons, outputs = places[: wiring.n_inputs], places[wiring.n_inputs : ends], places[ends:]
    for k, (sources, signs) in enumerate(((sensory, wiring.sensory), (neurons, wiring.recurrent))):
        share = None if used is None else _shares(used[k])
        for i, j in np.argwhere(signs):
            _synapse(ax, sources[i], neurons[j], signs[i, j] > 0, 0.5 if share is None else float(share[i, j]))
    if readout is not None:
        for i, j in np.argwhere(readout):
            _synapse(ax, neurons[i], outputs[j], readout[i, j] > 0, float(_shares(readout)[i, j]))
    _draw_neurons(ax, wiring, places, dead_ends(wiring, readout), n_outputs)
    for name, (x, y) in zip(input_names or (), sensory, strict=False):
        ax.text(x - 0.08, y, name, ha="right", va="center", fontsize=7)
    for name, (x, y) in zip(output_names or (), outputs, strict=False):
        ax.text(x + 0.08, y, name, ha="left", va="center", fontsize=7)
    ax.set(xlim=(-0.6, 3.4 + (n_outputs > 0)), ylim=(-0.08, 1.2))
    ax.axis("off")
    return ax


def dead_ends(wiring: NDBCWiring, readout: FloatArray | None = None) -> tuple[BoolArray, BoolArray]:
    """Sensory neurons ``(n_inputs,)`` and neurons ``(n_neurons,)`` that cannot act on any output.

    :param readout: weights ``(n_neurons, n_outputs)``; without them the motor neurons are those that are read
    """
    acts = np.zeros(wiring.n_neurons, dtype=bool)
    if readout is None:
        acts[wiring.layer("motor")] = True
    else:
        acts |= (np.asarray(readout) != 0).any(axis=1)
    heard = wiring.recurrent != 0
    for _ in range(wiring.n_neurons):
        acts |= heard[:, acts].any(axis=1)
    return ~(wiring.sensory[:, acts] != 0).any(axis=1), ~acts


def _check_names(what: str, names: Sequence[str] | None, size: int) -> None:
    if names is not None and len(names) != size:
        raise ValueError(f"need {size} {what} names, got {len(names)}")


def _shares(weights: FloatArray) -> FloatArray:
    size = np.abs(np.asarray(weights, dtype=np.float64))
    return np.asarray(size / max(float(size.max(initial=0.0)), 1e-12))


def _draw_neurons(
    ax: Axes, wiring: NDBCWiring, places: FloatArray, dead: tuple[BoolArray, BoolArray], n_outputs: int
) -> None:
    sizes = {"sensory": wiring.n_inputs, **{name: getattr(wiring, name) for name in LAYERS}}
    sizes.update({"output": n_outputs} if n_outputs else {})
    ended, start = np.concatenate([*dead, np.zeros(n_outputs, dtype=bool)]), 0
    for column, (name, size) in enumerate(sizes.items()):
        colour, part = COLOURS.get(name, OUTPUT), slice(start, start + size)
        for which, filled in ((~ended[part], True), (ended[part], False)):
            x, y = places[part][which].T
            look: Plain = {"color": colour, "edgecolor": "white"} if filled else {"color": "white", "edgecolor": DEAD}
            ax.scatter(x, y, s=110, linewidth=1.0, linestyle="-" if filled else "--", zorder=3, **look)
        ax.text(column, 1.08, f"{name} ({size})", ha="center", va="bottom", fontsize=9, color=colour)
        start += size
    if ended.any():
        ax.text(1.5, -0.06, f"hollow: {int(ended.sum())} dead ends, which act on no output", ha="center", fontsize=7)


def _places(wiring: NDBCWiring, n_outputs: int) -> FloatArray:
    """Coordinates of all neurons, sensory ones first, then of the outputs: one column per layer, evenly spread."""
    sizes = (wiring.n_inputs, wiring.inter, wiring.command, wiring.motor, n_outputs)
    columns = [np.stack([np.full(n, c), 1.0 - (np.arange(n) + 0.5) / n], axis=1) for c, n in enumerate(sizes) if n]
    return np.concatenate(columns)


def _synapse(ax: Axes, source: FloatArray, target: FloatArray, excites: bool, share: float) -> None:
    """A line between layers, an arc, bending to the right, within one; ``share`` of the thickest, 0 to 1."""
    bend = 0.0 if source[0] != target[0] else 0.6 * np.sign(source[1] - target[1] or 1.0)
    style = {
        "arrowstyle": "-|>", "color": EXCITATORY if excites else INHIBITORY, "alpha": 0.08 + 0.85 * share,
        "lw": 0.3 + 1.1 * share, "shrinkA": 5, "shrinkB": 6,
    }  # fmt: skip
    ends = (target[0], target[1]), (source[0], source[1])
    ax.annotate("", *ends, arrowprops={**style, "connectionstyle": f"arc3,rad={bend}", "mutation_scale": 6})
