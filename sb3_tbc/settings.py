"""Settings as frozen dataclasses: each field says what it may hold, and checks, plain data and texts follow from that.

A field is declared once, with its type, its default and a docstring below it::

    gamma: Annotated[float, Range(0, 1)] = 0.99
    \"\"\"Discount per decision.\"\"\"

Types may be ``bool, int, float, str``, a ``Literal``, a ``tuple``, a ``dict``, any class, another settings dataclass,
and unions of these; numbers have to be finite. Nothing here knows which settings there are.
"""

from __future__ import annotations

import dataclasses
import functools
import itertools
import math
import numbers
import types
import typing
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Annotated, Any, Literal, Protocol, TypeVar, get_args, get_origin

from sb3_tbc.errors import ConfigError, nearest

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


class Domain(Protocol):
    """What a value of the right type has to fulfil besides."""

    def holds(self, value: Any) -> bool:
        """Whether the value is allowed."""

    def __str__(self) -> str:
        """What is allowed, to be read after the type's name."""


@dataclass(frozen=True)
class Range:
    """Numbers between two bounds, which are allowed themselves unless excluded.

    :param low: lower bound
    :param high: upper bound
    :param above: exclude the lower bound
    :param below: exclude the upper bound
    :param also: single values outside of the bounds that are allowed as well
    """

    low: float = -math.inf
    high: float = math.inf
    above: bool = False
    below: bool = False
    also: tuple[float, ...] = ()

    def holds(self, value: Any) -> bool:
        """Whether a number lies within the bounds."""
        low = value > self.low if self.above else value >= self.low
        high = value < self.high if self.below else value <= self.high
        return bool((low and high) or value in self.also)

    def __str__(self) -> str:
        low, high = _short(self.low), _short(self.high)
        parts = []
        if self.low > -math.inf:
            parts.append(f"above {low}" if self.above else f"of at least {low}")
        if self.high < math.inf:
            parts.append(f"below {high}" if self.below else f"at most {high}")
        text = " and ".join(parts)
        if len(parts) == 2 and not (self.above or self.below):
            text = f"from {low} to {high}"
        return " or ".join([text, *map(_short, self.also)])


def _short(number: float) -> str:
    return f"{int(number):,}" if float(number).is_integer() else f"{number:g}"


@dataclass(frozen=True)
class Prefixed:
    """Text made of a fixed beginning and a number, such as ``lin_3e-4``.

    :param prefix: the beginning
    :param number: bounds of the number
    """

    prefix: str
    number: Range

    def holds(self, value: Any) -> bool:
        """Whether a text has this form."""
        try:
            number = float(str(value).removeprefix(self.prefix))
        except ValueError:
            return False
        return str(value).startswith(self.prefix) and math.isfinite(number) and self.number.holds(number)

    def __str__(self) -> str:
        return f"'{self.prefix}<number {self.number}>'"


@dataclass(frozen=True)
class Increasing:
    """Numbers of which each is larger than the one before it."""

    def holds(self, value: Any) -> bool:
        """Whether a sequence rises."""
        return all(a < b for a, b in itertools.pairwise(value))

    def __str__(self) -> str:
        return "in rising order"


@dataclass(frozen=True)
class NotEmpty:
    """Lists of at least one entry."""

    def holds(self, value: Any) -> bool:
        """Whether a sequence has entries."""
        return len(value) > 0

    def __str__(self) -> str:
        return "that is not empty"


@dataclass(frozen=True)
class Settings:
    """Base of all settings: checks every field when it is made, and knows its plain data."""

    def __post_init__(self) -> None:
        """Check and normalise every field, then what several fields say together."""
        for field, hint in zip(dataclasses.fields(self), hints(type(self)).values(), strict=True):
            default = default_of(field)
            object.__setattr__(self, field.name, read(getattr(self, field.name), hint, field.name, default))
        self.check()

    def check(self) -> None:
        """Refuse fields that contradict each other.

        :raises SettingError: naming the setting and the cure
        """

    @classmethod
    def from_dict(cls: type[SelfSettings], given: Mapping[str, Any] | SelfSettings | None = None) -> SelfSettings:
        """Settings from plain data; what is not given, or given as None, has its default.

        :param given: values by name, sections as mappings or as settings; or the settings themselves
        :raises SettingError: on an unknown name or a value that is not allowed
        """
        return typing.cast(SelfSettings, read({} if given is None else given, cls, "", cls()))

    def to_dict(self) -> dict[str, Any]:
        """All settings as plain data: numbers, text, lists and dictionaries."""
        result: dict[str, Any] = plain(self)
        return result


