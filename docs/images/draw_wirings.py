"""Draw the wirings of docs/ndbcnet.md: ``python docs/images/draw_wirings.py`` from the checkout."""

from __future__ import annotations

from pathlib import Path

import matplotlib as mpl

mpl.use("Agg")
import gymnasium as gym
import matplotlib.pyplot as plt

import sb3_tbc  # noqa: F401  (registers the tasks)
from sb3_tbc.benchmark_cells import TABLE_A1
from sb3_tbc.ndbc.wiring import NDBCWiring

figure, axes = plt.subplots(3, 2, figsize=(12, 14), layout="constrained")
for ax, (task, numbers) in zip(axes.flat, TABLE_A1.items(), strict=True):
    subgoals = gym.make(f"sb3_tbc/{task}-v0").unwrapped.subgoals
    NDBCWiring(subgoals.local_dim + subgoals.dim + 1, *numbers).draw(ax)
    ax.set_title(task)
figure.savefig(Path(__file__).parent / "wirings.png", dpi=60)
