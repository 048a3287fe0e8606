"""What types allow, in words."""

from __future__ import annotations

import dataclasses
import typing
from typing import Literal, get_args, get_origin

from sb3_tbc.aliases import PlainMapping
from sb3_tbc.settings.domains import Prefixed
from sb3_tbc.settings.kinds import Section, allows_anything, arms, hints, split

_NAMES: dict[object, str] = {
    bool: "true or false",
    int: "a whole number",
    float: "a number",
    str: "text",
    type(None): "null",
}


def describe(hint: object) -> str:
    """What a type allows, in words: ``a number from 0 to 1``."""
    kind, domains = split(hint)
    if any(isinstance(domain, Prefixed) for domain in domains):
        return " and ".join(str(domain) for domain in domains)
    return " ".join([_describe_kind(kind), *(str(domain) for domain in domains)])


def _describe_kind(kind: object) -> str:
    origin = get_origin(kind)
    if allows_anything(kind):
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
        return section_text(hints(typing.cast(Section, kind)))
    return _NAMES.get(kind, f"a {getattr(kind, '__name__', kind)}")


def section_text(kinds: PlainMapping) -> str:
    """A section, by the keys that it may have."""
    return f"a section with some of the keys {', '.join(kinds)}"


def remark(value: object, kind: object) -> str:
    """A remark for a text where a number is wanted: the two look alike in a message."""
    wants_number = kind in (int, float) or any(split(arm)[0] in (int, float) for arm in arms(kind))
    return " (text)" if isinstance(value, str) and wants_number else ""
