"""Draw the pictures of docs/tasks.md: ``python docs/images/draw.py`` from the checkout, with the extra ``video``."""

from __future__ import annotations

import sys
from pathlib import Path

import gymnasium as gym
import imageio.v3 as imageio
import numpy as np

import sb3_tbc  # noqa: F401  (registers the tasks)

HERE = Path(__file__).parent
sys.path.insert(0, str(HERE.parents[1] / "tests"))
from scripted_policies import Roll, sail_late, servo  # noqa: E402

STAGES = {  # policy, seed, steps, live subgoal, remaining share of the window
    "AntFourRooms": ("random", 4, 12, [0.0, 5.2, 0.5, 1.4, 0.2], 0.7),
    "Drawbridge": (sail_late(280), 0, 566, [0.12, 1.0, 1.0], 0.35),
    "Pendulum": ("random", 4, 60, [0.7, -4.0], 0.6),
    "Platforms": (Roll(), 0, 225, [0.25, 0.3, -0.2, 0.5], 0.5),
    "Tennis2D": ("random", 5, 62, [0.02, 0.0, -0.25, 0.3, 0.4, 0.0], 0.8),
    "UR5Reacher": (servo, 7, 14, [0.9, -0.35, 0.1, 1.0, 0.0, 0.0], 0.45),
}


def draw(name: str) -> None:
    """One picture."""
    policy, seed, steps, subgoal, left = STAGES[name]
    env = gym.make(f"sb3_tbc/{name}-v0", observation="compact", render_mode="rgb_array")
    observation, _ = env.reset(seed=seed)
    env.action_space.seed(seed)
    for _ in range(steps):
        observation = env.step(env.action_space.sample() if policy == "random" else policy(observation))[0]
    env.unwrapped.set_overlay(subgoal, left)
    picture = env.render()
    assert picture is not None
    imageio.imwrite(HERE / f"{name}.png", np.asarray(picture))
    env.close()


if __name__ == "__main__":
    for task in sys.argv[1:] or STAGES:
        draw(task)
