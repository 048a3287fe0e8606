"""Draw the curves of docs/signs_of_trouble.md. The numbers are of real runs; the page names them."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from matplotlib.figure import Figure

BLUE, RED, GREY = "#0072b2", "#d55e00", "#777777"

# HiTS, Pendulum, seed 0 (a healthy run): steps, rollout success, options per episode
HEALTHY = {
    "steps": [5e3, 50e3, 73e3, 200e3],
    "success while exploring": [0.0, 0.81, 1.0, 1.0],
    "options per episode": [22, 5.3, 5.2, 4.0],
    "high/q_mean": [-87, -73, -72, -69],
}
# TBC-HRL, UR5Reacher, seed 1: asks for what it has already, then recovers
ASKS = {
    "steps": [10e3, 30e3, 50e3, 90e3, 120e3, 150e3],
    "success": [0.0, 0.0, 0.0, 0.05, 0.35, 1.0],
    "subgoals reached": [0.25, 0.90, 1.0, 0.93, 0.62, 0.42],
    "options per episode": [24, 24, 24, 24, 17, 4],
}
# AntFourRooms, target smdp, seed 0: subgoals are reached, goals are not
GOALS = {
    "steps": [150e3, 275e3, 475e3, 825e3, 900e3],
    "success": [0.0, 0.0, 0.0, 0.0, 0.25],
    "subgoals reached": [0.21, 0.67, 0.71, 0.66, 0.50],
    "high/q_mean": [-84, -84, -83, -80, -76],
}
# Tennis2D, testing_penalty -6, seed 0: the high level's critic diverges
CRITIC = {
    "steps": [456e3, 865e3, 1.27e6, 1.76e6, 2.75e6],
    "success": [0.06, 0.10, 0.03, 0.02, 0.02],
    "high/q_mean": [-16, -20, -16, -15, -227],
    "high/critic_loss": [9, 16, 225, 14_000, 1_300_000],
}
# Tennis2D, the low level's rates falling to zero, seed 0
WINDOWS = {
    "steps": [1.5e6, 1.75e6, 2e6, 2.25e6, 2.5e6],
    "success": [0.34, 0.24, 0.14, 0.02, 0.0],
    "window, steps": [36, 35, 42, 53, 50],
    "high/q_mean": [-10.7, -9.5, -8.6, -7.0, -6.2],
}
PICTURES = {
    "healthy": HEALTHY,
    "asks_for_what_it_has": ASKS,
    "goals_not_reached": GOALS,
    "critic_diverges": CRITIC,
    "windows_grow": WINDOWS,
}
LOGARITHMIC = {"high/critic_loss"}


def draw(curves: dict[str, Any]) -> Figure:
    """Panels side by side, one quantity each, over environment steps."""
    names = [name for name in curves if name != "steps"]
    figure = Figure(figsize=(3.0 * len(names), 2.4), layout="constrained")
    axes = figure.subplots(1, len(names), squeeze=False)[0]
    for axis, name in zip(axes, names, strict=True):
        axis.plot([step / 1000 for step in curves["steps"]], curves[name], "o-", color=BLUE)
        axis.set(title=name, xlabel="thousand steps")
        axis.grid(alpha=0.3)
        if name in LOGARITHMIC:
            axis.set_yscale("log")
        elif name.startswith(("success", "subgoals")):
            axis.set_ylim(-0.05, 1.05)
    return figure


def draw_all(folder: Path) -> None:
    """Write one SVG per picture."""
    folder.mkdir(parents=True, exist_ok=True)
    for name, curves in PICTURES.items():
        draw(curves).savefig(folder / f"{name}.svg", metadata={"Date": None})


if __name__ == "__main__":
    draw_all(Path(__file__).parents[1] / "_static" / "signs")
