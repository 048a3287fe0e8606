"""Types of fields, taken apart."""

from __future__ import annotations

import dataclasses
import functools
import types
import typing
from typing import TYPE_CHECKING, Annotated, Any, get_args, get_origin

from sb3_tbc.settings.domains import Domain

if TYPE_CHECKING:
    from _typeshed import DataclassInstance

Section = type["DataclassInstance"]
"""A class of settings, whose instances are a section."""

AnyDomain = Domain[Any]
"""A domain of values of one type or another."""


def hints(section: Section) -> dict[str, object]:
    """Name of every field of a settings class and its type, domains included."""
    key: object = section
    found: dict[str, object] = _hints(key)
    return found


@functools.cache
def _hints(section: Section) -> dict[str, object]:
    found = typing.get_type_hints(section, include_extras=True)
    return {field.name: found[field.name] for field in dataclasses.fields(section)}


def default_of(field: dataclasses.Field[object]) -> object:
    """A field's default value."""
    return field.default if field.default_factory is dataclasses.MISSING else field.default_factory()


def split(hint: object) -> tuple[object, tuple[AnyDomain, ...]]:
    """The type itself, and the domains that restrict it."""
    if get_origin(hint) is Annotated:
        kind, *domains = get_args(hint)
        return kind, tuple(domains)
    return hint, ()


def allows_anything(kind: object) -> bool:
    """Whether a type does not restrict its values at all."""
    return kind is Any


def allows_none(kind: object) -> bool:
    """Whether a type allows None as a value."""
    return allows_anything(kind) or kind is type(None) or any(arm is type(None) for arm in arms(kind))


def arms(kind: object) -> tuple[object, ...]:
    """The alternatives of a union; of another type none."""
    return get_args(kind) if get_origin(kind) in (typing.Union, types.UnionType) else ()


def section_of(hint: object) -> Section | None:
    """The settings class that a type stands for or allows, None if it has none."""
    kind = split(hint)[0]
    return next((arm for arm in (kind, *arms(kind)) if dataclasses.is_dataclass(arm) and isinstance(arm, type)), None)
