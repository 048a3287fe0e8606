"""Sphinx configuration. Pages and pictures that can be derived are made here, so that they are never out of date."""

from __future__ import annotations

import io
import os
import sys
from contextlib import redirect_stdout, suppress
from importlib import import_module
from pathlib import Path
from typing import Any

import sb3_tbc
from sb3_tbc.commands import COMMANDS
from sb3_tbc.zoo.settings_page import settings_markdown

HERE = Path(__file__).parent
sys.path.insert(0, str(HERE / "images"))

project = "sb3_tbc"
author = "The sb3_tbc developers"
release = sb3_tbc.__version__
extensions = ["myst_parser", "sphinx.ext.autodoc"]
source_suffix = {".md": "markdown"}
exclude_patterns = ["_build", "package_index.md"]
myst_enable_extensions = ["dollarmath", "colon_fence"]
myst_heading_anchors = 3
html_theme = "furo"
html_title = f"sb3_tbc {release}"
html_static_path = ["_static"]
html_css_files = ["tables.css"]
autodoc_typehints = "description"
autodoc_member_order = "bysource"
autodoc_inherit_docstrings = False
suppress_warnings = ["ref.python", "ref.ref"]  # SB3's own names are not described here


def write_commands() -> None:
    """``commands.md``: the help text of every command, as it is printed."""
    parts = ["# Commands\n\n`sb3-tbc <command>` and `python -m sb3_tbc.<command>` are the same.\n"]
    for name, command in COMMANDS.items():
        text = _help(command.module)
        parts.append(f"## {name}\n\n{command.text[0].upper()}{command.text[1:]}.\n\n```text\n{text}```\n")
    _write("commands.md", "\n".join(parts))


def _help(module: str) -> str:
    """What a command prints for ``--help``."""
    printed = io.StringIO()
    with redirect_stdout(printed), suppress(SystemExit):
        import_module(module).main(["--help"])
    return printed.getvalue()


def write_curves() -> None:
    """The learning curves of the page on signs of trouble."""
    import draw_signs

    draw_signs.draw_all(HERE / "_static" / "signs")


def _write(name: str, text: str) -> None:
    path = HERE / name
    if not path.is_file() or path.read_text(encoding="utf-8") != text:
        path.write_text(text, encoding="utf-8")


def setup(app: Any) -> None:
    """Sphinx's hook: derive pages before they are read."""
    os.environ["COLUMNS"] = "100"
    write_commands()
    _write("settings.md", settings_markdown())
    write_curves()
