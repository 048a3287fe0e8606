#!/usr/bin/env python
"""Tasks without a section of their own: TBC-HRL as it comes beside Stable-Baselines3's SAC with hindsight replay.

TBC-HRL has the settings that ``sb3_tbc.train --env ID`` gives it. SAC has Stable-Baselines3's defaults, with
``HerReplayBuffer`` and 1,000 random steps at first, and learns in the environment as ``gymnasium.make`` gives it. Both
are evaluated on the same episodes, which success ends. CPU time is that of learning, with compilation and without
evaluation.
Example::

    python scripts/foreign_tasks.py --output docs/your_task.md

Each finished run is kept in a file (``--results``), so that a stopped comparison goes on where it was.
"""

from __future__ import annotations

import argparse
import json
import os
import sys
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import torch as th
from stable_baselines3 import SAC, HerReplayBuffer
from stable_baselines3.common.base_class import BaseAlgorithm
from stable_baselines3.common.callbacks import BaseCallback
from stable_baselines3.common.env_util import make_vec_env
from stable_baselines3.common.evaluation import evaluate_policy
from stable_baselines3.common.vec_env import VecEnv

from sb3_tbc import TBCHRL
from sb3_tbc.aliases import Plain
from sb3_tbc.files import write_atomic
from sb3_tbc.report.markdown import update_page
from sb3_tbc.tbc_hrl.evaluation import evaluate_hierarchical
from sb3_tbc.zoo.algorithms import build_model
from sb3_tbc.zoo.config import load_config, parse_overrides
from sb3_tbc.zoo.environments import make_envs, resolve_env

DOCS = Path(__file__).parents[1] / "docs"
AGENTS = {"tbc-hrl": "TBC-HRL, no section of its own", "sac": "SB3's SAC with hindsight replay"}
EPISODES = 20
GOAL = 0.95
"""Success rate of an evaluation that counts as learned."""


AFTERWARDS = 2
"""Evaluations after the first of :data:`GOAL`, to see how well an agent does when it has learned."""


class Plan(NamedTuple):
    """How long agents learn on a task."""

    steps: int
    every: int  # steps between two evaluations
    seeds: tuple[int, ...]
    minutes: float = 60.0  # of CPU time
    to_goal: bool = False  # whether a run ends soon after the first evaluation of GOAL


TASKS = {
    "FetchReach-v4": Plan(12_000, 1_000, tuple(range(100, 105)), to_goal=True),
    "PointMaze_UMaze-v3": Plan(20_000, 1_000, tuple(range(100, 105)), to_goal=True),
    "FetchPush-v4": Plan(200_000, 5_000, (100,), 10.0),
    "AntMaze_UMaze-v5": Plan(200_000, 5_000, (100,), 10.0),
}
LEARNED, CURVES = list(TASKS)[:2], list(TASKS)[2:]
"""Tasks whose first evaluation of :data:`GOAL` is told, and tasks whose learning curve is."""


class Point(NamedTuple):
    """One evaluation."""

    steps: int
    cpu: float  # seconds of CPU time spent on learning
    success: float
    length: float | None  # mean steps of a success


def cpu_seconds() -> float:
    """CPU time of this process and of the compilers that it called."""
    return sum(os.times()[:4])


class Watch(BaseCallback):
    """Evaluates every so many steps; the time that it takes is not counted.

    :param plan: how often, and how long
    :param evaluate: gives the success rate, and the mean steps of a success
    :param started: CPU time before the agent was built
    """

    def __init__(
        self, plan: Plan, evaluate: Callable[[BaseAlgorithm, int], tuple[float, float | None]], started: float
    ) -> None:
        super().__init__()
        self.plan, self.evaluate, self.started = plan, evaluate, started
        self.points: list[Point] = []

    def _on_step(self) -> bool:
        if self.num_timesteps < self.plan.every * (len(self.points) + 1):
            return True
        paused = cpu_seconds()
        spent = paused - self.started
        success, length = self.evaluate(self.model, 1000 * len(self.points))
        self.points.append(Point(self.num_timesteps, round(spent, 1), success, length))
        print(*self.points[-1], file=sys.stderr, flush=True)
        self.started += cpu_seconds() - paused
        learned = self.plan.to_goal and any(p.success >= GOAL for p in self.points[: -AFTERWARDS or None])
        return spent < 60 * self.plan.minutes and not learned


def two_levels(model: BaseAlgorithm, env: VecEnv, seed: int) -> tuple[float, float | None]:
    """Success rate and mean steps of a success of a two-level agent."""
    assert isinstance(model, TBCHRL)
    result = evaluate_hierarchical(model, env, EPISODES, seed=seed)
    return result.success_rate, result.mean_length_success


def one_level(model: BaseAlgorithm, env: VecEnv, seed: int) -> tuple[float, float | None]:
    """The same of an agent of Stable-Baselines3."""
    ends: list[bool] = []

    def note(local: dict[str, Any], _: object) -> None:
        if local["done"]:
            ends.append(bool(local["info"]["is_success"]))

    env.seed(seed)
    _, lengths = evaluate_policy(model, env, EPISODES, callback=note, return_episode_rewards=True)
    won = np.asarray(lengths)[ends]
    return float(np.mean(ends)), float(won.mean()) if len(won) else None


