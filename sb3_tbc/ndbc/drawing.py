"""A wiring as a picture: layers from left to right, excitatory synapses red, inhibitory blue. Needs matplotlib."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np

from sb3_tbc.extras import require
from sb3_tbc.ndbc.wiring import LAYERS, NDBCWiring

COLOURS = {"sensory": "#4d9221", "inter": "#7b7b7b", "command": "#c27ba0", "motor": "#e08214"}
EXCITATORY, INHIBITORY = "#c0392b", "#2c5aa0"


def draw_wiring(wiring: NDBCWiring, ax: Any = None, input_names: Sequence[str] | None = None) -> Any:
    """Draw neurons and signed synapses.

    :param wiring: the wiring
    :param ax: matplotlib axes to draw into; new ones by default
    :param input_names: a name per sensory neuron
    :return: the axes
    :raises ValueError: if there are not as many names as inputs
    :raises MissingExtraError: without matplotlib
    """
    if input_names is not None and len(input_names) != wiring.n_inputs:
        raise ValueError(f"need {wiring.n_inputs} input names, got {len(input_names)}")
    if ax is None:
        pyplot = require("matplotlib.pyplot", extra="plots", what="drawing a wiring")
        _, ax = pyplot.subplots(figsize=(7.0, 4.0))  # constrained layout takes minutes over so many arrows
    places = _places(wiring)
    sensory, neurons = places[: wiring.n_inputs], places[wiring.n_inputs :]
    for sources, signs in ((sensory, wiring.sensory), (neurons, wiring.recurrent)):
        for i, j in np.argwhere(signs):
            _synapse(ax, sources[i], neurons[j], EXCITATORY if signs[i, j] > 0 else INHIBITORY)
    sizes = {"sensory": wiring.n_inputs, **{name: getattr(wiring, name) for name in LAYERS}}
    start = 0
    for column, (name, size) in enumerate(sizes.items()):
        x, y = places[start : start + size].T
        ax.scatter(x, y, s=110, color=COLOURS[name], edgecolor="white", linewidth=1.0, zorder=3)
        ax.text(column, 1.08, f"{name} ({size})", ha="center", va="bottom", fontsize=9, color=COLOURS[name])
        start += size
    for name, (x, y) in zip(input_names or (), sensory, strict=False):
        ax.text(x - 0.08, y, name, ha="right", va="center", fontsize=7)
    ax.set(xlim=(-0.6, 3.4), ylim=(-0.08, 1.2))
    ax.axis("off")
    return ax


def _places(wiring: NDBCWiring) -> Any:
    """Coordinates of all neurons, sensory ones first: one column per layer, evenly spread."""
    sizes = (wiring.n_inputs, wiring.inter, wiring.command, wiring.motor)
    columns = [np.stack([np.full(n, c), 1.0 - (np.arange(n) + 0.5) / n], axis=1) for c, n in enumerate(sizes)]
    return np.concatenate(columns)


def _synapse(ax: Any, source: Any, target: Any, colour: str) -> None:
    """A line between layers; an arc, bending to the right, within one."""
    bend = 0.0 if source[0] != target[0] else 0.6 * np.sign(source[1] - target[1] or 1.0)
    style = {"arrowstyle": "-|>", "color": colour, "alpha": 0.55, "lw": 0.8, "shrinkA": 5, "shrinkB": 6}
    ax.annotate("", target, source, arrowprops={**style, "connectionstyle": f"arc3,rad={bend}", "mutation_scale": 6})
