"""Pictures from the results: learning curves over seeds and timelines of options. Needs the ``plots`` extra."""

from __future__ import annotations

import io
from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from sb3_tbc.stats import bootstrap_band

if TYPE_CHECKING:
    from matplotlib.figure import Figure


class Curve(NamedTuple):
    """Success rate against environment steps of one seed."""

    timesteps: Sequence[float]
    success_rate: Sequence[float]


def common_grid(curves: Sequence[Curve], points: int = 100) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Bring curves that were evaluated at different steps onto one grid, which ends where the shortest curve ends.

    :param curves: one per seed, each with at least one point
    :param points: size of the grid
    :return: grid ``(points,)`` and values ``(n_seeds, points)``
    :raises ValueError: if there is no curve or one is empty
    """
    if not curves or any(len(c.timesteps) == 0 for c in curves):
        raise ValueError(f"need curves with points, got lengths {[len(c.timesteps) for c in curves]}")
    grid = np.linspace(max(c.timesteps[0] for c in curves), min(c.timesteps[-1] for c in curves), points)
    return grid, np.stack([np.interp(grid, c.timesteps, c.success_rate) for c in curves])


def learning_curves(tasks: Mapping[str, Mapping[str, Sequence[Curve]]], confidence: float = 0.95) -> Figure:
    """Mean success over seeds with bootstrap bands, one panel per task, one line per method (figures 4 and 6).

    :param tasks: task -> method -> one curve per seed
    :raises ImportError: without matplotlib, saying how to get it
    """
    columns = min(3, max(len(tasks), 1))
    rows = -(-max(len(tasks), 1) // columns)
    figure = new_figure(4.2 * columns, 3.1 * rows)
    axes = figure.subplots(rows, columns, squeeze=False).ravel()
    for axis, (task, methods) in zip(axes, tasks.items(), strict=False):
        for index, (method, curves) in enumerate(methods.items()):
            grid, values = common_grid(curves)
            low, high = bootstrap_band(values, confidence, n_resamples=1000)
            label = f"{method} ({len(curves)} seed{'s' if len(curves) > 1 else ''})"
            axis.plot(grid, values.mean(axis=0), color=f"C{index}", label=label)
            axis.fill_between(grid, low, high, color=f"C{index}", alpha=0.2, linewidth=0)
        axis.set(title=task, xlabel="environment steps", ylabel="success rate", ylim=(-0.03, 1.03))
        axis.grid(alpha=0.3)
        axis.legend(fontsize="small", loc="lower right")
    for axis in axes[len(tasks) :]:
        axis.axis("off")
    return figure


def option_timeline(options: Sequence[Mapping[str, Any]], title: str = "") -> Figure:
    """Windows of one episode as bars: executed length before the time budget, green where the subgoal was reached.

    :param options: as in ``info["option"]``, in order
    """
    figure = new_figure(8.0, 1.2 + 0.16 * len(options))
    axis = figure.subplots()
    start = 0
    for row, option in enumerate(options):
        axis.barh(row, option["time_budget"], left=start, color="0.85")
        axis.barh(row, option["duration"], left=start, color="C2" if option["reached"] else "C3", height=0.45)
        start += option["duration"]
    axis.set(title=title, xlabel="environment step", ylabel="option")
    axis.invert_yaxis()
    return figure


def new_figure(width: float, height: float) -> Figure:
    """A figure outside pyplot's global state, size in inches.

    :raises ImportError: without matplotlib, saying how to get it
    """
    try:
        from matplotlib.figure import Figure
    except ImportError as error:
        raise ImportError("pictures need matplotlib: pip install 'sb3_tbc[plots]'") from error
    return Figure(figsize=(width, height), layout="constrained")


def to_png(figure: Figure, dpi: int = 110) -> bytes:
    """The figure as a PNG file's content."""
    buffer = io.BytesIO()
    figure.savefig(buffer, format="png", dpi=dpi)
    return buffer.getvalue()
