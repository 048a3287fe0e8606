"""What an agent asks of its environment: attributes of the task, and how long an episode lasts."""

from __future__ import annotations

from typing import Any

from stable_baselines3.common.vec_env import VecEnv


def attribute_of(env: VecEnv, name: str) -> Any:
    """Attribute of the first task under its wrappers; None where there is none."""
    try:
        return env.get_attr(name, indices=[0])[0]
    except AttributeError:
        return None


def episode_length(env: VecEnv) -> int | None:
    """Time limit of the task, environment steps; None where the environment has none."""
    steps = attribute_of(env, "max_episode_steps") or getattr(attribute_of(env, "spec"), "max_episode_steps", None)
    return None if steps is None else int(steps)
