"""Tables 2 and 3 from a folder of results."""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from sb3_tbc import stats
from sb3_tbc.errors import ConfigError
from sb3_tbc.report.plotting import Curve, common_grid
from sb3_tbc.zoo.callbacks import EvaluationRow
from sb3_tbc.zoo.ledger import finished_runs

OURS = "tbc-hrl"


class Run(NamedTuple):
    """A finished run: its ``final.json`` and its learning curve."""

    final: dict[str, Any]
    rows: list[EvaluationRow]

    @property
    def method(self) -> str:
        """The algorithm, with the variant where it is not the full one."""
        algo, variant = str(self.final["algo"]), str(self.final["variant"])
        return algo if variant == "full" else f"{algo} {variant}"

    @property
    def curve(self) -> Curve:
        """Success rate against steps."""
        return Curve([row.timesteps for row in self.rows], [row.success_rate for row in self.rows])


Results = dict[str, dict[str, list[Run]]]
"""Task -> method -> runs, one per seed."""


def load_results(root: Path) -> Results:
    """All finished runs below a folder.

    :raises ConfigError: if there is none or one cannot be read
    """
    results: Results = defaultdict(lambda: defaultdict(list))
    for folder in finished_runs(root):
        try:
            run = Run(folder.read_final(), folder.read_evaluations())
            results[str(run.final["task"])][run.method].append(run)
        except (KeyError, ValueError, TypeError) as error:
            raise ConfigError(f"cannot read the run in {folder.path}: {error!r}") from error
    if not results:
        raise ConfigError(f"no finished runs below {root}: expected <task>/<algo>/<variant>/seed_<n>/final.json")
    return {task: {m: methods[m] for m in sorted(methods, key=_rank)} for task, methods in sorted(results.items())}


def _rank(method: str) -> tuple[bool, str]:
    return not method.startswith(OURS), method


def successes(runs: Sequence[Run]) -> list[float]:
    """Final success rate of each seed."""
    return [float(run.final["success_rate"]) for run in runs]


def strongest_baseline(methods: Mapping[str, Sequence[Run]]) -> str | None:
    """The method with the best mean that is neither ours nor an ablation of ours."""
    others = [m for m in methods if not m.startswith(OURS)]
    return max(others, key=lambda m: float(np.mean(successes(methods[m]))), default=None)


def convergence_gain(ours: Sequence[Run], baseline: Sequence[Run]) -> int | None:
    """Environment steps saved to a common success threshold, 0.9 of the smaller of both best mean success rates.

    :return: positive when ours is there earlier; ``None`` without curves
    """
    curves = [[run.curve for run in runs if run.rows] for runs in (ours, baseline)]
    if not all(curves):
        return None
    means = [(grid, values.mean(axis=0)) for grid, values in (common_grid(c, 400) for c in curves)]
    threshold = 0.9 * min(mean.max() for _, mean in means)
    first, second = (stats.steps_to(grid.astype(int).tolist(), mean.tolist(), threshold) for grid, mean in means)
    return None if first is None or second is None else second - first


def success_table(results: Results) -> list[list[str]]:
    """Table 2 and 3: per task and method the mean over seeds, its interval, and how the agents behave."""
    header = [
        "task",
        "method",
        "seeds",
        "success",
        "sd",
        "95 % interval",
        "length",
        "subgoals",
        "window",
        "to 0.9",
        "stable",
        "worst",
    ]
    table = [header]
    for task, methods in results.items():
        table += [_success_row(task, method, runs) for method, runs in methods.items()]
    return table


def _success_row(task: str, method: str, runs: Sequence[Run]) -> list[str]:
    values = successes(runs)
    interval = stats.bootstrap_mean(values)
    first = [stats.steps_to(*run.curve, 0.9) for run in runs]
    reached = [steps for steps in first if steps is not None]
    to_90 = f"{np.mean(reached) / 1000:.0f} k" if len(reached) == len(runs) else f"{len(reached)} of {len(runs)} seeds"
    return [
        task,
        method,
        str(len(runs)),
        f"{interval.mean:.3f}",
        f"{np.std(values, ddof=1):.3f}" if len(values) > 1 else "-",
        f"{interval.low:.3f} to {interval.high:.3f}" if len(values) > 1 else "-",
        _mean(runs, "mean_length_success", "{:.0f}"),
        _mean(runs, "subgoal_success", "{:.2f}"),
        _mean(runs, "mean_window", "{:.1f}"),
        to_90,
        _mean(runs, "stable_share", "{:.2f}"),
        _worst(runs),
    ]


def _worst(runs: Sequence[Run]) -> str:
    values = [run.final["worst_after_first_90"] for run in runs if run.final.get("worst_after_first_90") is not None]
    return f"{min(values):.2f}" if values else "-"


def _mean(runs: Sequence[Run], key: str, form: str) -> str:
    values = [run.final[key] for run in runs if run.final.get(key) is not None]
    return form.format(np.mean(values)) if values else "-"


def comparison_table(results: Results) -> list[list[str]]:
    """Ours against each task's strongest baseline: Welch on seeds, Holm over tasks, Cliff's delta, steps saved."""
    table = [["task", "against", "difference", "p", "p (Holm)", "", "Cliff's delta", "steps saved"]]
    baselines = {task: strongest_baseline(methods) for task, methods in results.items() if OURS in methods}
    pairs = {task: name for task, name in baselines.items() if name is not None}
    ours = {task: successes(results[task][OURS]) for task in pairs}
    theirs = {task: successes(results[task][name]) for task, name in pairs.items()}
    for task, c in stats.compare(ours, theirs).items():
        gain = convergence_gain(results[task][OURS], results[task][pairs[task]])
        numbers = [f"{c.difference:+.3f}", f"{c.p_value:.3g}", f"{c.p_holm:.3g}", c.mark, f"{c.cliffs_delta:+.2f}"]
        table.append([task, pairs[task], *numbers, "-" if gain is None else f"{gain:,}"])
    return table


def to_text(table: Sequence[Sequence[str]]) -> str:
    """A table as Markdown with aligned columns."""
    widths = [max(len(row[i]) for row in table) for i in range(len(table[0]))]
    lines = ["| " + " | ".join(cell.ljust(w) for cell, w in zip(row, widths, strict=True)) + " |" for row in table]
    return "\n".join([lines[0], "|" + "|".join("-" * (w + 2) for w in widths) + "|", *lines[1:]])
