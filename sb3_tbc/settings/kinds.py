"""Types of fields, taken apart."""

from __future__ import annotations

import dataclasses
import functools
import types
import typing
from typing import Annotated, Any, get_args, get_origin

from sb3_tbc.aliases import Plain
from sb3_tbc.settings.domains import Domain


def hints(section: type[Any]) -> Plain:
    """Name of every field of a settings class and its type, domains included."""
    key: Any = section
    return _hints(key)


@functools.cache
def _hints(section: type[Any]) -> Plain:
    found = typing.get_type_hints(section, include_extras=True)
    return {field.name: found[field.name] for field in dataclasses.fields(section)}


def default_of(field: dataclasses.Field[Any]) -> Any:
    """A field's default value."""
    return field.default if field.default_factory is dataclasses.MISSING else field.default_factory()


def split(hint: Any) -> tuple[Any, tuple[Domain, ...]]:
    """The type itself, and the domains that restrict it."""
    if get_origin(hint) is Annotated:
        kind, *domains = get_args(hint)
        return kind, tuple(domains)
    return hint, ()


def allows_none(kind: Any) -> bool:
    """Whether a type allows None as a value."""
    return kind is Any or kind is type(None) or any(arm is type(None) for arm in arms(kind))


def arms(kind: Any) -> tuple[Any, ...]:
    """The alternatives of a union; of another type none."""
    return get_args(kind) if get_origin(kind) in (typing.Union, types.UnionType) else ()


def section_of(hint: Any) -> type[Any] | None:
    """The settings class that a type stands for or allows, None if it has none."""
    kind = split(hint)[0]
    return next((arm for arm in (kind, *arms(kind)) if dataclasses.is_dataclass(arm) and isinstance(arm, type)), None)