def plain(value: Any) -> Any:
    """Plain data of a value: settings become dictionaries, tuples become lists."""
    if dataclasses.is_dataclass(value) and not isinstance(value, type):
        return {field.name: plain(getattr(value, field.name)) for field in dataclasses.fields(value)}
    if isinstance(value, Mapping):
        return {key: plain(item) for key, item in value.items()}
    if isinstance(value, tuple | list):
        return [plain(item) for item in value]
    return value


def hints(section: type[Any]) -> dict[str, Any]:
    """Name of every field of a settings class and its type, domains included."""
    key: Any = section
    return _hints(key)


@functools.cache
def _hints(section: type[Any]) -> dict[str, Any]:
    found = typing.get_type_hints(section, include_extras=True)
    return {field.name: found[field.name] for field in dataclasses.fields(section)}


def default_of(field: dataclasses.Field[Any]) -> Any:
    """A field's default value."""
    return field.default if field.default_factory is dataclasses.MISSING else field.default_factory()


# ------------------------------------------------------------------------------------------------- checking


def read(value: Any, hint: Any, name: str, default: Any = None, partial: bool = False) -> Any:
    """A value as its type wants it: whole floats as integers, lists as tuples, mappings as settings.

    :param value: what was given
    :param hint: the type, with its domains
    :param name: dotted name, for messages
    :param default: what None stands for where the type has no None; and the settings that a mapping departs from
    :param partial: leave sections the mappings they are: check what they hold, add nothing
    :raises SettingError: naming the setting, what is allowed and what was given
    """
    kind, domains = split(hint)
    if value is None and not allows_none(kind) and default is not _WRONG:
        return None if partial else default
    if get_origin(kind) in (typing.Union, types.UnionType):
        result = _read_union(value, kind, name, default, partial)
    elif dataclasses.is_dataclass(kind):
        result = _read_section(value, typing.cast(type[Any], kind), name, default, partial)
    else:
        result = _read_plain(value, kind, name)
    if result is _WRONG or not all(domain.holds(result) for domain in domains):
        raise SettingError(name, f"must be {describe(hint)}, got {value!r}{_remark(value, kind)}")
    return result


def split(hint: Any) -> tuple[Any, tuple[Domain, ...]]:
    """A type without and with what restricts it."""
    if get_origin(hint) is Annotated:
        kind, *domains = get_args(hint)
        return kind, tuple(domains)
    return hint, ()


def allows_none(kind: Any) -> bool:
    """Whether None is a value of its own for a type."""
    return kind is Any or kind is type(None) or any(arm is type(None) for arm in arms(kind))


def arms(kind: Any) -> tuple[Any, ...]:
    """The alternatives of a union; of another type none."""
    return get_args(kind) if get_origin(kind) in (typing.Union, types.UnionType) else ()


def section_of(hint: Any) -> type[Any] | None:
    """The settings class that a type stands for or allows, None if it has none."""
    kind = split(hint)[0]
    return next((arm for arm in (kind, *arms(kind)) if dataclasses.is_dataclass(arm) and isinstance(arm, type)), None)


def read_partial(given: Any, kinds: Mapping[str, Any], where: str = "") -> dict[str, Any]:
    """Check some settings without adding the others.

    :param given: values by name
    :param kinds: every name there is, and its type
    :param where: section they stand in, for messages
    :return: the same values, numbers as their types want them
    :raises SettingError: on an unknown name or a value that is not allowed
    """
    _check_names(given, kinds, where)
    return {name: plain(read(value, kinds[name], _dotted(where, name), partial=True)) for name, value in given.items()}


def _check_names(given: Any, kinds: Mapping[str, Any], where: str) -> None:
    if not isinstance(given, Mapping):
        raise SettingError(where, f"must be {_section_text(kinds)}, got {given!r}")
    for name in given:
        if name not in kinds:
            raise SettingError("", f"unknown setting {_dotted(where, str(name))!r}; {nearest(str(name), kinds)}")


def _read_section(value: Any, kind: type[Any], name: str, default: Any, partial: bool) -> Any:
    if isinstance(value, kind):
        return value
    if partial:
        return read_partial(value, hints(kind), name)
    _check_names(value, hints(kind), name)
    base = default if isinstance(default, kind) else kind()
    changes = {key: read(item, hints(kind)[key], _dotted(name, key), getattr(base, key)) for key, item in value.items()}
    try:
        return dataclasses.replace(base, **changes)
    except SettingError as error:
        raise error.inside(name) from None
    except ValueError as error:
        raise SettingError(name, f"is not possible: {error}") from None


