"""Draw the wirings of docs/ndbcnet.md: ``python docs/images/draw_wirings.py`` from the checkout."""

from __future__ import annotations

from pathlib import Path

import matplotlib as mpl

mpl.use("Agg")
import matplotlib.pyplot as plt

from sb3_tbc.benchmark.circuits import shipped_circuits

circuits = shipped_circuits()
figure, axes = plt.subplots(-(-len(circuits) // 2), 2, figsize=(12, 4.7 * -(-len(circuits) // 2)))
for ax in axes.flat:
    ax.axis("off")
for ax, circuit in zip(axes.flat, circuits, strict=False):
    circuit.wiring.draw(ax)
    ax.set_title(circuit.title)
figure.tight_layout()
figure.savefig(Path(__file__).parent / "wirings.png", dpi=60)
