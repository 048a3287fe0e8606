"""Settings of a level: defaults, checks, and what the task itself says."""

from __future__ import annotations

import difflib
from collections.abc import Mapping
from typing import Any

from stable_baselines3.common.utils import LinearSchedule
from stable_baselines3.common.vec_env import VecEnv

LEVEL_DEFAULTS: dict[str, Any] = {
    "learning_rate": 1e-3,
    "ent_coef_learning_rate": None,
    "batch_size": 256,
    "gamma": 0.98,
    "tau": 0.01,
    "ent_coef": "auto",
    "target_entropy": "auto",
    "buffer_size": 1_000_000,
    "policy_kwargs": {"net_arch": [64, 64], "mean_bound": 3.0, "log_std_bounds": [-6.9, 1.8]},
}
"""What a level uses where the user says nothing; the head's bounds are HiTS's (sigma in [1e-3, 6])."""

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
    kwargs = {**LEVEL_DEFAULTS["policy_kwargs"], **given.get("policy_kwargs", {})}
    if name == "high":
        kwargs.setdefault("negative_critic", True)
    return {**LEVEL_DEFAULTS, **given, "policy_kwargs": kwargs}
