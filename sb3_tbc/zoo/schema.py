"""What a configuration may contain: the settings of each algorithm, and the keys of the runner."""

from __future__ import annotations

import datetime
import math
from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Annotated, Literal

from sb3_tbc.aliases import Plain
from sb3_tbc.commands import MOST_ENVS, MOST_STEPS
from sb3_tbc.errors import ConfigError
from sb3_tbc.settings import NotEmpty, Range, SettingError, Settings, hints, read_partial
from sb3_tbc.tbc_hrl.config import FlatConfig, HACConfig, HiTSConfig, TBCConfig

CONFIG_CLASSES: dict[str, type[Settings]] = {
    "tbc-hrl": TBCConfig,
    "hits": HiTSConfig,
    "hac": HACConfig,
    "sac": FlatConfig,
}
"""Algorithm -> its settings."""

Numbers = Annotated[tuple[float, ...], NotEmpty()]


@dataclass(frozen=True, kw_only=True)
class SubgoalKeys(Settings):
    """Subgoals of an environment that does not define its own; see :mod:`sb3_tbc.tasks.generic`."""

    low: Numbers | None = None
    """Lower bounds of a subgoal."""
    high: Numbers | None = None
    """Upper bounds."""
    thresholds: float | Numbers | None = None
    """Largest distance that counts as reached: one for all coordinates, or one each."""
    names: tuple[str, ...] | None = None
    """A name for each coordinate."""
    n_probe_steps: Annotated[int, Range(1, 10_000_000)] | None = None
    """Number of random steps in which bounds and scales are measured."""


@dataclass(frozen=True, kw_only=True)
class RunKeys(Settings):
    """Keys that the runner reads itself; all others are settings of the agent."""

    n_timesteps: Annotated[int, Range(1, MOST_STEPS)] = 400_000
    """Environment steps of training."""
    n_envs: Annotated[int, Range(1, MOST_ENVS)] = 1
    """Parallel environments."""
    env_kwargs: Plain = field(default_factory=dict)
    """Arguments of ``gymnasium.make``."""
    policy: Literal["MultiInputPolicy"] = "MultiInputPolicy"
    """Policy class; there is only this one."""
    subgoals: SubgoalKeys | None = None
    """Subgoal space, for environments without one of their own."""


RUN = ("n_timesteps", "n_envs", "env_kwargs")
"""Keys of a section that become fields of :class:`~sb3_tbc.zoo.config.RunConfig`."""


def kinds_of(algo: str | None) -> Plain:
    """Every key that a section of an algorithm's configuration may have, and its type.

    :param algo: name of the algorithm; None or an unknown name allows the settings of all
    """
    classes = [CONFIG_CLASSES[algo]] if algo in CONFIG_CLASSES else [FlatConfig, TBCConfig]
    kinds = hints(RunKeys)
    for config in classes:
        kinds = kinds | hints(config)
    return kinds


def validate(section: object, algo: str | None, where: str) -> Plain:
    """Check every key and value of a section and return it, with whole floats as integers where integers are expected.

    :param section: the section as read from the file
    :param algo: algorithm whose settings are allowed, see :func:`kinds_of`
    :param where: file and section, for messages
    :raises ConfigError: for an unknown key or a value that is not allowed
    """
    try:
        checked = read_partial(section, kinds_of(algo))
        _check_storable(checked.get("env_kwargs"), "env_kwargs")
    except ConfigError as error:
        raise ConfigError(f"{where}: {error}") from None
    return checked


def _check_storable(value: object, name: str) -> None:
    """Refuse what JSON cannot hold: a run's result, written after all training, and its agents name the arguments.

    :raises SettingError: naming the argument
    """
    if isinstance(value, Mapping):
        for key, item in value.items():
            if not isinstance(key, str):
                raise SettingError(name, f"must have texts as keys, got {key!r}; put quotes around it")
            _check_storable(item, f"{name}.{key}")
    elif isinstance(value, list | tuple):
        for index, item in enumerate(value):
            _check_storable(item, f"{name}[{index}]")
    elif not isinstance(value, str | int | float | None) or (isinstance(value, float) and not math.isfinite(value)):
        allowed = "a finite number, text, true, false or null, or a list or section of these"
        quotes = "; a date needs quotes" if isinstance(value, datetime.date) else ""
        raise SettingError(name, f"must be {allowed}, got {value!r}{quotes}")
