"""What can be trained: the algorithms, and the tasks with their steps, the time of a run and the extras they need."""

from __future__ import annotations

from importlib import resources

import yaml

from sb3_tbc.aliases import Plain
from sb3_tbc.zoo.algorithms import ALGORITHMS
from sb3_tbc.zoo.config import load_config
from sb3_tbc.zoo.environments import task_names

EXTRAS = {"Platforms": "box2d", "Tennis2D": "box2d", "UR5ReacherBullet": "bullet"}
"""Task -> the extra of ``sb3_tbc`` that installs what it needs."""
ALGORITHM_TEXTS = {
    "tbc-hrl": "two levels, timed subgoals; the low level is a sparse circuit of neurons",
    "hits": "two levels, timed subgoals, MLPs",
    "hac": "two levels, subgoals without a time",
    "sac": "one level: SAC with hindsight goals",
}
MEASURED = "measured.yml"
"""File beside this module with the minutes of finished runs, written by ``python -m sb3_tbc.report --measured``."""


def measured() -> dict[str, Plain]:
    """Task -> ``steps``, ``minutes``, ``seeds`` of the committed runs with the shipped settings of ``tbc-hrl``."""
    text = resources.files("sb3_tbc.zoo").joinpath(MEASURED).read_text(encoding="utf-8")
    return dict(yaml.safe_load(text)["tasks"])


def catalogue() -> str:
    """The lists that ``train --list`` prints."""
    lines = ["tasks", f"  {'name':<17} {'steps':>10}   {'minutes':>7}   {'extra':<7} measured on"]
    runs = measured()
    for task in task_names():
        run = runs.get(task)
        minutes = f"{run['minutes']:.0f}" if run else "-"
        basis = f"{run['steps']:,} steps, {_runs(run['seeds'])}" if run else "-"
        steps = load_config("tbc-hrl", task).n_timesteps
        lines.append(f"  {task:<17} {steps:>10,}   {minutes:>7}   {EXTRAS.get(task, '-'):<7} {basis}")
    lines.append("  or any other registered goal environment, e.g. FetchReach-v4")
    lines += ["", "algorithms", *(f"  {name:<17} {ALGORITHM_TEXTS[name]}" for name in ALGORITHMS)]
    lines += ["", "steps:   environment steps of a run by default"]
    lines += ["minutes: time of a committed run of tbc-hrl with the shipped settings on one core, evaluations included"]
    lines += ["extra:   install it with pip install 'sb3_tbc[extra]'"]
    return "\n".join(lines)


def _runs(count: int) -> str:
    return f"{count} run{'s' if count > 1 else ''}"
