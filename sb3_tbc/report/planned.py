"""The planned campaign: its missing runs, and the commands that make them."""

from __future__ import annotations

import shlex
from pathlib import Path

from sb3_tbc.aliases import Plain
from sb3_tbc.errors import ConfigError
from sb3_tbc.reading import read_yaml
from sb3_tbc.report.runs import SHIPPED, Results

CAMPAIGN = "campaign.yml"
"""In the folder of results: ``first_seed``, ``options`` of every command, and ``runs`` with task, methods, seeds."""


def missing_table(root: Path, results: Results) -> list[list[str]]:
    """Planned rows with missing seeds: how many are finished, and the command for the others; without a plan a header.

    :raises ConfigError: if the plan cannot be read
    """
    table = [["task", "method", "finished", "command"]]
    path = root / CAMPAIGN
    if not path.is_file():
        return table
    try:
        plan = read_yaml(path)
        first = int(plan["first_seed"])
        for row in plan["runs"]:
            for method in row["methods"]:
                wanted = set(range(first, first + int(row["seeds"])))
                done = wanted & {run.seed for run in results.get(row["task"], {}).get(method, [])}
                if done != wanted:
                    count = f"{len(done)} of {len(wanted)}"
                    table.append([row["task"], method, count, _command(plan, row, method)])
    except (KeyError, TypeError, ValueError) as error:
        raise ConfigError(f"cannot read the plan {path}: {error!r}") from error
    return table


def _command(plan: Plain, row: Plain, method: str) -> str:
    algo, _, variant = method.partition(" ")
    words = ["python", "-m", "sb3_tbc.reproduce", "--tasks", row["task"], "--algos", algo]
    words += ["--first-seed", str(plan["first_seed"]), "--seeds", str(row["seeds"])]
    if variant == f"{SHIPPED}-paper":
        words += ["--config", "paper"]
    elif variant:
        words += ["--ablation", variant]
    words += ["--n-timesteps", str(row["n_timesteps"])] if "n_timesteps" in row else []
    return shlex.join([*words, *map(str, plan.get("options", []))])
