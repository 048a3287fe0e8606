"""What a configuration may contain: the names and types of every key, in one place."""

from __future__ import annotations

import math
import re
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

from sb3_tbc.errors import ConfigError, nearest

Schema = dict[str, Any]
"""Key -> kind: a type, a tuple of types, a frozenset of allowed strings, :class:`ListOf`, or a nested schema.

``None`` is allowed everywhere.
"""


@dataclass(frozen=True)
class ListOf:
    """A list with entries of one kind.

    :param kind: of the entries, as in a schema; numbers have to be finite
    :param single: whether one entry may stand without its list
    """

    kind: Any
    single: bool = False


NUMBER = (int, float)
_FLOAT = re.compile(r"[+-]?(\d+\.?\d*|\.\d+)([eE][+-]?\d+)?")

NDBC: Schema = {
    **dict.fromkeys(("inter", "command", "motor", "sensory_fanout", "inter_fanout"), int),
    **dict.fromkeys(("recurrent_command_synapses", "motor_fanin", "seed", "sub_steps"), int),
    "dynamics": str,
    "synapses": str,
    "sensory_to": list,
    "input_scale": list,
}
POLICY: Schema = {
    "net_arch": (list, dict),
    "negative_critic": bool,
    "mean_bound": NUMBER,
    "log_std_bounds": list,
    "ndbc": NDBC,
}
LEVEL: Schema = {
    "learning_rate": (int, float, str),
    "actor_learning_rate": (int, float, str),
    "ent_coef_learning_rate": NUMBER,
    "average_decay": NUMBER,
    "batch_size": int,
    "gradient_ratio": NUMBER,
    "gamma": NUMBER,
    "tau": NUMBER,
    "ent_coef": (int, float, str),
    "target_entropy": (int, float, str),
    "buffer_size": int,
    "n_hindsight_goals": NUMBER,
    "goal_strategy": frozenset({"future", "episode"}),
    "near_misses": NUMBER,
    "policy_kwargs": POLICY,
}
RUN: Schema = {"n_timesteps": int, "n_envs": int, "env_kwargs": dict}
"""Keys the runner reads itself; all others go to the algorithm's constructor."""

SUBGOALS: Schema = {
    "low": ListOf(NUMBER),
    "high": ListOf(NUMBER),
    "thresholds": ListOf(NUMBER, single=True),
    "names": ListOf(str),
    "n_probe_steps": int,
}
"""Subgoals of an environment that does not bring its own, see :func:`sb3_tbc.tasks.generic.describe_goal_env`."""

MODEL: Schema = {
    "policy": str,
    "max_options": int,
    "window_end": frozenset({"timed", "reached"}),
    "dt_min": NUMBER,
    "dt_max": NUMBER,
    "duration": frozenset({"joint", "rule", "fixed"}),
    "fixed_duration": NUMBER,
    "kappa": NUMBER,
    "duration_loss_coef": NUMBER,
    "remaining_time": bool,
    "target": frozenset({"smdp", "decision"}),
    "decision_cost": NUMBER,
    "duration_cost": NUMBER,
    "completion_bonus": NUMBER,
    "low_reward": frozenset({"sparse", "dense", "step"}),
    "testing_fraction": NUMBER,
    "deterministic_testing": bool,
    "testing_penalty": NUMBER,
    "relative_subgoals": bool,
    "keep_original": bool,
    "relabel_tolerance": NUMBER,
    "random_fraction": NUMBER,
    "n_hindsight_goals": NUMBER,
    "goal_strategy": frozenset({"future", "episode", "event"}),
    "goals_met": frozenset({"passing", "end"}),
    "hindsight_goals": frozenset({"all", "asked"}),
    "gradient_ratio": NUMBER,
    "learning_starts": int,
    "memory": frozenset({"window", "episode", "none"}),
    "sequence_length": int,
    "compile": (bool, str),
    "high": LEVEL,
    "low": LEVEL,
}
FLAT: Schema = {
    **{key: LEVEL[key] for key in ("learning_rate", "batch_size", "gamma", "tau", "ent_coef", "target_entropy")},
    "buffer_size": int,
    "policy_kwargs": {"net_arch": (list, dict)},
}
"""What an agent of one level takes at the top of a section, besides some of :data:`MODEL`'s keys."""

SECTION: Schema = {**RUN, "subgoals": SUBGOALS, **MODEL, **FLAT}


def coerce(value: Any) -> Any:
    """Turn number-like strings into numbers, recursively: YAML 1.1 reads ``3e-4`` as text."""
    if isinstance(value, Mapping):
        return {key: coerce(item) for key, item in value.items()}
    if isinstance(value, list):
        return [coerce(item) for item in value]
    if isinstance(value, str) and _FLOAT.fullmatch(value.strip()):
        return float(value)
    return value


def validate(section: Mapping[str, Any], schema: Schema, where: str) -> dict[str, Any]:
    """Check every key and value of a section and return it with whole floats as integers where those are asked for.

    :param section: what was read, numbers already coerced
    :param schema: the allowed keys and kinds
    :param where: file and section, for messages
    :raises ConfigError: for an unknown key or a value of the wrong kind
    """
    result = {}
    for key, value in section.items():
        if key not in schema:
            raise ConfigError(f"{where}: unknown key {key!r}; {nearest(str(key), schema)}")
        result[key] = _value(value, schema[key], f"{where}: {key}")
    return result


def _value(value: Any, kind: Any, where: str) -> Any:
    if value is None:
        return None
    if isinstance(kind, dict):
        if not isinstance(value, Mapping):
            raise ConfigError(f"{where} must be a section with keys {', '.join(sorted(kind))}, got {value!r}")
        return validate(value, kind, where)
    if isinstance(kind, ListOf):
        return _list(value, kind, where)
    if isinstance(kind, frozenset):
        if value not in kind:
            raise ConfigError(f"{where} must be one of {', '.join(sorted(kind))}, got {value!r}")
        return value
    kinds = kind if isinstance(kind, tuple) else (kind,)
    if kinds == (int,) and isinstance(value, float) and value.is_integer():
        return int(value)
    if not isinstance(value, kinds) or (isinstance(value, bool) and bool not in kinds):
        names = " or ".join(k.__name__ for k in kinds)
        raise ConfigError(f"{where} must be {names}, got {value!r} ({type(value).__name__})")
    return value


def _list(value: Any, kind: ListOf, where: str) -> Any:
    if not isinstance(value, list):
        if kind.single:
            return _value(value, kind.kind, where)
        raise ConfigError(f"{where} must be a list, got {value!r}")
    entries = [_value(item, kind.kind, f"{where}[{i}]") for i, item in enumerate(value)]
    if not entries or any(item is None or (isinstance(item, float) and not math.isfinite(item)) for item in entries):
        raise ConfigError(f"{where} must be a list of finite values, got {value!r}")
    return entries
