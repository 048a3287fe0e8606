"""The planned campaign: its missing runs, and the commands that make them."""

from __future__ import annotations

import shlex
from collections.abc import Iterator, Sequence
from functools import cache
from pathlib import Path
from typing import NamedTuple

from sb3_tbc.aliases import Plain
from sb3_tbc.errors import ConfigError, nearest
from sb3_tbc.outside import one_line
from sb3_tbc.reading import read_yaml
from sb3_tbc.report.runs import SHIPPED, Results, Run
from sb3_tbc.zoo.config import ABLATIONS, N_EVAL_EPISODES, OF_PAPER, default_eval_freq, load_config

CAMPAIGN = "campaign.yml"
"""In the folder of results: ``first_seed``, ``options`` of every command, and ``runs`` with task, methods, seeds, and
``first_seed`` and ``options`` of their own."""


OF_PLAN = ("first_seed", "options", "runs")
OF_ROW = ("task", "methods", "seeds", "first_seed", "n_timesteps", "options")


class Planned(NamedTuple):
    """One row of the report as it is planned."""

    task: str
    method: str
    seeds: range
    n_timesteps: int | None  # None: those of the shipped settings
    options: list[str]

    @property
    def config(self) -> str | None:
        """Which settings are asked for by name."""
        return "paper" if self.method.endswith(OF_PAPER) else None

    @property
    def ablation(self) -> str | None:
        """What is left out or put in."""
        name = self.method.partition(" ")[2].removesuffix(OF_PAPER)
        return name if name not in ("", SHIPPED) else None

    @property
    def algo(self) -> str:
        """The algorithm."""
        return self.method.partition(" ")[0]

    def evaluated(self) -> dict[str, int]:
        """Steps of training, steps between evaluations and episodes in each, under their names in ``config.yml``."""
        steps = self.n_timesteps or _shipped_steps(self.algo, self.task, self.config, self.ablation)
        freq, episodes = self._option("--eval-freq"), self._option("--n-eval-episodes")
        counts = {"eval_freq": freq or default_eval_freq(steps), "n_eval_episodes": episodes or N_EVAL_EPISODES}
        return {"n_timesteps": steps, **counts}

    @property
    def gone(self) -> bool:
        """Whether the plan names an ablation that no longer exists: nobody can make its missing runs."""
        return self.ablation is not None and self.ablation not in ABLATIONS

    def _option(self, name: str) -> int:
        return int(self.options[self.options.index(name) + 1]) if name in self.options else 0

    def done_by(self, run: Run) -> bool:
        """Whether a run is one of these; what it does not say of itself is taken to be so."""
        known = {} if self.gone else self.evaluated()
        return run.seed in self.seeds and all(run.config.get(k, v) == v for k, v in known.items())

    def command(self) -> str:
        """The command that makes the runs; in its place a sentence where there is none."""
        if self.gone:
            return f"none: no ablation {one_line(repr(self.ablation))}; {nearest(str(self.ablation), ABLATIONS)}"
        words = ["python", "-m", "sb3_tbc.reproduce", "--tasks", self.task, "--algos", self.algo]
        words += ["--first-seed", str(self.seeds.start), "--seeds", str(len(self.seeds))]
        words += ["--config", self.config] if self.config else []
        words += ["--ablation", self.ablation] if self.ablation else []
        words += ["--n-timesteps", str(self.n_timesteps)] if self.n_timesteps else []
        return shlex.join([*words, *self.options])


@cache
def _shipped_steps(algo: str, task: str, config: str | None, ablation: str | None) -> int:
    return load_config(algo, task, config, ablation=ablation).n_timesteps


def missing_table(root: Path, results: Results) -> list[list[str]]:
    """Planned rows with missing seeds: how many are finished, and the command for the others; without a plan a header.

    A run that was trained or evaluated otherwise than planned does not count.

    :raises ConfigError: if the plan cannot be read
    """
    table = [["task", "method", "finished", "command"]]
    path = root / CAMPAIGN
    if not path.is_file():
        return table
    try:
        rows = list(_rows(read_yaml(path)))
        _check_equal(rows)
        for row in rows:
            done = sum(map(row.done_by, results.get(row.task, {}).get(row.method, [])))
            if done < len(row.seeds):
                table.append([row.task, row.method, f"{done} of {len(row.seeds)}", row.command()])
    except (KeyError, IndexError, AttributeError, TypeError, ValueError, OverflowError) as error:
        said = error if isinstance(error, ConfigError) else repr(error)
        raise ConfigError(f"cannot read the plan {path}: {said}") from error
    return table


def _rows(plan: Plain) -> Iterator[Planned]:
    _check_keys(plan, OF_PLAN, ("runs",))
    for row in plan["runs"]:
        _check_keys(row, OF_ROW, OF_ROW[:3])
        if not isinstance(row["methods"], list):
            raise ConfigError(f"methods must be a list, as [tbc-hrl, hits], got {one_line(repr(row['methods']))}")
        first, count = int((row if "first_seed" in row else plan)["first_seed"]), int(row["seeds"])
        options = _words((row if "options" in row else plan).get("options") or [])
        steps = int(row["n_timesteps"]) if "n_timesteps" in row else None
        if first < 0 or count < 1 or (steps is not None and steps < 1):
            raise ConfigError(f"first_seed is 0 or more, seeds and n_timesteps are 1 or more, got {one_line(row)}")
        for method in row["methods"]:
            yield Planned(str(row["task"]), str(method), range(first, first + count), steps, options)


def _check_keys(part: Plain, known: Sequence[str], needed: Sequence[str]) -> None:
    """Refuse keys that nobody reads: with ``n_timestep`` the plan would be one of other steps, without a word.

    :raises ConfigError: naming the first one that is unknown or missing
    """
    if unknown := [str(key) for key in part if key not in known]:
        raise ConfigError(f"unknown key {unknown[0]!r} in {one_line(part)}; {nearest(unknown[0], known)}")
    if missing := [key for key in needed if key not in part]:
        raise ConfigError(f"{missing[0]} is missing in {one_line(part)}")


def _words(options: object) -> list[str]:
    """Options of a command as single words; ``--name=value`` becomes two.

    :raises ConfigError: if they are no list, or change the number of steps, which is told of runs that are finished
    """
    if not isinstance(options, list):
        raise ConfigError(f"options must be a list of words, as [--eval-freq, '5000'], got {one_line(repr(options))}")
    texts = map(str, options)
    words = [part for text in texts for part in (text.split("=", 1) if text.startswith("--") else [text])]
    if "--n-timesteps" in words:
        raise ConfigError("options must not hold --n-timesteps: give n_timesteps in the row")
    return words


def _check_equal(rows: list[Planned]) -> None:
    """Refuse a plan in which methods of one task would be evaluated in different ways.

    :raises ConfigError: naming the task
    """
    first: dict[str, Planned] = {}
    for row in rows:
        if row.gone:
            continue
        other = first.setdefault(row.task, row)
        if other.options != row.options:
            raise ConfigError(
                f"rows of {row.task} have different options, {shlex.join(other.options)!r} and "
                f"{shlex.join(row.options)!r}; all methods of a task must be evaluated alike"
            )
        freqs = [each.evaluated()["eval_freq"] for each in (other, row)]
        if freqs[0] != freqs[1]:
            raise ConfigError(
                f"{row.task} is evaluated every {freqs[0]} steps with {other.method} and every {freqs[1]} with "
                f"{row.method}; all methods of a task must be evaluated alike: give --eval-freq in the options"
            )
