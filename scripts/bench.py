"""Environment steps per second of each task alone, and of training (acting and updating) on the default settings."""

from __future__ import annotations

import argparse
import time

import gymnasium as gym
import torch as th

import sb3_tbc  # noqa: F401  (registers the tasks)
from sb3_tbc.zoo.algorithms import build_model
from sb3_tbc.zoo.config import load_config
from sb3_tbc.zoo.environments import make_envs, task_names


def stepping(env_id: str, steps: int) -> float:
    """Steps per second with random actions."""
    env = gym.make(env_id)
    env.reset(seed=0)
    env.action_space.seed(0)
    actions = [env.action_space.sample() for _ in range(steps)]
    start = time.perf_counter()
    for action in actions:
        _, _, terminated, truncated, _ = env.step(action)
        if terminated or truncated:
            env.reset()
    rate = steps / (time.perf_counter() - start)
    env.close()
    return rate


def training(algo: str, task: str, steps: int) -> float:
    """Steps per second of ``learn`` after a warm-up that includes any compilation."""
    run = load_config(algo, task)
    env = make_envs(task_names()[task], 1, 0, run.env_kwargs)
    model = build_model(run, env, seed=0)
    warm_up = 2000
    model.learn(warm_up)
    start = time.perf_counter()
    model.learn(steps, reset_num_timesteps=False)
    rate = (model.num_timesteps - warm_up) / (time.perf_counter() - start)
    env.close()
    return rate


def main() -> None:
    """Print a table."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--tasks", nargs="+", default=["Pendulum", "UR5Reacher", "Drawbridge"])
    parser.add_argument("--algos", nargs="+", default=["tbc-hrl", "hits"])
    parser.add_argument("--steps", type=int, default=6000)
    args = parser.parse_args()
    th.set_num_threads(1)
    print(f"{'task':<14}{'env alone':>12}" + "".join(f"{algo:>12}" for algo in args.algos) + "   steps per second")
    for task in args.tasks:
        rates = [stepping(task_names()[task], args.steps), *(training(algo, task, args.steps) for algo in args.algos)]
        print(f"{task:<14}" + "".join(f"{rate:>12,.0f}" for rate in rates))


if __name__ == "__main__":
    main()
