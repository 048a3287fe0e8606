"""Making tasks in tests, and actions for them; tasks whose engine is not installed are skipped."""

import gymnasium as gym
import numpy as np
import pytest

import sb3_tbc  # noqa: F401  (registers the tasks)

ENGINES = {"Platforms": "Box2D", "Tennis2D": "Box2D", "UR5ReacherBullet": "pybullet"}


def make(task, layout="paper", **kwargs):
    """``gymnasium.make`` by the short name."""
    if task in ENGINES:
        pytest.importorskip(ENGINES[task], reason=f"{task} needs {ENGINES[task]}, which is not installed")
    return gym.make(f"sb3_tbc/{task}-v0", observation=layout, **kwargs)


def random_actions(env, n, seed=0):
    rng = np.random.default_rng(seed)
    return rng.uniform(env.action_space.low, env.action_space.high, (n, *env.action_space.shape)).astype(np.float32)
