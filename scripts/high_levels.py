#!/usr/bin/env python
"""Compare SB3's and sb3-contrib's algorithms as the high level over one trained low level.

The low level of a trained agent stays as it is; each algorithm learns to choose its subgoals and time budgets from
nothing, and is evaluated as a whole agent. Example::

    python scripts/high_levels.py pretrained:Pendulum --options 3000 --seeds 0 1 2

Prints one line per algorithm and seed, the mean over seeds with its interval, and the agent's own high level for
comparison.
"""

from __future__ import annotations

import argparse
from typing import Any

import torch as th
from sb3_contrib import TQC, CrossQ
from stable_baselines3 import PPO, SAC
from stable_baselines3.common.env_util import make_vec_env
from stable_baselines3.common.vec_env import VecEnv

from sb3_tbc import TBCHRL
from sb3_tbc.evaluate import identify
from sb3_tbc.pretrained import model_path
from sb3_tbc.stats import bootstrap_mean
from sb3_tbc.tbc_hrl.evaluation import evaluate_agent
from sb3_tbc.tbc_hrl.option_env import OptionEnv
from sb3_tbc.zoo.algorithms import load_two_levels
from sb3_tbc.zoo.environments import make_env

ALGORITHMS: dict[str, Any] = {"SAC": SAC, "TQC": TQC, "CrossQ": CrossQ, "PPO": PPO}
EPISODES = 50
EVAL_SEED = 1_000_000


def vector(info: dict[str, Any], n_envs: int, seed: int) -> VecEnv:
    """Environments of the agent's own task."""
    return make_vec_env(lambda: make_env(info["env_id"], **info["env_kwargs"]), n_envs, seed=seed)


def success(agent: TBCHRL, info: dict[str, Any], seed: int) -> float:
    """Success rate of an agent in fresh episodes."""
    env = vector(info, 10, EVAL_SEED + seed)
    try:
        return evaluate_agent(agent, env, EPISODES, seed=EVAL_SEED + seed).success_rate
    finally:
        env.close()


def train(name: str, agent: TBCHRL, info: dict[str, Any], options: int, seed: int) -> TBCHRL:
    """An agent whose high level was trained on a number of options."""
    env = OptionEnv(vector(info, 4, seed), agent, seed=seed)
    shared = {"seed": seed, "gamma": agent.config.high.gamma, "policy_kwargs": {"net_arch": [64, 64]}}
    own = {"n_steps": 64} if name == "PPO" else {"learning_starts": 100, "train_freq": 1, "gradient_steps": 4}
    high = ALGORITHMS[name]("MlpPolicy", env, **shared, **own).learn(options)
    return TBCHRL.from_levels(high, agent)


def main() -> None:
    """Compare; see the module's text."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("model", type=model_path, metavar="MODEL", help="a trained agent's .zip, or pretrained:TASK")
    parser.add_argument("--algorithms", nargs="+", choices=sorted(ALGORITHMS), default=["SAC", "TQC", "CrossQ"])
    parser.add_argument("--options", type=int, default=3000, help="options to learn from (default: %(default)s)")
    parser.add_argument("--seeds", type=int, nargs="+", default=[0], help="seeds of the high levels (default: 0)")
    parser.add_argument("--trust", action="store_true", help="load the agent even if its file can run code")
    args = parser.parse_args()
    th.set_num_threads(1)
    info, agent = identify(args.model, None), load_two_levels(args.model, trust=args.trust)
    print(f"{'own high level':16} success {success(agent, info, 0):.2f} in {EPISODES} episodes")
    for name in args.algorithms:
        rates = []
        for seed in args.seeds:
            rates.append(success(train(name, agent, info, args.options, seed), info, seed))
            print(f"{name:9} seed {seed}  success {rates[-1]:.2f} after {args.options} options", flush=True)
        mean = bootstrap_mean(rates)
        print(f"{name:9} mean    success {mean.mean:.2f} [{mean.low:.2f}, {mean.high:.2f}]", flush=True)


if __name__ == "__main__":
    main()
