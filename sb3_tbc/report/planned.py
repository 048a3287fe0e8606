"""The planned campaign: its missing runs, and the commands that make them."""

from __future__ import annotations

import shlex
from pathlib import Path

from sb3_tbc.aliases import Plain
from sb3_tbc.errors import ConfigError
from sb3_tbc.reading import read_yaml
from sb3_tbc.report.runs import SHIPPED, Results
from sb3_tbc.zoo.config import OF_PAPER

CAMPAIGN = "campaign.yml"
"""In the folder of results: ``first_seed``, ``options`` of every command, and ``runs`` with task, methods, seeds, and
``first_seed`` and ``options`` of their own."""


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
        _check_equal_options(plan)
        for row in plan["runs"]:
            first = _first_seed(plan, row)
            for method in row["methods"]:
                wanted = set(range(first, first + int(row["seeds"])))
                done = wanted & {run.seed for run in results.get(row["task"], {}).get(method, [])}
                if done != wanted:
                    count = f"{len(done)} of {len(wanted)}"
                    table.append([row["task"], method, count, _command(plan, row, method)])
    except (KeyError, TypeError, ValueError) as error:
        raise ConfigError(f"cannot read the plan {path}: {error!r}") from error
    return table


def _first_seed(plan: Plain, row: Plain) -> int:
    return int((row if "first_seed" in row else plan)["first_seed"])


def _options(plan: Plain, row: Plain) -> list[str]:
    return [str(word) for word in (row if "options" in row else plan).get("options") or ()]


def _check_equal_options(plan: Plain) -> None:
    """Refuse a plan in which methods of one task would be evaluated in different ways.

    :raises ConfigError: naming the task
    """
    first: dict[str, list[str]] = {}
    for row in plan["runs"]:
        options = first.setdefault(str(row["task"]), _options(plan, row))
        if options != _options(plan, row):
            raise ConfigError(
                f"rows of {row['task']} have different options, {shlex.join(options)!r} and "
                f"{shlex.join(_options(plan, row))!r}; all methods of a task must be evaluated alike"
            )


def _command(plan: Plain, row: Plain, method: str) -> str:
    algo, _, variant = method.partition(" ")
    words = ["python", "-m", "sb3_tbc.reproduce", "--tasks", row["task"], "--algos", algo]
    words += ["--first-seed", str(_first_seed(plan, row)), "--seeds", str(row["seeds"])]
    ablation, paper = variant.removesuffix(OF_PAPER), variant.endswith(OF_PAPER)
    words += ["--config", "paper"] if paper else []
    words += ["--ablation", ablation] if ablation not in ("", SHIPPED) else []
    words += ["--n-timesteps", str(row["n_timesteps"])] if "n_timesteps" in row else []
    return shlex.join([*words, *_options(plan, row)])
