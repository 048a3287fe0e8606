"""Settings classes: every field is checked when they are made, and they know their plain data."""

from __future__ import annotations

import dataclasses
import numbers
import types
import typing
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, Literal, TypeVar, get_args, get_origin

from sb3_tbc.aliases import Plain, PlainMapping
from sb3_tbc.arrays import is_finite
from sb3_tbc.errors import ConfigError, nearest
from sb3_tbc.settings.kinds import Section, allows_anything, allows_none, arms, default_of, hints, section_of, split
from sb3_tbc.settings.texts import describe, remark, section_text

SelfSettings = TypeVar("SelfSettings", bound="Settings")

_WRONG = object()
"""Stands for a value of the wrong type."""


class SettingError(ConfigError):
    """A setting has a value that it cannot have.

    :param name: dotted name, e.g. ``low.gamma``
    :param text: what is wrong, to be read after the name
    """

    def __init__(self, name: str, text: str) -> None:
        super().__init__(f"{name} {text}".strip())
        self.name, self.text = name, text

    def inside(self, section: str) -> SettingError:
        """The same mistake, seen from outside of a section."""
        return SettingError(_dotted(section, self.name), self.text)


@dataclass(frozen=True)
class Settings:
    """Base of all settings: checks every field when it is made, and knows its plain data."""

    def __post_init__(self) -> None:
        """Check and normalise every field, then check the fields against each other."""
        for field, hint in zip(dataclasses.fields(self), hints(type(self)).values(), strict=True):
            default = default_of(field)
            object.__setattr__(self, field.name, read(getattr(self, field.name), hint, field.name, default))
        self.check()

    def check(self) -> None:
        """Refuse fields that contradict each other.

        :raises SettingError: naming the setting and the cure
        """

    @classmethod
    def from_dict(cls: type[SelfSettings], given: PlainMapping | SelfSettings | None = None) -> SelfSettings:
        """Settings from plain data; what is not given, or given as None, has its default.

        :param given: values by name, sections as mappings or as settings; or the settings themselves
        :raises SettingError: on an unknown name or a value that is not allowed
        """
        return typing.cast(SelfSettings, read({} if given is None else given, cls, "", cls()))

    def to_dict(self) -> Plain:
        """All settings as plain data: numbers, text, lists and dictionaries."""
        result: Plain = plain(self)
        return result


def plain(value: object) -> Any:
    """Plain data of a value: settings become dictionaries, tuples become lists."""
    if dataclasses.is_dataclass(value) and not isinstance(value, type):
        return {field.name: plain(getattr(value, field.name)) for field in dataclasses.fields(value)}
    if isinstance(value, Mapping):
        return {key: plain(item) for key, item in value.items()}
    if isinstance(value, tuple | list):
        return [plain(item) for item in value]
    return value


def merge(base: PlainMapping, change: PlainMapping) -> Plain:
    """``base`` updated with ``change``, section by section; a ``None`` replaces a whole section."""
    result = dict(base)
    for key, value in change.items():
        old = result.get(key)
        result[key] = merge(old, value) if isinstance(old, Mapping) and isinstance(value, Mapping) else value
    return result


def flat(settings: Mapping[str, object], prefix: str = "") -> dict[str, object]:
    """Plain data of all sections under dotted names."""
    found: dict[str, object] = {}
    for name, value in settings.items():
        found |= flat(value, f"{prefix}{name}.") if isinstance(value, Mapping) else {f"{prefix}{name}": value}
    return found


# ------------------------------------------------------------------------------------------------- checking


def read(value: object, hint: object, name: str, default: object = None, partial: bool = False) -> object:
    """Check a value and convert it to its type: whole floats to integers, lists to tuples, mappings to settings.

    :param value: what was given
    :param hint: the type, with its domains
    :param name: dotted name, for messages
    :param default: the value for None, where the type does not allow None; or the settings that a mapping changes
    :param partial: check what sections hold, but leave them mappings and add no defaults
    :raises SettingError: naming the setting, what is allowed and what was given
    """
    kind, domains = split(hint)
    if value is None and not allows_none(kind) and default is not _WRONG:
        return None if partial else default
    if get_origin(kind) in (typing.Union, types.UnionType):
        result = _read_union(value, kind, name, default, partial)
    elif dataclasses.is_dataclass(kind):
        result = _read_section(value, typing.cast(Section, kind), name, default, partial)
    else:
        result = _read_plain(value, kind, name)
    if result is _WRONG or not all(domain.holds(result) for domain in domains):
        raise SettingError(name, f"must be {describe(hint)}, got {value!r}{remark(value, kind)}")
    return result


