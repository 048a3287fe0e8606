"""Measure every trained agent of the package from within, and bring docs/interpretation.md up to date.

For each agent: the figures as JSON (results/interpretation), activation in space (docs/images/inside) and, for tasks
that the page simulates, the live page (docs/_static/inside). The MLP ablation of two tasks is measured beside them; its
runs are trained where they are not there. ``--table`` only writes the page's table from the figures that are there.
"""

from __future__ import annotations

import argparse
import json
import sys
from pathlib import Path
from typing import Any

from sb3_tbc import train
from sb3_tbc.interpret import command as interpret
from sb3_tbc.interpret.findings import PAPER
from sb3_tbc.interpret.page import SIMULATED
from sb3_tbc.pretrained import pretrained_names
from sb3_tbc.report.markdown import update_page
from sb3_tbc.zoo.ledger import RunFolder

ROOT = Path(__file__).parents[1]
FIGURES, IMAGES = ROOT / "results" / "interpretation", ROOT / "docs" / "images" / "inside"
LIVE, PAGE = ROOT / "docs" / "_static" / "inside", ROOT / "docs" / "interpretation.md"
MARKS = ("<!-- figures:begin -->", "<!-- figures:end -->")
MLP = {"Pendulum": 100_000, "UR5Reacher": 90_000}
"""Tasks whose MLP ablation is measured, and the steps of its run."""
N_EPISODES = {"Tennis2D": "100"}
"""Held-out episodes of agents that seldom succeed, where twenty would say nothing about lesions; 20 for the others."""


def main() -> int:
    """Measure, draw and write."""
    parser = argparse.ArgumentParser("interpretation", description=__doc__)
    parser.add_argument("agents", nargs="*", help="by default all of the package, and TASK-mlp for the ablations")
    parser.add_argument("--runs", type=Path, default=Path("runs/pretrained"), help="folder of the ablations' runs")
    parser.add_argument("--n-episodes", help="held-out episodes; by default 20, for Tennis2D 100")
    parser.add_argument("--table", action="store_true", help="write the table alone")
    args = parser.parse_args()
    for name in [] if args.table else args.agents or [*pretrained_names(), *(f"{task}-mlp" for task in MLP)]:
        task, is_mlp = name.removesuffix("-mlp"), name.endswith("-mlp")
        agent = str(ablation(task, args.runs)) if is_mlp else f"pretrained:{task}"
        out = ["--json", str(FIGURES / f"{name}.json"), "--n-episodes", args.n_episodes or N_EPISODES.get(task, "20")]
        out += [] if is_mlp else ["--png", str(IMAGES / f"{task}.png")]
        out += ["--html", str(LIVE / f"{task}.html")] if task in SIMULATED and not is_mlp else []
        if status := interpret.main([agent, *out]):
            return status
    write_table()
    return 0


def ablation(task: str, runs: Path) -> Path:
    """The agent of a task's finished MLP run."""
    folder = RunFolder.for_run(runs, task, "tbc-hrl", "no-ndbc", 7)
    if not (folder.path / "final.json").is_file():
        start = ["--env", task, "--ablation", "no-ndbc", "--seed", "7", "--log-folder", str(runs)]
        if status := train.main([*start, "--n-timesteps", str(MLP[task])]):
            sys.exit(status)
    return folder.model


def write_table() -> None:
    """Replace what stands between the marks of the page."""
    rows = ["| agent | success | 5 most active to rest | 5 random | 5 most active to their means | 5 random "
            "| mean abs r | shifted | bits, mean | bits, 90 % | shifted |"]  # fmt: skip
    rows.append("|" + "---|" * 11)
    drop, correlation = PAPER["drop_top5"], PAPER["mean_correlation"]
    rows.append(
        f"| *paper, UR5Reacher* | | *{drop:.1%}* | | | | *{correlation:.2f}* | | *{PAPER['information_mean']:.2f}* "
        f"| *{PAPER['information_p90']:.2f}* | |"
    )
    rows += [_row(path.stem, json.loads(path.read_text())) for path in sorted(FIGURES.glob("*.json"))]
    update_page(PAGE, "\n".join(rows), MARKS)


def _row(name: str, figures: dict[str, Any]) -> str:
    s = figures["summary"]
    drops = [_percent(s[f"drop_{what}5_{form}"]) for form in ("rest", "mean") for what in ("top", "random")]
    numbers = [f"{s[key]:.2f}" for key in ("mean_correlation", "mean_correlation_control")]
    bits = ("information_mean", "information_p90", "information_control")
    numbers += ["-" if s[key] is None else f"{s[key]:.2f}" for key in bits]
    return f"| {name} | {figures['success_rate']:.2f} | {' | '.join([*drops, *numbers])} |"


def _percent(value: float | None) -> str:
    return "-" if value is None else f"{value:.0%}"


if __name__ == "__main__":
    sys.exit(main())
