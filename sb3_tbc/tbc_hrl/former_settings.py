"""Settings out of an agent's attributes: as saved now, as saved by version 0.1.0, and as ``load(...)`` changes them."""

from __future__ import annotations

import warnings
from collections.abc import Mapping

from sb3_tbc.aliases import Plain, PlainMapping
from sb3_tbc.settings import Settings, hints, merge, section_of
from sb3_tbc.tbc_hrl.checks import refuse_level_names

FORMER_NAMES = {"high_settings": "high", "low_settings": "low"}
"""Attributes of version 0.1.0 and the sections that they have become."""

RETIRED: dict[str, tuple[object, ...]] = {"hindsight_goals": ("all",), "low.near_misses": (0, None)}
"""Settings that no longer exist, each with the values for which leaving it out changes nothing."""


def take_settings(attributes: Plain, config_class: type[Settings]) -> Plain:
    """Settings found among an agent's attributes, which are removed there.

    :param attributes: ``settings`` as :meth:`to_dict` gave them, and single ones by name, which replace them; of
        sections, those within replace their counterparts and the others stay
    :param config_class: the agent's settings
    :raises SettingError: if a setting of a level stands among the agent's
    """
    refuse_level_names(_unset(attributes))
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
