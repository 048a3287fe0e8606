"""Random-action speed of the tasks: ``python -m sb3_tbc.tasks.benchmark [TASK ...]``.

Prints, for both observation layouts, environment steps per second of processor time (waiting for a busy machine does
not count), the share of a step outside the physics engine, the ratio to a yardstick measured in the same run (MuJoCo
alone, called one sub-step at a time from Python, as the public implementations call it) and the ratio to the recorded
speed of the public implementations on another machine. Compare ratios; absolute figures follow the machine.
"""

from __future__ import annotations

import argparse
import statistics
import time
from collections.abc import Callable
from typing import Any

import gymnasium as gym
import numpy as np

from . import TASKS, register_tasks

PUBLIC = {
    "Drawbridge": 101_000,
    "Pendulum": 35_000,
    "Platforms": 21_000,
    "Tennis2D": 13_000,
    "UR5Reacher": 7_700,
    "AntFourRooms": 1_200,
}
"""Steps per second of the public implementations, random actions, one core of an AMD EPYC (2 cores, shared)."""


def steps_per_second(env: gym.Env[Any, Any], n_steps: int, seed: int = 0) -> float:
    """Speed along random actions, resets included."""
    actions = _actions(env, n_steps, seed)
    env.reset(seed=seed)
    start = time.process_time()
    for action in actions:
        _, _, terminated, truncated, _ = env.step(action)
        if terminated or truncated:
            env.reset()
    return n_steps / (time.process_time() - start)


def engine_share(env: gym.Env[Any, Any], n_steps: int, seed: int = 0) -> float:
    """Share of a step's time that is spent in advancing the physics."""
    task: Any = env.unwrapped
    advance: Callable[[list[float]], None] = task._advance
    spent = 0.0

    def timed(action: list[float]) -> None:
        nonlocal spent
        start = time.process_time()
        advance(action)
        spent += time.process_time() - start

    task._advance = timed
    try:
        speed = steps_per_second(env, n_steps, seed)
        return spent * speed / n_steps
    finally:
        del task._advance


def one_by_one(task: Any, n_steps: int, seed: int = 0) -> float:
    """Steps per second of MuJoCo alone with one call per sub-step, along random actions."""
    import mujoco

    actions = _actions(task, n_steps, seed)
    task.reset(seed=seed)
    start = time.process_time()
    for action in actions:
        task.data.ctrl[:] = action
        for _ in range(task.frame_skip):
            mujoco.mj_step(task.model, task.data)
    return n_steps / (time.process_time() - start)


def _actions(env: Any, n_steps: int, seed: int) -> np.ndarray[Any, Any]:
    rng = np.random.default_rng(seed)
    space = env.action_space
    return rng.uniform(space.low, space.high, (n_steps, *space.shape)).astype(np.float32)


def measure(task: str, seconds: float, repeats: int = 5) -> str:
    """One line of the table; medians over ``repeats`` interleaved runs."""
    envs = {layout: gym.make(f"sb3_tbc/{task}-v0", observation=layout) for layout in ("paper", "compact")}
    n_steps = max(int(seconds / repeats * steps_per_second(envs["compact"], 200)), 50)
    speeds: dict[str, list[float]] = {"paper": [], "compact": [], "alone": []}
    for repeat in range(repeats):
        for layout, env in envs.items():
            speeds[layout].append(steps_per_second(env, n_steps, repeat))
        bare: Any = envs["compact"].unwrapped
        if hasattr(bare, "frame_skip"):
            speeds["alone"].append(one_by_one(bare, n_steps, repeat))
    share = engine_share(envs["paper"], n_steps)
    middle = {name: statistics.median(values) for name, values in speeds.items() if values}
    public = PUBLIC.get(task)
    alone = f"{middle['paper'] / middle['alone']:8.2f}" if "alone" in middle else " " * 8
    ratio = f"{middle['paper'] / public:8.2f}" if public else " " * 8
    return f"{task:18s}{middle['paper']:10.0f}{middle['compact']:10.0f}{100 * (1 - share):9.0f} %{alone}{ratio}"


def main() -> None:
    """Measure and print."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("tasks", nargs="*", default=list(TASKS), metavar="TASK", help=f"of {', '.join(TASKS)}")
    parser.add_argument("--seconds", type=float, default=2.0, help="per task and layout")
    arguments = parser.parse_args()
    register_tasks()
    print(f"{'task':18s}{'paper':>10s}{'compact':>10s}{'outside':>11s}{'/alone':>8s}{'/public':>8s}")
    print(f"{'':18s}{'steps/s':>10s}{'steps/s':>10s}{'engine':>11s}")
    for task in arguments.tasks:
        print(measure(task, arguments.seconds), flush=True)


if __name__ == "__main__":
    main()
