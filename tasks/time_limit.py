"""How long an episode may last: the one place where time limits are read."""

from __future__ import annotations

import gymnasium as gym
from gymnasium.wrappers import TimeLimit

from sb3_tbc.aliases import Env


def time_limit(env: Env) -> int | None:
    """Environment steps after which an episode is truncated: the smallest limit that anything in ``env`` sets.

    Limits are set by ``TimeLimit`` wrappers (``gymnasium.make`` adds one), and by environments with an attribute
    ``max_episode_steps`` that keep it themselves. Our own tasks leave it to the wrapper where there is one and say so
    by ``truncates_itself``.

    :param env: an environment with any wrappers
    :return: None if there is no limit
    """
    limits: list[int | None] = []
    layer = env
    while isinstance(layer, gym.Wrapper):
        limits.append(layer._max_episode_steps if isinstance(layer, TimeLimit) else None)
        layer = layer.env
    declared = [limit for limit in limits if limit]
    own = getattr(layer, "max_episode_steps", None)
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
    limits = [limit for limit in (declared, own if truncates_itself or declared is None else None) if limit]
    return int(min(limits)) if limits else None
