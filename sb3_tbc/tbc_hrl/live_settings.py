"""Settings of a level as a mapping in which those that can change while an agent learns may be set."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from typing import Any

from sb3_tbc.aliases import PlainMapping
from sb3_tbc.settings import SettingError

CHANGEABLE = ("learning_rate", "batch_size", "gradient_ratio", "tau")
"""Settings that take effect with the next update; all others are built into the level."""


class LiveSettings(PlainMapping):
    """A level's settings; ``settings["learning_rate"] = 1e-4`` holds from the next update on.

    :param name: the level, ``"high"`` or ``"low"``
    :param values: its settings
    :param change: takes a setting's name and new value
    """

    def __init__(self, name: str, values: PlainMapping, change: Callable[[str, object], None]) -> None:
        self._name, self._values, self._change = name, values, change

    def __getitem__(self, key: str) -> Any:
        return self._values[key]

    def __iter__(self) -> Iterator[str]:
        return iter(self._values)

    def __len__(self) -> int:
        return len(self._values)

    def __setitem__(self, key: str, value: object) -> None:
        """Change a setting of the agent.

        :raises SettingError: if it cannot be changed, or the value is not allowed
        """
        if key not in CHANGEABLE:
            raise SettingError(
                f"{self._name}.{key}",
                f"is fixed when the agent is made or loaded: to change it, load(path, {self._name}={{{key!r}: ...}}); "
                f"an existing agent lets you set only {', '.join(CHANGEABLE)}",
            )
        self._change(key, value)

    def __repr__(self) -> str:
        return f"{type(self).__name__}({self._values!r})"
