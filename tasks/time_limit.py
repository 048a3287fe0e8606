"""How long an episode may last: the one place where time limits are read."""

from __future__ import annotations

import gymnasium as gym
import numpy as np
from gymnasium.wrappers import TimeLimit

from sb3_tbc.aliases import Env


def time_limit(env: Env) -> int | None:
    """Environment steps after which an episode is truncated: the smallest limit that anything in ``env`` sets.

    Limits are set by ``TimeLimit`` wrappers (``gymnasium.make`` adds one), and by environments with an attribute
    ``max_episode_steps`` that keep it themselves. Our own tasks leave it to the wrapper where there is one and say so
    by ``truncates_itself``.

    :param env: an environment with any wrappers
    :return: None if there is no limit
    :raises ValueError: if an environment's ``max_episode_steps`` is no number of steps
    """
    limits: list[int | None] = []
    layer = env
    while isinstance(layer, gym.Wrapper):
        limits.append(layer._max_episode_steps if isinstance(layer, TimeLimit) else None)
        layer = layer.env
    declared = [limit for limit in limits if limit]
    own = _checked(getattr(layer, "max_episode_steps", None))
    if own and (getattr(layer, "truncates_itself", True)):
        declared.append(own)
    return int(min(declared)) if declared else getattr(env.spec, "max_episode_steps", None)


def declared_limit(spec: object, own: int | None, truncates_itself: bool) -> int | None:
    """As :func:`time_limit`, for an environment in another process, of which only attributes can be asked for.

    :param spec: its ``spec``; None where it has none
    :param own: its ``max_episode_steps``; None where it has none
    :param truncates_itself: false where it leaves its own limit to a wrapper
    """
    declared = getattr(spec, "max_episode_steps", None)
    own = _checked(own)
    limits = [limit for limit in (declared, own if truncates_itself or declared is None else None) if limit]
    return int(min(limits)) if limits else None


def _checked(own: object) -> int | None:
    """An environment's own ``max_episode_steps``, where 0 and None stand for no limit."""
    if own is None:
        return None
    if isinstance(own, int | float | np.integer | np.floating) and not isinstance(own, bool):
        steps = float(own)
        if steps >= 0 and steps.is_integer():  # NaN and infinity are neither
            return int(steps)
    raise ValueError(
        f"the environment's max_episode_steps must be a whole number of steps, or None for no limit, got {own!r}"
    )
