"""Settings of a level: defaults, checks, and what the task itself says."""

from __future__ import annotations

import difflib
from collections.abc import Mapping
from typing import Any

from stable_baselines3.common.utils import LinearSchedule
from stable_baselines3.common.vec_env import VecEnv

from sb3_tbc.level.update import AVERAGE_DECAY

LEVEL_DEFAULTS: dict[str, Any] = {
    "learning_rate": 2e-3,
    "actor_learning_rate": None,
    "ent_coef_learning_rate": None,
    "average_decay": AVERAGE_DECAY,
    "batch_size": 256,
    "gradient_ratio": None,
    "gamma": 0.99,
    "tau": 0.0125,
    "ent_coef": "auto",
    "target_entropy": "auto",
    "buffer_size": 1_000_000,
    "policy_kwargs": {"net_arch": [64, 64], "mean_bound": 3.0, "log_std_bounds": [-6.9, 1.8]},
}
"""What a level uses where the user says nothing; the head's bounds are HiTS's (sigma in [1e-3, 6])."""

HIGH_DEFAULTS: dict[str, Any] = {"learning_rate": 3e-3, "ent_coef": 1.0}
"""Where the high level departs from them: a fixed temperature of the size of a decision's price keeps it exploring."""

CHOICES = {
    "memory": ("window", "episode", "none"),
    "duration": ("joint", "rule", "fixed"),
    "goals_met": ("passing", "end"),
    "hindsight_goals": ("all", "asked"),
}

DEFAULT_WIRING = {
    "inter": 8,
    "command": 6,
    "sensory_fanout": 4,
    "inter_fanout": 5,
    "recurrent_command_synapses": 3,
    "motor_fanin": 5,
}


def learning_rate_of(value: float | str) -> float | LinearSchedule:
    """A constant learning rate, or ``"lin_<rate>"``: one that falls linearly to zero at the end of training.

    :raises ValueError: if the text is of another form
    """
    if not isinstance(value, str):
        return value
    try:
        start = float(value.removeprefix("lin_"))
    except ValueError:
        raise ValueError(f"learning_rate must be a number or 'lin_<number>', got {value!r}") from None
    return LinearSchedule(start, 0.0, 1.0) if value.startswith("lin_") else start


def attribute_of(env: VecEnv, name: str) -> Any:
    """Attribute of the first task under its wrappers; None where there is none."""
    try:
        return env.get_attr(name, indices=[0])[0]
    except AttributeError:
        return None


def episode_length(env: VecEnv) -> int:
    """Time limit of the task, environment steps.

    :raises ValueError: if the environment has none
    """
    steps = attribute_of(env, "max_episode_steps") or getattr(attribute_of(env, "spec"), "max_episode_steps", None)
    if steps is None:
        raise ValueError("dt_max=-1 needs an environment with max_episode_steps; pass dt_max in steps")
    return int(steps)


def level_settings(name: str, given: Mapping[str, Any] | None, extra: tuple[str, ...] = ()) -> dict[str, Any]:
    """A level's settings with defaults filled in.

    :raises ValueError: on an unknown name, naming the nearest valid one
    """
    given = dict(given or {})
    allowed = [*LEVEL_DEFAULTS, *extra]
    for key in given:
        if key not in allowed:
            near = difflib.get_close_matches(key, allowed, n=1)
            hint = f"; did you mean {near[0]!r}?" if near else ""
            raise ValueError(f"unknown setting {name}.{key}{hint} Allowed: {', '.join(sorted(allowed))}")
    decay = given.get("average_decay", AVERAGE_DECAY)
    if (given.get("gradient_ratio") or 0) < 0:
        raise ValueError(f"{name}.gradient_ratio must not be negative, got {given['gradient_ratio']}")
    if not 0.0 <= given.get("near_misses", 0.0) <= 1.0:
        raise ValueError(f"{name}.near_misses is a share and must lie in [0, 1], got {given['near_misses']}")
    if not 0.0 <= decay < 1.0:
        raise ValueError(f"{name}.average_decay must be at least 0 (no averaging) and less than 1, got {decay}")
    kwargs = {**LEVEL_DEFAULTS["policy_kwargs"], **given.get("policy_kwargs", {})}
    if name == "high":
        kwargs.setdefault("negative_critic", True)
    role = HIGH_DEFAULTS if name == "high" else {}
    return {**LEVEL_DEFAULTS, **role, **given, "policy_kwargs": kwargs}


def check_settings(given: Mapping[str, Any]) -> None:
    """Refuse an agent's settings that cannot be meant.

    :param given: the settings by name
    :raises ValueError: naming the value, what is allowed and the likely cure
    """
    for name, allowed in CHOICES.items():
        if given[name] not in allowed:
            raise ValueError(f"{name} must be one of {', '.join(map(repr, allowed))}, got {given[name]!r}")
    for name in ("testing_fraction", "random_fraction"):
        if not 0.0 <= given[name] <= 1.0:
            raise ValueError(f"{name} must lie in [0, 1], got {given[name]}")
    for name in ("gradient_ratio", "duration_loss_coef"):
        if given[name] < 0:
            raise ValueError(f"{name} must not be negative, got {given[name]}")
    if given["sequence_length"] > 1 and given["memory"] == "none":
        raise ValueError(
            f"sequence_length={given['sequence_length']} recomputes the low level's memory, but memory='none' keeps "
            "none: use memory='window' or sequence_length=1"
        )
    if given["duration_loss_coef"] and given["duration"] != "joint":
        raise ValueError(
            f"duration_loss_coef={given['duration_loss_coef']} teaches a high level that chooses its time budgets: "
            f"use duration='joint' (here {given['duration']!r}), or 0"
        )
