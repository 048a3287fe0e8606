"""Checks of what users pass to an agent's methods: a mistake is refused in one line."""

from __future__ import annotations

import warnings
from collections.abc import Iterable
from numbers import Integral, Real
from typing import Any

import numpy as np
import torch as th
from gymnasium import spaces
from numpy.typing import ArrayLike
from stable_baselines3.common.vec_env import VecEnv, unwrap_vec_normalize

from sb3_tbc.aliases import Plain, PlainMapping, Space
from sb3_tbc.arrays import Arrays, BoolArray
from sb3_tbc.settings import SettingError, hints
from sb3_tbc.smdp.goal_spaces import GOAL_KEYS, width
from sb3_tbc.tasks.layouts import layout_cure
from sb3_tbc.tbc_hrl.config import TBCConfig


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


def episode_starts(given: ArrayLike, n_envs: int) -> BoolArray:
    """Which environments begin an episode, ``(n_envs,)``, as ``predict`` is told.

    :param given: one entry for each environment, or one for all
    :raises ValueError: for another number of them, which NumPy might spread over all environments
    """
    starts = np.asarray(given, dtype=bool)
    if starts.ndim and starts.shape != (n_envs,):
        raise ValueError(f"episode_start has one entry for each of {n_envs} environments, got shape {starts.shape}")
    return np.broadcast_to(starts, n_envs)


def check_sizes(space: spaces.Dict, batch: Arrays) -> None:
    """Refuse observations of another size than an agent was trained on.

    :param space: the agent's observation space
    :param batch: goal observations ``(..., size)``
    :raises ValueError: with both sizes, and the layout to use where the task has one that fits
    """
    for key in GOAL_KEYS:
        expected, shape = width(space, key), np.shape(batch[key])
        given = shape[-1] if shape else 0
        if given != expected or len(shape) > 2:
            cure = layout_cure(expected, given) if key == "observation" else ""
            raise ValueError(
                f"this agent acts on {key} of shape ({expected},) or (n, {expected}), got {tuple(shape)}.{cure}"
            )
    counts = {key: np.shape(batch[key])[:-1] for key in GOAL_KEYS}
    if len(set(counts.values())) > 1:
        shapes = ", ".join(f"{key} {np.shape(batch[key])}" for key in counts)
        raise ValueError(f"the parts of an observation must be of the same environments, got {shapes}")


def device_type(device: th.device | str) -> str:
    """The kind of a torch device, ``cpu`` or ``cuda``.

    :raises SettingError: for one that torch does not know
    """
    try:
        return th.device(device).type
    except (RuntimeError, TypeError):
        raise SettingError("device", f"must be 'auto', 'cpu', 'cuda' or 'cuda:<number>', got {device!r}") from None


def device_here(device: th.device | str) -> th.device | str:
    """Where to load an agent: the CPU, with a warning, if a GPU is asked for that torch does not find.

    SB3 does so silently; agents trained on a GPU must load on machines without one.

    :raises SettingError: for a device that torch does not know
    """
    if device != "auto":
        device_type(device)
    if str(device).startswith("cuda") and not th.cuda.is_available():
        warnings.warn(f"device {str(device)!r} is not there: the agent is loaded on the CPU", stacklevel=3)
        return "cpu"
    return device


def refuse_vec_normalize(env: VecEnv) -> None:
    """Refuse environments that normalise observations.

    :raises ValueError: if this one does, with the reason
    """
    if unwrap_vec_normalize(env) is not None:
        raise ValueError(
            "VecNormalize moves the subgoal space, and the units of goals, while the agent learns; use the task's "
            "fixed scales instead"
        )


def warn_of_unseen(space: Space) -> None:
    """Name the parts of an observation that SB3's policies would see, and an agent of two levels does not.

    :param space: of an environment's observations
    """
    unseen = sorted(set(getattr(space, "spaces", ())) - set(GOAL_KEYS))
    if unseen:
        warnings.warn(
            f"the agent does not see {', '.join(map(repr, unseen))} of an observation, only {', '.join(GOAL_KEYS)}: "
            "put what it should know into 'observation'; FilterObservation leaves parts out without this warning",
            stacklevel=2,
        )


def refuse_policy(policy: object, known: Iterable[str]) -> None:
    """Refuse a policy of Stable-Baselines3 that there is not here.

    :param policy: its class, which SB3 checks, or its name
    :param known: the names there are
    :raises ValueError: if the name is another one
    """
    if isinstance(policy, str) and policy not in known:
        allowed = " or ".join(map(repr, known))
        raise ValueError(f"policy must be {allowed}, got {policy!r}: goal observations are dictionaries of vectors")


def refuse_no_environment(env: object) -> None:
    """Refuse to build an agent for no environment.

    :raises ValueError: if there is none
    """
    if env is None:
        raise ValueError("an agent is built for an environment, got env=None; TBCHRL.load needs none to act")


