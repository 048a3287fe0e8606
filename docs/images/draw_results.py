"""Draw docs/images/success.svg from the results ledger: ``python docs/images/draw_results.py`` from the checkout.

Success of the shipped settings, of HiTS in this code, and of the paper (its table 2) on the six tasks. Our runs are the
ledger's variant ``full``, mean over the seeds that the report shows.
"""

from __future__ import annotations

from pathlib import Path

import yaml

from sb3_tbc.report.runs import Results, load_results

ROOT = Path(__file__).parents[2]
TASKS = ("Pendulum", "UR5Reacher", "Drawbridge", "Platforms", "AntFourRooms", "Tennis2D")
SERIES = (
    ("TBC-HRL, here", "#0072b2", "circle"),
    ("HiTS, here", "#d55e00", "square"),
    ("TBC-HRL, paper", "#666", "bar"),
)
LEFT, RIGHT, TOP, ROW = 130, 40, 46, 44
WIDTH = 760


def ours(results: Results, task: str, algo: str) -> float | None:
    """Mean final success; None without a run."""
    rates = [run.final["success_rate"] for run in results[task].get(algo, [])]
    return sum(rates) / len(rates) if rates else None


def paper(task: str) -> float:
    """The paper's mean success (table 2), 0 to 1."""
    tables = yaml.safe_load((ROOT / "tests" / "data" / "paper_tables.yaml").read_text())
    return float(tables["table_2_success_percent"][task]["tbc_hrl"][0]) / 100.0


def mark(kind: str, x: float, y: float, colour: str) -> str:
    """A point of its own shape, so that colour is not needed to tell series apart."""
    if kind == "circle":
        return f'<circle cx="{x:.1f}" cy="{y:.1f}" r="6" fill="{colour}"/>'
    if kind == "square":
        style = f'fill="none" stroke="{colour}" stroke-width="2.5"'
        return f'<rect x="{x - 5:.1f}" y="{y - 5:.1f}" width="10" height="10" {style}/>'
    return f'<path d="M{x:.1f} {y - 9:.1f}V{y + 9:.1f}" stroke="{colour}" stroke-width="4"/>'


def draw() -> str:
    """The picture."""
    results = load_results(ROOT / "results")
    height = TOP + ROW * len(TASKS) + 34
    scale = WIDTH - LEFT - RIGHT
    parts = [
        f'<svg xmlns="http://www.w3.org/2000/svg" viewBox="0 0 {WIDTH} {height}" role="img" font-size="14" '
        'font-family="system-ui, sans-serif">',
        "<title>Success on six tasks: TBC-HRL and HiTS in this package, and TBC-HRL in the paper</title>",
        f'<rect width="{WIDTH}" height="{height}" fill="#fff"/>',
    ]
    x = LEFT
    for name, colour, kind in SERIES:
        parts.append(mark(kind, x, 20, colour) + f'<text x="{x + 12}" y="25" fill="#222">{name}</text>')
        x += 170
    for step in range(0, 11, 2):
        at = LEFT + scale * step / 10
        parts.append(f'<path d="M{at:.1f} {TOP}V{height - 30}" stroke="#ddd"/>')
        parts.append(f'<text x="{at:.1f}" y="{height - 12}" text-anchor="middle" fill="#444">{step / 10:.1f}</text>')
    for row, task in enumerate(TASKS):
        y = TOP + ROW * (row + 0.5)
        parts.append(f'<text x="{LEFT - 14}" y="{y + 5:.1f}" text-anchor="end" fill="#222">{task}</text>')
        parts.append(f'<path d="M{LEFT} {y:.1f}H{WIDTH - RIGHT}" stroke="#eee"/>')
        parts.append(mark("bar", LEFT + scale * paper(task), y, SERIES[2][1]))
        for algo, (_, colour, kind), shift in (("hits", SERIES[1], 7), ("tbc-hrl", SERIES[0], -7)):
            success = ours(results, task, algo)
            if success is not None:
                parts.append(mark(kind, LEFT + scale * success, y + shift, colour))
    return "\n".join([*parts, "</svg>"]) + "\n"


if __name__ == "__main__":
    (Path(__file__).parent / "success.svg").write_text(draw(), encoding="utf-8")
