#!/usr/bin/env python
"""Measure how fast each method trains and evaluates on each task, for the hours that ``reproduce --dry-run`` prints.

An agent trains until compilation and its first episodes are over, then for some seconds more, which count; then it is
evaluated. Both are steps per second of CPU time on one core. Example::

    python scripts/speeds.py --tasks Pendulum

The figures go into ``results/speeds.yml``, where those of other tasks are kept.
"""

from __future__ import annotations

import argparse
import time
from pathlib import Path

import torch as th
import yaml
from stable_baselines3.common.callbacks import BaseCallback

from sb3_tbc.aliases import Plain
from sb3_tbc.campaign.hours import SPEEDS
from sb3_tbc.commands import duration
from sb3_tbc.files import write_atomic
from sb3_tbc.reading import read_yaml
from sb3_tbc.tbc_hrl.evaluation import evaluate_agent
from sb3_tbc.zoo.algorithms import build_model
from sb3_tbc.zoo.config import OF_PAPER, load_config
from sb3_tbc.zoo.environments import make_envs, resolve_env, task_names

RESULTS = Path(__file__).parents[1] / "results"
METHODS = ("tbc-hrl", "hits", "hac", "sac", f"tbc-hrl full{OF_PAPER}")
WARM_UP = 3
"""Episodes of each environment before time counts."""
HEAD = """\
# Environment steps per second of one core's time, training and evaluation apart, as `python scripts/speeds.py` measured
# them. `reproduce --dry-run` estimates hours from them.
"""


class Stopwatch(BaseCallback):
    """Measures training from a step on, and ends it when it has measured long enough.

    :param after: environment steps before time counts
    :param seconds: of CPU time to measure
    """

    def __init__(self, after: int, seconds: float) -> None:
        super().__init__()
        self.after, self.seconds = after, seconds
        self.began: tuple[int, float] | None = None

    def _on_step(self) -> bool:
        if self.began is None:
            if self.num_timesteps >= self.after:
                self.began = self.num_timesteps, time.process_time()
            return True
        return time.process_time() - self.began[1] < self.seconds

    @property
    def speed(self) -> float:
        """Environment steps per second so far."""
        assert self.began is not None
        return (self.num_timesteps - self.began[0]) / (time.process_time() - self.began[1])


def measure(name: str, method: str, seconds: float) -> dict[str, float]:
    """Speeds of training and of evaluation.

    :param method: an algorithm, with ``full-paper`` for the paper's settings
    :param seconds: of CPU time to train for
    """
    task, env_id = resolve_env(name)
    algo, _, variant = method.partition(" ")
    run = load_config(algo, task, "paper" if variant.endswith(OF_PAPER) else None)
    env, test = make_envs(env_id, run.n_envs, 0, run.env_kwargs), make_envs(env_id, 10, 0, run.env_kwargs)
    limit = int(test.get_attr("spec", 0)[0].max_episode_steps)
    run.model["learning_starts"] = min(run.model.get("learning_starts", 0), 2 * limit * run.n_envs)
    model = build_model(run, env, 0)
    watch = Stopwatch(WARM_UP * limit * run.n_envs, seconds)
    model.learn(run.n_timesteps, callback=watch)
    trained, began = watch.speed, time.process_time()
    steps = int(evaluate_agent(model, test, 10, seed=0).lengths.sum())
    return {"train": round(trained, 1), "evaluate": round(steps / (time.process_time() - began), 1)}


def main() -> None:
    """Measure; see the module's text."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--tasks", nargs="+", default=sorted(task_names()), metavar="TASK", help="by default all")
    parser.add_argument("--methods", nargs="+", default=METHODS, choices=METHODS, metavar="METHOD")
    parser.add_argument("--seconds", type=duration, default=15.0, help="of training that count (default: %(default)s)")
    parser.add_argument("--results", type=Path, default=RESULTS / SPEEDS, help="(default: %(default)s)")
    args = parser.parse_args()
    th.set_num_threads(1)
    for task in args.tasks:
        for method in args.methods:
            found: Plain = read_yaml(args.results) if args.results.is_file() else {}
            found.setdefault(task, {})[method] = measure(task, method, args.seconds)
            print(task, method, found[task][method], flush=True)
            write_atomic(args.results, HEAD + yaml.safe_dump(found, default_flow_style=None))


if __name__ == "__main__":
    main()
