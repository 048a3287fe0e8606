"""What users call with: refused in one line where it cannot be meant."""

from __future__ import annotations

from numbers import Integral, Real
from typing import Any

from stable_baselines3.common.vec_env import VecEnv, unwrap_vec_normalize


def whole_steps(total_timesteps: Any) -> int:
    """The number of environment steps to learn for.

    :raises TypeError: if it is not a whole number
    :raises ValueError: if it is negative
    """
    number = isinstance(total_timesteps, (Integral, Real)) and not isinstance(total_timesteps, bool)
    if not number or total_timesteps != total_timesteps or total_timesteps % 1 != 0:
        raise TypeError(f"total_timesteps must be a whole number of environment steps, got {total_timesteps!r}")
    if total_timesteps < 0:
        raise ValueError(f"total_timesteps must not be negative, got {total_timesteps}")
    return int(total_timesteps)


def refuse_vec_normalize(env: VecEnv) -> None:
    """Say why observations must not be normalised on the way.

    :raises ValueError: if they are
    """
    if unwrap_vec_normalize(env) is not None:
        raise ValueError(
            "VecNormalize moves the subgoal space while the agent learns; use the task's fixed scales instead"
        )
