"""Activation in space, in figure 5's layout: a panel per neuron, its potential along the trajectory."""

from __future__ import annotations

import io
from collections.abc import Sequence

import numpy as np

from sb3_tbc.arrays import FloatArray
from sb3_tbc.extras import require
from sb3_tbc.interpret.episodes import Trace
from sb3_tbc.interpret.features import TaskSpace, places_of
from sb3_tbc.interpret.units import Units
from sb3_tbc.smdp.spaces import SubgoalSpace

COLUMNS, MOST_PANELS = 4, 12


def units_shown(units: Units, activity: FloatArray) -> list[int]:
    """The command neurons, or of an MLP the units of its last hidden layer; the most active ones if they are many."""
    layer = units.layers.get("command", list(units.layers.values())[-1])
    which = list(range(len(units.names)))[layer]
    if len(which) > MOST_PANELS:
        which = sorted(sorted(which, key=lambda i: -activity[i])[:MOST_PANELS])
    return which


def activation_in_space(
    traces: Sequence[Trace], units: Units, which: Sequence[int], space: TaskSpace, subgoals: SubgoalSpace, title: str
) -> bytes:
    """A PNG picture: blue is a neuron's lowest potential, red its highest.

    :param traces: episodes, all drawn into each panel
    :param which: indices of units, one panel each
    :param space: the task's natural space
    :param subgoals: of the agent
    :param title: over all panels
    :raises MissingExtraError: if matplotlib is not installed
    """
    require("matplotlib", extra="plots", what="the picture")
    from matplotlib.figure import Figure

    columns = min(COLUMNS, len(which))
    rows = -(-len(which) // columns)
    figure = Figure(figsize=(3.1 * columns, 2.9 * rows + 0.5), layout="constrained")
    panels = np.atleast_1d(figure.subplots(rows, columns, sharex=True, sharey=True)).ravel()
    places = [places_of(trace, space, subgoals) for trace in traces]
    for panel, unit in zip(panels, which, strict=False):
        values = np.concatenate([t.activations[:, unit] for t in traces])
        points = np.concatenate([place[1:] for place in places])
        dots = panel.scatter(*points.T, c=values, s=4, cmap="coolwarm", linewidths=0)
        panel.scatter(*np.stack([p[0] for p in places]).T, s=12, facecolors="none", edgecolors="0.3", linewidths=0.7)
        panel.set_title(units.names[unit], fontsize=10)
        figure.colorbar(dots, ax=panel, shrink=0.85).ax.tick_params(labelsize=7)
    for panel in panels[len(which) :]:
        panel.set_visible(False)
    figure.supxlabel(space.labels[0], fontsize=9)
    figure.supylabel(space.labels[1], fontsize=9)
    figure.suptitle(title, fontsize=11)
    buffer = io.BytesIO()
    figure.savefig(buffer, format="png", dpi=110)
    return buffer.getvalue()