def _read_union(value: Any, kind: Any, name: str, default: Any, partial: bool) -> Any:
    section = section_of(kind)
    if section is not None and isinstance(value, Mapping):
        return _read_section(value, section, name, default, partial)
    for arm in arms(kind):
        if not dataclasses.is_dataclass(arm) or isinstance(value, typing.cast(type[Any], arm)):
            try:
                return read(value, arm, name, _WRONG, partial) if value is not None else None
            except SettingError:
                continue
    return _WRONG


def _read_plain(value: Any, kind: Any, name: str) -> Any:
    origin = get_origin(kind)
    if kind is Any:
        return value
    if origin is Literal:
        return next((choice for choice in get_args(kind) if type(choice) is type(value) and choice == value), _WRONG)
    if origin is tuple:
        return _read_tuple(value, get_args(kind), name)
    if origin is dict:
        return _read_dict(value, get_args(kind)[1], name)
    if origin is type:
        return value if isinstance(value, type) and issubclass(value, get_args(kind)) else _WRONG
    if kind in (int, float):
        return _read_number(value, kind)
    return value if isinstance(value, kind) else _WRONG


def _read_number(value: Any, kind: type[int] | type[float]) -> Any:
    """Numbers keep their type, except whole floats where an integer is wanted (YAML's ``1e3``)."""
    if isinstance(value, bool) or not isinstance(value, numbers.Real) or not math.isfinite(value):
        return _WRONG
    if not isinstance(value, int | float):
        value = value.item() if hasattr(value, "item") else float(value)  # NumPy's
    if kind is int and isinstance(value, float):
        return int(value) if value.is_integer() else _WRONG
    return value


def _read_tuple(value: Any, entries: tuple[Any, ...], name: str) -> Any:
    if hasattr(value, "tolist"):
        value = value.tolist()
    if not isinstance(value, list | tuple):
        return _WRONG
    kinds = [entries[0]] * len(value) if entries[-1] is Ellipsis else list(entries)
    if len(value) != len(kinds):
        return _WRONG
    pairs = zip(value, kinds, strict=True)
    return tuple(read(item, kind, f"{name}[{i}]", _WRONG) for i, (item, kind) in enumerate(pairs))


def _read_dict(value: Any, kind: Any, name: str) -> Any:
    if not isinstance(value, Mapping):
        return _WRONG
    return {str(key): read(item, kind, f"{name}.{key}", _WRONG) for key, item in value.items()}


def _dotted(section: str, name: str) -> str:
    return ".".join(part for part in (section, name) if part)


# ------------------------------------------------------------------------------------------------- texts

_NAMES = {bool: "true or false", int: "a whole number", float: "a number", str: "text", type(None): "none"}


def describe(hint: Any) -> str:
    """What a type allows, in words: ``a number from 0 to 1``."""
    kind, domains = split(hint)
    if any(isinstance(domain, Prefixed) for domain in domains):
        return " and ".join(str(domain) for domain in domains)
    return " ".join([_describe_kind(kind), *(str(domain) for domain in domains)])


def _describe_kind(kind: Any) -> str:
    origin = get_origin(kind)
    if kind is Any:
        return "anything"
    if arms(kind):
        return " or ".join(describe(arm) for arm in arms(kind))
    if origin is Literal:
        choices = ", ".join(map(repr, get_args(kind)))
        return choices if len(get_args(kind)) == 1 else f"one of {choices}"
    if origin is tuple:
        entries = get_args(kind)
        several = entries[-1] is Ellipsis
        return f"a list (each entry {describe(entries[0])})" if several else f"a list of {len(entries)} numbers"
    if origin is dict:
        return f"a section (each entry {describe(get_args(kind)[1])})"
    if origin is type:
        return f"a class derived from {get_args(kind)[0].__name__}"
    if dataclasses.is_dataclass(kind):
        return _section_text(hints(typing.cast(type[Any], kind)))
    return _NAMES.get(kind, f"a {getattr(kind, '__name__', kind)}")


def _section_text(kinds: Mapping[str, Any]) -> str:
    return f"a section with some of the keys {', '.join(kinds)}"


def _remark(value: Any, kind: Any) -> str:
    """Say so where a value looks right but is of another type."""
    wants_number = kind in (int, float) or any(split(arm)[0] in (int, float) for arm in arms(kind))
    return " (text)" if isinstance(value, str) and wants_number else ""