def trial(task: str, agent: str, seed: int, plan: Plan, changed: Sequence[str] = ()) -> list[Point]:
    """The evaluations of one run.

    :param changed: settings of TBC-HRL that are not the shipped ones, ``key:value``
    """
    name, env_id = resolve_env(task)
    run = load_config("tbc-hrl", name, overrides=parse_overrides(changed))
    eval_env = make_envs(env_id, 10, 0, run.env_kwargs)  # also measures random episodes, which both agents need
    started = cpu_seconds()
    evaluate = two_levels if agent == "tbc-hrl" else one_level
    watch = Watch(plan, lambda model, k: evaluate(model, eval_env, 100_000_000 + 1_000_000 * seed + k), started)
    model: BaseAlgorithm
    if agent == "tbc-hrl":
        model = build_model(run, make_envs(env_id, 1, seed, run.env_kwargs), seed)
    else:
        env = make_vec_env(env_id, seed=seed)
        buffer: Plain = {"replay_buffer_class": HerReplayBuffer, "learning_starts": 1000}
        model = SAC("MultiInputPolicy", env, seed=seed, device="cpu", **buffer)
    model.learn(plan.steps, callback=watch)
    return watch.points


def first(points: Sequence[Point]) -> Point | None:
    """The first evaluation of :data:`GOAL`."""
    return next((point for point in points if point.success >= GOAL), None)


def span(values: Sequence[float | None], digits: int = 0) -> str:
    """Mean, lowest and highest; values that were never reached are named."""
    known = [value for value in values if value is not None]
    if not known:
        return "never"
    low, mean, high = (f"{f(known):,.{digits}f}" for f in (np.min, np.mean, np.max))
    told = low if low == high else f"{mean} ({low} to {high})"
    missing = len(values) - len(known)
    return f"{told}; {missing} of {len(values)} never" if missing else told


def learned(found: Plain) -> str:
    """For each of the easier tasks and each agent: when it had learned, and how well, as Markdown."""
    columns = ("task", "agent", "seeds", f"steps to {GOAL:.2f}", "CPU seconds to it", "steps of a success at the end")
    lines = [f"| {' | '.join(columns)} |", "|---" * len(columns) + "|"]
    for task in LEARNED:
        for agent, name in AGENTS.items():
            runs = runs_of(found, task, agent)
            if runs:
                firsts = [first(run) for run in runs]
                steps, cpu = ([point and point[k] for point in firsts] for k in (0, 1))
                last = [run[-1].length for run in runs]
                cells = (f"`{task}`", name, str(len(runs)), span(steps), span(cpu), span(last, 1))
                lines.append(f"| {' | '.join(cells)} |")
    return "\n".join(lines)


def curves(found: Plain) -> str:
    """Success of the harder tasks at equal steps and after equal CPU time, as Markdown."""
    parts = []
    for task in CURVES:
        runs = {agent: runs_of(found, task, agent) for agent in AGENTS}
        if all(runs.values()):
            one = {agent: several[0] for agent, several in runs.items()}
            parts += [_curve(task, "1,000 steps", one, 0, 1000.0), _curve(task, "CPU minutes", one, 1, 60.0)]
    return "\n\n".join(parts)


def _curve(task: str, unit: str, runs: dict[str, Sequence[Point]], column: int, per: float) -> str:
    """One line for each agent; marks up to where the shorter run ends."""
    end = min(run[-1][column] for run in runs.values()) / per
    sixths = [round(end * k / 6) for k in range(1, 7)]
    marks = [mark for mark in (1, 2, 4, 6, 8, 10) if mark <= end] if column else sixths
    lines = [f"| `{task}`, {unit} | {' | '.join(map(str, marks))} |", "|---" * (1 + len(marks)) + "|"]
    for agent, run in runs.items():
        done = [[point.success for point in run if point[column] <= mark * per] for mark in marks]
        lines.append(f"| {AGENTS[agent]} | {' | '.join(f'{s[-1]:.2f}' if s else '-' for s in done)} |")
    return "\n".join(lines)


def runs_of(found: Plain, task: str, agent: str) -> list[list[Point]]:
    """The runs of an agent on a task, by seed."""
    keys = (f"{task} {agent} {seed}" for seed in TASKS[task].seeds)
    return [[Point(*row) for row in found[key]] for key in keys if key in found]


def text_of(found: Plain) -> str:
    """Everything that stands between the page's marks."""
    return "\n\n".join(part for part in (learned(found), curves(found)) if part)


def main() -> None:
    """Compare; see the module's text."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--tasks", nargs="+", choices=list(TASKS), default=list(TASKS), metavar="TASK")
    parser.add_argument("--agents", nargs="+", choices=list(AGENTS), default=list(AGENTS), metavar="AGENT")
    parser.add_argument("--seeds", type=int, nargs="+", help="by default those of the tables")
    parser.add_argument(
        "--hyperparams", nargs="+", default=[], metavar="KEY:VALUE", help="changes of TBC-HRL's settings"
    )
    parser.add_argument("--results", type=Path, default=DOCS / "foreign_tasks.json", help="(default: %(default)s)")
    parser.add_argument("--output", type=Path, help="the page whose tables are renewed; by default they are printed")
    parser.add_argument("--most", type=int, metavar="N", help="stop after so many runs; the next call goes on")
    args = parser.parse_args()
    th.set_num_threads(1)
    waiting = [(t, a, s) for t in args.tasks for s in args.seeds or TASKS[t].seeds for a in args.agents]
    waiting = [run for run in waiting if " ".join(map(str, run)) not in read(args.results)]
    for task, agent, seed in waiting[: args.most]:
        points = trial(task, agent, seed, TASKS[task], args.hyperparams)
        found = {**read(args.results), f"{task} {agent} {seed}": points}
        write_atomic(args.results, json.dumps(dict(sorted(found.items())), indent=1) + "\n")
    text = text_of(read(args.results))
    if args.output is None:
        print(text)
    else:
        update_page(args.output, text, ("<!-- foreign -->", "<!-- end -->"))


def read(results: Path) -> Plain:
    """The runs that are finished."""
    found: Plain = json.loads(results.read_text(encoding="utf-8")) if results.is_file() else {}
    return found


if __name__ == "__main__":
    main()
