"""Draw the wirings of docs/ndbcnet.md: ``python docs/images/draw_wirings.py`` from the checkout."""

from __future__ import annotations

from pathlib import Path

import matplotlib as mpl

mpl.use("Agg")
import matplotlib.pyplot as plt

from sb3_tbc.ndbc.wiring import NDBCWiring

WIRINGS = {  # inputs of the low level, then table A1's numbers
    "AntFourRooms": (35, 12, 10, 8, 5, 8, 2, 6),
    "UR5Reacher": (13, 6, 4, 3, 4, 5, 2, 5),
    "Drawbridge": (8, 6, 6, 1, 3, 4, 3, 4),
    "Tennis2D": (13, 8, 6, 3, 4, 6, 4, 6),
    "Pendulum": (6, 6, 6, 1, 3, 4, 1, 4),
    "Platforms": (18, 6, 6, 1, 4, 5, 3, 5),
}

figure, axes = plt.subplots(3, 2, figsize=(12, 14))
for ax, (task, numbers) in zip(axes.flat, WIRINGS.items(), strict=True):
    NDBCWiring(*numbers).draw(ax)
    ax.set_title(task)
figure.tight_layout()
figure.savefig(Path(__file__).parent / "wirings.png", dpi=60)
