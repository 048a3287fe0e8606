#!/usr/bin/env python
"""Compare memoryless SAC and NDBCSAC on Pendulum without velocities, and write the table of docs/recurrent_sac.md.

``Pendulum-v1`` shows cosine, sine and velocity; here the velocity is hidden. Every agent gets the same number of steps
and updates, networks of the same width, and the same 50 evaluation episodes. Example::

    python scripts/recurrent_sac.py --output docs/recurrent_sac.md

Each finished run is kept in a file (``--results``), so that a stopped comparison goes on where it was; the settings
are those that rl-zoo3 has for Pendulum and SAC, where it has any; the rest was tried on seed 10.
"""

from __future__ import annotations

import argparse
import json
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import gymnasium as gym
import numpy as np
import torch as th
from gymnasium.wrappers import TransformObservation
from stable_baselines3 import SAC
from stable_baselines3.common.env_util import make_vec_env
from stable_baselines3.common.evaluation import evaluate_policy

from sb3_tbc import NDBCSAC
from sb3_tbc.aliases import Env, Plain
from sb3_tbc.files import write_atomic
from sb3_tbc.report.markdown import update_page
from sb3_tbc.stats import bootstrap_mean, welch_test

DOCS = Path(__file__).parents[1] / "docs"
NAMES = {
    "sac": "SAC, memoryless",
    "ndbc": "NDBCSAC, NDBC circuit",
    "gru": "NDBCSAC, GRU",
}
SHARED: Plain = {"learning_rate": 1e-3, "learning_starts": 1000, "train_freq": 2, "gradient_steps": 1, "device": "cpu"}
SEQUENCES: Plain = {"sequence_length": 8, "burn_in": 3}
"""Of a Pendulum's past, three steps say everything."""
N_SEQUENCES = 32
BATCH = N_SEQUENCES * (SEQUENCES["sequence_length"] - SEQUENCES["burn_in"])
"""Transitions of each update, for all agents."""
EVERY = 2500
EPISODES = 50


def make_task() -> Env:
    """Pendulum without velocities."""
    box = gym.spaces.Box(-1.0, 1.0, (2,), np.float32)
    return TransformObservation(gym.make("Pendulum-v1"), lambda observation: observation[:2], box)


def make_agent(kind: str, seed: int) -> SAC:
    """An agent of one kind, untrained."""
    env = make_vec_env(make_task, 1, seed=seed)
    if kind in ("ndbc", "gru", "ltc", "cfc"):
        policy = {"net_arch": [64, 64], "cell": kind}
        own: Plain = {"batch_size": N_SEQUENCES, "replay_buffer_kwargs": SEQUENCES, "policy_kwargs": policy}
        return NDBCSAC("MlpPolicy", env, seed=seed, **own, **SHARED)
    return SAC("MlpPolicy", env, batch_size=BATCH, policy_kwargs={"net_arch": [64, 64]}, seed=seed, **SHARED)


def trial(kind: str, seed: int, steps: int) -> Plain:
    """Mean return of each evaluation while an agent learns, its updates, and the size of its actor."""
    agent, returns = make_agent(kind, seed), []
    for _ in range(steps // EVERY):
        agent.learn(EVERY, reset_num_timesteps=False)
        test = make_vec_env(make_task, 10, seed=1_000_000)
        returns.append(round(float(evaluate_policy(agent, test, EPISODES)[0]), 1))  # type: ignore[arg-type]
        print(kind, seed, agent.num_timesteps, returns[-1], file=sys.stderr, flush=True)
    parameters = sum(p.numel() for p in agent.actor.parameters())
    return {"returns": returns, "updates": agent._n_updates, "actor_parameters": parameters}


def table(found: dict[str, Plain], seeds: Sequence[int], steps: int) -> str:
    """Mean return over seeds with its interval, after 5,000, 10,000, ... steps, as Markdown."""
    columns = range(5000, steps + 1, 5000)
    lines = [f"| agent | actor's parameters | {' | '.join(f'{n:,} steps' for n in columns)} |"]
    lines.append("|---" * (2 + len(columns)) + "|")
    for kind, name in NAMES.items():
        runs = [found[key] for key in (f"{kind} {seed}" for seed in seeds) if key in found]
        if runs:
            cells = [_cell([run["returns"][: n // EVERY] for run in runs], n, len(seeds)) for n in columns]
            lines.append(f"| {name} | {runs[0]['actor_parameters']:,} | {' | '.join(cells)} |")
    return "\n".join(lines)


def tests(found: dict[str, Plain], seeds: Sequence[int], steps: int) -> str:
    """Welch's test of the last returns of each kind of agent against memoryless SAC, in a sentence."""
    ends: dict[str, list[float]] = {kind: [] for kind in NAMES}
    for key, run in found.items():
        kind, seed = key.split()
        if kind in ends and int(seed) in seeds:
            ends[kind].append(run["returns"][: steps // EVERY][-1])
    others = [kind for kind in NAMES if kind != "sac" and len(ends[kind]) > 1 and len(ends["sac"]) > 1]
    told = [f"{NAMES[kind]} p = {welch_test(ends[kind], ends['sac']):.3f}" for kind in others]
    return f"Welch's test against SAC without memory, after {steps:,} steps: {', '.join(told)}."


def _cell(curves: Sequence[Sequence[float]], steps: int, n_seeds: int) -> str:
    """The last values of curves that are so long, if there is one for each seed."""
    values = [curve[-1] for curve in curves if len(curve) == steps // EVERY]
    if len(values) < n_seeds:
        return "-"
    mean = bootstrap_mean(values)
    return f"{mean.mean:.0f} [{mean.low:.0f}, {mean.high:.0f}]"


def main() -> None:
    """Compare; see the module's text."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--kinds", nargs="+", choices=[*NAMES, "ltc", "cfc"], default=list(NAMES))
    parser.add_argument("--seeds", type=int, nargs="+", default=list(range(5)))
    parser.add_argument("--steps", type=int, default=15_000, help="environment steps (default: %(default)s)")
    parser.add_argument("--results", type=Path, default=DOCS / "recurrent_sac.json", help="(default: %(default)s)")
    parser.add_argument("--output", type=Path, help="the page whose table is renewed; by default it is printed")
    parser.add_argument("--most", type=int, metavar="N", help="stop after so many runs; the next call goes on")
    args = parser.parse_args()
    th.set_num_threads(1)
    found: dict[str, Any] = json.loads(args.results.read_text()) if args.results.is_file() else {}
    long_enough = [key for key, run in found.items() if len(run["returns"]) >= args.steps // EVERY]
    waiting = [(kind, seed) for seed in args.seeds for kind in args.kinds if f"{kind} {seed}" not in long_enough]
    for kind, seed in waiting[: args.most]:
        found[f"{kind} {seed}"] = trial(kind, seed, args.steps)
        write_atomic(args.results, json.dumps(dict(sorted(found.items())), indent=1) + "\n")
    text = f"{table(found, args.seeds, args.steps)}\n\n{tests(found, args.seeds, args.steps)}"
    if args.output is None:
        print(text)
    else:
        update_page(args.output, text, ("<!-- table -->", "<!-- end -->"))


if __name__ == "__main__":
    main()