# --------------------------------------------------------------------------------------------- names of SB3's SAC


_UPDATES = "updates follow what was collected; gradient_ratio says how many there are for each environment step"
_REPLAY = "the replay buffers are the agent's own; buffer_size, n_hindsight_goals and goal_strategy shape them"
_NOISE = "exploration is that of SAC's stochastic policy"
OF_SB3_ALONE = {
    "train_freq": _UPDATES,
    "gradient_steps": _UPDATES,
    "target_update_interval": "target critics follow with each update, by tau",
    "action_noise": _NOISE,
    "use_sde": _NOISE,
    "sde_sample_freq": _NOISE,
    "use_sde_at_warmup": _NOISE,
    "replay_buffer_class": _REPLAY,
    "replay_buffer_kwargs": _REPLAY,
    "optimize_memory_usage": _REPLAY,
    "n_steps": "returns are of one step",
}
"""Arguments of Stable-Baselines3's SAC that there are not here, and what there is."""
NEUTRAL: Plain = {
    "action_noise": None,
    "use_sde": False,
    "sde_sample_freq": -1,
    "use_sde_at_warmup": False,
    "replay_buffer_class": None,
    "replay_buffer_kwargs": None,
    "optimize_memory_usage": False,
    "n_steps": 1,
}
"""Values of them that ask for nothing: Stable-Baselines3's defaults, which scripts and wrappers hand on."""


def without_sb3_names(given: PlainMapping) -> Plain:
    """Arguments without those in :data:`OF_SB3_ALONE`, which may only be given where they ask for nothing.

    :raises SettingError: if one asks for something, saying what there is in its place
    """
    for name, instead in OF_SB3_ALONE.items():
        if name in given and not _asks_for_nothing(name, given[name]):
            raise SettingError(name, f"is not taken: {instead}")
    return {name: value for name, value in given.items() if name not in OF_SB3_ALONE}


def _asks_for_nothing(name: str, value: object) -> bool:
    return name in NEUTRAL and type(value) is type(NEUTRAL[name]) and bool(value == NEUTRAL[name])


LEVEL_NAMES = ("actor_learning_rate", "batch_size", "buffer_size", "ent_coef", "gamma", "policy_kwargs", "tau",
               "target_entropy", "average_decay", "ent_coef_learning_rate", "learning_rate")  # fmt: skip
"""Settings that Stable-Baselines3 takes for the whole agent, and an agent of two levels for each level."""


def refuse_level_names(given: PlainMapping) -> None:
    """Refuse a level's setting that is given for the whole agent.

    :raises SettingError: naming where it belongs
    """
    for name in LEVEL_NAMES:
        if name in given:
            raise SettingError(
                name,
                f"belongs to a level, and there are two: use low={{{name!r}: ...}} and high={{{name!r}: ...}} "
                f"in place of {name}={given[name]!r}",
            )


# -------------------------------------------------------------------------------------------- attributes of agents


OF_A_LEVEL = ("gamma", "tau", "batch_size", "buffer_size", "ent_coef", "target_entropy", "learning_rate")
"""What SB3's agents of one level let users change between two calls of ``learn``."""


def explain_level_setting(name: str) -> None:
    """Say where to read what each level has for itself.

    :raises AttributeError: if it is such a setting
    """
    if name in OF_A_LEVEL:
        raise AttributeError(
            f"{name} belongs to a level, and there are two: read model.low_settings[{name!r}] and "
            f"model.high_settings[{name!r}]"
        )


def refuse_level_setting(name: str, value: object) -> None:
    """Refuse to set on the agent what its levels would never read.

    :param name: of :data:`OF_A_LEVEL`
    :raises AttributeError: naming what to do instead
    """
    if name != "learning_rate" or value != 0.0:  # SB3 sets that one itself
        raise AttributeError(
            f"{name} belongs to a level, and there are two: load the saved agent with other settings, "
            f"load(path, env, low={{{name!r}: {value!r}}}) or high={{...}}"
        )


CHANGEABLE_LATER = ("gradient_ratio", "learning_starts")
"""Settings of the agent that may be set at any time: they are read at each burst of updates."""
OF_THE_AGENT = frozenset((*hints(TBCConfig), *OF_SB3_ALONE)) - {"high", "low", "use_sde", "sde_sample_freq"}
"""What belongs to the agent as a whole, here or in SB3; SB3 itself sets the two that are left out."""


def refuse_fixed(name: str, value: object) -> None:
    """Refuse to set what is fixed when an agent is made, or what there is not here.

    :raises AttributeError: naming what to do instead
    """
    if name in OF_SB3_ALONE:
        raise AttributeError(f"{name} is nothing that can be set: {OF_SB3_ALONE[name]}")
    if name not in CHANGEABLE_LATER:
        raise AttributeError(
            f"{name} is fixed when the agent is made or loaded: save it, and load(path, env, {name}={value!r})"
        )