def read_partial(given: object, kinds: PlainMapping, where: str = "") -> Plain:
    """Check some settings without adding the others.

    :param given: values by name
    :param kinds: every name there is, and its type
    :param where: section they stand in, for messages
    :return: the same values, numbers converted to their types
    :raises SettingError: on an unknown name or a value that is not allowed
    """
    known = _checked_names(given, kinds, where)
    return {name: plain(read(value, kinds[name], _dotted(where, name), partial=True)) for name, value in known.items()}


def _checked_names(given: object, kinds: PlainMapping, where: str) -> PlainMapping:
    if not isinstance(given, Mapping):
        raise SettingError(where, f"must be {section_text(kinds)}, got {given!r}")
    for name in given:
        if name not in kinds:
            raise SettingError("", f"unknown setting {_dotted(where, str(name))!r}; {nearest(str(name), kinds)}")
    return given


def _read_section(value: object, kind: Section, name: str, default: object, partial: bool) -> object:
    if isinstance(value, kind):
        return value
    if partial:
        return read_partial(value, hints(kind), name)
    kinds = hints(kind)
    given = _checked_names(value, kinds, name)
    base = default if isinstance(default, kind) else kind()
    changes = {key: read(item, kinds[key], _dotted(name, key), getattr(base, key)) for key, item in given.items()}
    try:
        return dataclasses.replace(base, **changes)
    except SettingError as error:
        raise error.inside(name) from None
    except ValueError as error:
        raise SettingError(name, f"is not possible: {error}") from None


def _read_union(value: object, kind: object, name: str, default: object, partial: bool) -> object:
    section = section_of(kind)
    if section is not None and isinstance(value, Mapping):
        return _read_section(value, section, name, default, partial)
    for arm in arms(kind):
        if not dataclasses.is_dataclass(arm) or isinstance(value, typing.cast(Section, arm)):
            try:
                return read(value, arm, name, _WRONG, partial) if value is not None else None
            except SettingError:
                continue
    return _WRONG


def _read_plain(value: object, kind: object, name: str) -> object:
    origin = get_origin(kind)
    if allows_anything(kind):
        return value
    if origin is Literal:
        return next((choice for choice in get_args(kind) if type(choice) is type(value) and choice == value), _WRONG)
    if origin is tuple:
        return _read_tuple(value, get_args(kind), name)
    if origin is dict:
        return _read_dict(value, get_args(kind)[1], name)
    if origin is type:
        return value if isinstance(value, type) and issubclass(value, get_args(kind)) else _WRONG
    if kind is int or kind is float:
        return _read_number(value, whole=kind is int)
    return value if isinstance(value, typing.cast(type, origin or kind)) else _WRONG


def _read_number(value: object, whole: bool) -> object:
    """Numbers keep their type, except whole floats where an integer is wanted (YAML's ``1e3``)."""
    if isinstance(value, bool) or not isinstance(value, numbers.Real) or not is_finite(value):
        return _WRONG
    if not isinstance(value, int | float):
        value = value.item() if hasattr(value, "item") else float(value)  # NumPy's
    if whole and isinstance(value, float):
        return int(value) if value.is_integer() else _WRONG
    return value


def _read_tuple(value: object, entries: tuple[object, ...], name: str) -> object:
    if hasattr(value, "tolist"):
        value = value.tolist()
    if not isinstance(value, list | tuple):
        return _WRONG
    kinds = [entries[0]] * len(value) if entries[-1] is Ellipsis else list(entries)
    if len(value) != len(kinds):
        return _WRONG
    pairs = zip(value, kinds, strict=True)
    return tuple(read(item, kind, f"{name}[{i}]", _WRONG) for i, (item, kind) in enumerate(pairs))


def _read_dict(value: object, kind: object, name: str) -> object:
    if not isinstance(value, Mapping):
        return _WRONG
    return {str(key): read(item, kind, f"{name}.{key}", _WRONG) for key, item in value.items()}


def _dotted(section: str, name: str) -> str:
    return ".".join(part for part in (section, name) if part)
