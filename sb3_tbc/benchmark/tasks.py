"""Random-action speed of the tasks: ``python -m sb3_tbc.benchmark.tasks [TASK ...] [--against MODULE:FUNCTION]``.

Prints, for both observation layouts, environment steps per second of processor time (waiting for a busy machine does
not count), the share of a step outside the physics engine, and the ratio of the paper layout to the public
implementation: to its recorded speed or, with ``--against``, to an environment timed beside ours in the same run.
Machines differ and drift, so quote only ratios of one run. ``FUNCTION(task)`` returns an environment with ``reset()``
and ``step(action)`` of the old or the new Gym interface, or ``None`` for a task it does not have.
"""

from __future__ import annotations

import argparse
import statistics
import time
from collections.abc import Callable
from importlib import import_module
from typing import Any

import gymnasium as gym
import numpy as np

from sb3_tbc.aliases import Env
from sb3_tbc.arrays import AnyArray
from sb3_tbc.commands import duration
from sb3_tbc.tasks import TASKS, register_tasks

PUBLIC = {
    "Drawbridge": 131_000,
    "Pendulum": 43_900,
    "Platforms": 35_700,
    "Tennis2D": 19_300,
    "UR5Reacher": 9_730,
    "AntFourRooms": 1_380,
}
"""Steps per second of the public implementations (martius-lab/HiTS, martius-lab/dynamic-rl-benchmarks), measured beside
ours with the same engines (MuJoCo 4.0.0, Box2D 2.3.10), no wrappers; one core of an AMD EPYC (2 cores, shared)."""

Actions = AnyArray


def steps_per_second(env: Any, actions: Actions, seed: int | None = 0) -> float:
    """Speed along given actions, resets included.

    :param env: of the old or the new Gym interface
    :param actions: ``(n_steps, action_dim)``
    :param seed: of the first reset; ``None`` for environments whose reset takes none
    """
    rows = list(actions)
    env.reset() if seed is None else env.reset(seed=seed)
    start = time.process_time()
    for action in rows:
        if any(env.step(action)[2:-1]):  # done, or terminated and truncated
            env.reset()
    return len(rows) / (time.process_time() - start)


def engine_share(env: Env, actions: Actions, seed: int = 0) -> float:
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
        speed = steps_per_second(env, actions, seed)
        return spent * speed / len(actions)
    finally:
        del task._advance


def random_actions(env: Env, n_steps: int, seed: int) -> Actions:
    """Uniform actions ``(n_steps, action_dim)`` in float32."""
    space: Any = env.action_space
    return np.random.default_rng(seed).uniform(space.low, space.high, (n_steps, *space.shape)).astype(np.float32)


def measure(task: str, seconds: float, other: Any = None, repeats: int = 7) -> str:
    """One line of the table; medians over interleaved runs on the same actions.

    :param task: of :data:`sb3_tbc.tasks.TASKS`
    :param seconds: per layout, about
    :param other: an environment to time beside ours
    :param repeats: runs of each
    """
    envs = {layout: gym.make(f"sb3_tbc/{task}-v0", observation=layout) for layout in ("paper", "compact")}
    n_steps = int(seconds / repeats * steps_per_second(envs["compact"], random_actions(envs["compact"], 200, 0)))
    speeds: dict[str, list[float]] = {"paper": [], "compact": [], "other": []}
    for repeat in range(repeats):
        actions = random_actions(envs["paper"], max(n_steps, 50), repeat)
        for layout, env in envs.items():
            speeds[layout].append(steps_per_second(env, actions, repeat))
        if other is not None:
            speeds["other"].append(steps_per_second(other, actions.astype(np.float64), None))
    middle = {name: statistics.median(values) for name, values in speeds.items() if values}
    outside = 100 * (1 - engine_share(envs["paper"], actions))
    if other is not None:
        ratio = statistics.median(a / b for a, b in zip(speeds["paper"], speeds["other"], strict=True))
        compared = f"{middle['other']:12,.0f}{ratio:8.2f}  this run"
    elif task in PUBLIC:
        compared = f"{PUBLIC[task]:12,.0f}{middle['paper'] / PUBLIC[task]:8.2f}  recorded"
    else:
        compared = ""
    return f"{task:18s}{middle['paper']:10,.0f}{middle['compact']:10,.0f}{outside:9.1f} %{compared}"


def load_function(path: str) -> Callable[[str], Any]:
    """The function named ``module:function``.

    :raises ValueError: if the name has another form, or names nothing
    """
    module, separator, function = path.partition(":")
    if not separator:
        raise ValueError(f"--against takes MODULE:FUNCTION, got {path!r}")
    try:
        found: Callable[[str], Any] = getattr(import_module(module), function)
    except (ImportError, AttributeError) as error:
        raise ValueError(f"--against {path}: {error}. Is its folder in PYTHONPATH?") from error
    return found


def main() -> None:
    """Measure and print."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("tasks", nargs="*", default=list(TASKS), metavar="TASK", help=f"of {', '.join(TASKS)}")
    parser.add_argument("--seconds", type=duration, default=2.0, help="per task and layout")
    parser.add_argument("--against", metavar="MODULE:FUNCTION", help="makes the environment to compare with")
    arguments = parser.parse_args()
    unknown = sorted(set(arguments.tasks) - set(TASKS))
    if unknown:
        parser.error(f"no task {unknown[0]!r}; there are {', '.join(TASKS)}")
    try:
        make_other = load_function(arguments.against) if arguments.against else lambda task: None
    except ValueError as error:
        parser.error(str(error))
    register_tasks()
    print(f"{'task':18s}{'paper':>10s}{'compact':>10s}{'outside':>11s}{'compared':>12s}{'ratio':>8s}")
    print(f"{'':18s}{'steps/s':>10s}{'steps/s':>10s}{'engine':>11s}{'steps/s':>12s}")
    for task in arguments.tasks:
        try:
            print(measure(task, arguments.seconds, make_other(task)), flush=True)
        except ImportError as error:
            print(f"{task:18s}skipped: {error}", flush=True)


if __name__ == "__main__":
    main()
