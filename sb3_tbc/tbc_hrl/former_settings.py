"""Settings out of an agent's attributes: as saved now, as saved by version 0.1.0, and as ``load(...)`` changes them."""

from __future__ import annotations

import warnings
from collections.abc import Mapping

from sb3_tbc.aliases import Plain, PlainMapping
from sb3_tbc.settings import SettingError, Settings, hints, merge, section_of

FORMER_NAMES = {"high_settings": "high", "low_settings": "low"}
"""Attributes of version 0.1.0 and the sections that they have become."""

RETIRED: dict[str, tuple[object, ...]] = {"hindsight_goals": ("all",), "low.near_misses": (0, None)}
"""Settings that no longer exist, each with the values for which leaving it out changes nothing."""

LEVEL_NAMES = ("actor_learning_rate", "batch_size", "buffer_size", "ent_coef", "gamma", "policy_kwargs", "tau",
               "target_entropy", "average_decay", "ent_coef_learning_rate", "learning_rate")  # fmt: skip
"""Settings that Stable-Baselines3 takes for the whole agent, and an agent of two levels for each level."""


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


def without_neutral(given: PlainMapping) -> Plain:
    """Arguments without those of Stable-Baselines3 that ask for nothing."""
    return {name: value for name, value in given.items() if name not in NEUTRAL or _asks(value, NEUTRAL[name])}


def _asks(value: object, neutral: object) -> bool:
    return type(value) is not type(neutral) or value != neutral


def check_sb3_names(given: PlainMapping) -> None:
    """Refuse an argument of Stable-Baselines3 that has no counterpart.

    :raises SettingError: saying what there is in its place
    """
    for name in OF_SB3_ALONE:
        if name in given:
            raise SettingError(name, f"is not taken: {OF_SB3_ALONE[name]}")


def check_top_names(given: PlainMapping) -> None:
    """Refuse a level's setting that is given for the whole agent, and what :func:`check_sb3_names` refuses.

    :raises SettingError: naming where it belongs
    """
    check_sb3_names(given)
    for name in LEVEL_NAMES:
        if name in given:
            raise SettingError(
                name,
                f"belongs to a level, and there are two: use low={{{name!r}: ...}} and high={{{name!r}: ...}} "
                f"in place of {name}={given[name]!r}",
            )


def take_settings(attributes: Plain, config_class: type[Settings]) -> Plain:
    """Settings found among an agent's attributes, which are removed there.

    :param attributes: ``settings`` as :meth:`to_dict` gave them, and single ones by name, which replace them; of
        sections, those within replace their counterparts and the others stay
    :param config_class: the agent's settings
    :raises SettingError: if a setting of a level stands among the agent's
    """
    changed = {name: value for name, value in _unset(attributes).items() if name in LEVEL_NAMES}
    check_top_names(changed)
    settings: Plain = dict(attributes.pop("settings", {}))
    for former, name in FORMER_NAMES.items():
        if former in attributes:
            settings[name] = attributes.pop(former)
    for name, hint in hints(config_class).items():
        if name not in attributes:
            continue
        value = attributes[name]
        if section_of(hint) is None:
            settings[name] = attributes.pop(name)
        elif isinstance(value, Mapping):  # else it is the level itself
            settings[name] = merge(settings.get(name, {}), attributes.pop(name))
    _drop_retired(settings, attributes)
    return settings


def _unset(attributes: PlainMapping) -> Plain:
    """Attributes without what Stable-Baselines3 itself keeps under a level's name."""
    own = {"learning_rate": 0.0, "policy_kwargs": {}}
    return {name: value for name, value in attributes.items() if name not in own or value != own[name]}


def _drop_retired(settings: Plain, attributes: Plain) -> None:
    for name, harmless in RETIRED.items():
        section, _, key = name.rpartition(".")
        holder = settings.get(section) if section else attributes
        if not isinstance(holder, dict) or key not in holder:
            continue
        value = holder.pop(key)
        if value not in harmless:
            warnings.warn(
                f"the agent was trained with {name}={value!r}, a setting that no longer exists: it acts as before, "
                "but learns without it from now on",
                stacklevel=2,
            )
