"""All settings of a class as a list, with the help text that stands below each field in the source."""

from __future__ import annotations

import ast
import dataclasses
import functools
import inspect
import itertools
import re
import textwrap
from dataclasses import dataclass

from sb3_tbc.settings.fields import plain
from sb3_tbc.settings.kinds import Section, default_of, hints, section_of
from sb3_tbc.settings.texts import describe


@dataclass(frozen=True)
class Entry:
    """One setting, described for a reader.

    :param name: dotted name, e.g. ``low.gamma``
    :param allowed: which values it may have, in words
    :param default: its default, as YAML would have it; None for a section
    :param text: what it does
    """

    name: str
    allowed: str
    default: str | None
    text: str

    @property
    def section(self) -> str:
        """The section it stands in, empty at the top."""
        return self.name.rpartition(".")[0]


def entries(section: Section, settings: object = None, prefix: str = "") -> list[Entry]:
    """Every setting of a class: first its own, then those of its sections.

    :param section: the settings class
    :param settings: settings whose values are the defaults; by default those of the class
    :param prefix: name of the section, where it lies in another
    """
    texts = help_texts(section)
    own, inner = [], []
    for field, hint in zip(dataclasses.fields(section), hints(section).values(), strict=True):
        name = f"{prefix}.{field.name}" if prefix else field.name
        value = default_of(field) if settings is None else getattr(settings, field.name)
        below = section_of(hint)
        if below is None:
            own.append(Entry(name, describe(hint), yaml_text(plain(value)), texts.get(field.name, "")))
            continue
        shown = None if isinstance(value, below) else yaml_text(plain(value))
        allowed = "a section" if describe(hint).startswith("a section") else describe(hint)
        inner.append(Entry(name, allowed, shown, texts.get(field.name, "")))
        inner += entries(below, value if isinstance(value, below) else None, name)
    return own + inner


def yaml_text(value: object) -> str:
    """A plain value as YAML writes it on one line."""
    if value is None or isinstance(value, bool):
        return {None: "null", True: "true", False: "false"}[value]
    if isinstance(value, list):
        return f"[{', '.join(map(yaml_text, value))}]"
    return f"{value:,}".replace(",", "_") if isinstance(value, int) and value >= 10_000 else str(value)


@functools.cache
def _help_texts(section: Section) -> dict[str, str]:
    texts: dict[str, str] = {}
    for base in reversed(section.__mro__):
        if dataclasses.is_dataclass(base):
            texts |= _texts_in_source(base)
    return texts


def help_texts(section: Section) -> dict[str, str]:
    """Help text of each field on one line: the string below the field, or ``:param field:`` of the class's docstring.

    Base classes are included. Without source code there are no texts.
    """
    key: object = section
    return _help_texts(key)


def _texts_in_source(section: type) -> dict[str, str]:
    try:
        source = textwrap.dedent(inspect.getsource(section))
    except (OSError, TypeError):
        return {}
    (definition,) = ast.parse(source).body
    statements = definition.body if isinstance(definition, ast.ClassDef) else []
    found = _texts_of_parameters(inspect.getdoc(section) or "")
    for field, text in itertools.pairwise(statements):
        if isinstance(field, ast.AnnAssign) and isinstance(field.target, ast.Name) and isinstance(text, ast.Expr):
            value = text.value.value if isinstance(text.value, ast.Constant) else None
            if isinstance(value, str):
                found[field.target.id] = " ".join(value.split())
    return found


def _texts_of_parameters(docstring: str) -> dict[str, str]:
    """``:param name: text`` of a docstring, as sentences."""
    found = {}
    for part in re.split(r"^:(?=param )", docstring, flags=re.MULTILINE)[1:]:
        name, _, text = part.removeprefix("param ").partition(":")
        text = " ".join(re.split(r"^:", text, flags=re.MULTILINE)[0].split())
        found[name] = f"{text[:1].upper()}{text[1:]}."
    return found
