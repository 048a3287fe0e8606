"""What the agents' constructors take: their settings, and what every Stable-Baselines3 algorithm takes.

The classes ending in ``Arguments`` are for the reader's tools alone: :func:`takes` gives a constructor their fields as
its keyword arguments, so that type checkers and editors know every name and type. :class:`SignatureOfSettings` does the
same for ``help()`` and :func:`inspect.signature`.
"""

from __future__ import annotations

import dataclasses
import inspect
import os
import typing
from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Annotated, Any, Concatenate, ParamSpec, TypeVar

import torch as th
from stable_baselines3.common.policies import BasePolicy
from stable_baselines3.common.type_aliases import GymEnv

from sb3_tbc.aliases import Plain, PlainMapping
from sb3_tbc.settings import Range, SettingError, Settings, default_of, hints
from sb3_tbc.smdp.spaces import SubgoalSpace
from sb3_tbc.tbc_hrl.checks import device_type
from sb3_tbc.tbc_hrl.config import AgentConfig, FlatConfig
from sb3_tbc.tbc_hrl.level_config import HighConfig, LowConfig

P = ParamSpec("P")
SelfArguments = TypeVar("SelfArguments", bound="SB3Arguments")


@dataclass(frozen=True, kw_only=True)
class SB3Arguments(Settings):
    """What Stable-Baselines3 asks of an algorithm besides its settings."""

    stats_window_size: Annotated[int, Range(1)] = 100
    """Number of latest episodes that logged means are taken over."""
    tensorboard_log: str | os.PathLike[str] | None = None
    """Folder for TensorBoard's files; null: no files are written."""
    verbose: Annotated[int, Range(0, 2)] = 0
    """How much is printed: 0 nothing, 1 progress and notices, 2 everything."""
    device: str | th.device = "cpu"
    """Torch device: ``cpu``, ``cuda``, ``cuda:0``, ..., or ``auto``."""
    seed: Annotated[int, Range(0, 2**32 - 1)] | None = None
    """Seed of networks, sampling and environments; null: a new one for each agent."""
    _init_setup_model: bool = True
    """Whether to build the networks now."""

    def check(self) -> None:
        """Refuse a device that is not there.

        :raises SettingError: naming the devices there are
        """
        if self.device == "auto":
            return
        if device_type(self.device) == "cuda" and not th.cuda.is_available():
            raise SettingError(
                "device", f"{str(self.device)!r} needs a GPU, and torch finds none on this machine; use device='cpu'"
            )

    @classmethod
    def taken_from(cls: type[SelfArguments], arguments: PlainMapping) -> tuple[SelfArguments, Plain]:
        """Stable-Baselines3's arguments among all, checked, and the others as they are."""
        own = {name: value for name, value in arguments.items() if name in hints(cls)}
        others = {name: value for name, value in arguments.items() if name not in own}
        return cls.from_dict(own), others


@dataclass(frozen=True, kw_only=True)
class HierarchyArguments(SB3Arguments):
    """Further arguments of an agent of two levels."""

    device: str | th.device = "cpu"
    """``cpu``, or ``auto``, which is the same: both levels act and learn on the CPU."""
    subgoals: SubgoalSpace | None = None
    """Subgoal space, for environments without an attribute ``subgoals``."""

    def check(self) -> None:
        """Refuse every other device.

        :raises SettingError: saying why
        """
        if str(self.device) not in ("cpu", "auto"):
            raise SettingError(
                "device",
                f"must be 'cpu', or 'auto', which is the same, got {str(self.device)!r}: both levels act and learn on "
                "the CPU, where networks of their size are faster",
            )


@dataclass(frozen=True)
class TBCArguments(AgentConfig, HierarchyArguments):
    """All that :class:`~sb3_tbc.tbc_hrl.tbc_hrl.TBCHRL` takes."""

    policy: str | type[BasePolicy]
    env: GymEnv | str | None
    high: HighConfig | PlainMapping | None = field(default=None, kw_only=True)
    low: LowConfig | PlainMapping | None = field(default=None, kw_only=True)


@dataclass(frozen=True)
class FlatArguments(FlatConfig, SB3Arguments):
    """All that :class:`~sb3_tbc.tbc_hrl.flat_sac.FlatSAC` takes."""

    policy: str | type[BasePolicy]
    env: GymEnv | str


def takes(arguments: Callable[P, Settings]) -> Callable[[Callable[..., None]], Callable[Concatenate[Any, P], None]]:
    """Tell type checkers that a constructor takes what ``arguments`` does."""
    return lambda constructor: constructor


class SignatureOfSettings:
    """The signature of a class as its ``config_class`` says: for ``help()``, notebooks and the documentation.

    :param others: what the class takes besides its settings
    """

    def __init__(self, others: type[SB3Arguments]) -> None:
        self.others = others

    def __get__(self, instance: object, owner: type[Any]) -> inspect.Signature:
        """The owner's signature."""
        parameters = [inspect.Parameter(name, inspect.Parameter.POSITIONAL_OR_KEYWORD) for name in ("policy", "env")]
        for section in (owner.config_class, self.others):
            types = typing.get_type_hints(section)
            parameters += [_parameter(field, types[field.name]) for field in dataclasses.fields(section)]
        return inspect.Signature([parameter for parameter in parameters if not parameter.name.startswith("_")])


def _parameter(field: dataclasses.Field[object], kind: Any) -> inspect.Parameter:
    """A field as a keyword argument; a section may be given as a mapping, and None leaves it at its defaults."""
    default = default_of(field)
    if isinstance(default, Settings):
        kind, default = kind | PlainMapping | None, None
    return inspect.Parameter(field.name, inspect.Parameter.KEYWORD_ONLY, default=default, annotation=kind)
