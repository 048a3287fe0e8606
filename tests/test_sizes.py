"""Modules and functions stay short enough to read, and types say more than ``Any``."""

from __future__ import annotations

import ast
import re
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[1]
MODULES = sorted([*(ROOT / "sb3_tbc").rglob("*.py"), *(ROOT / "tasks").rglob("*.py")])
LONGEST_MODULE, LONGEST_FUNCTION, LINES_PER_ANY = 450, 60, 70


@pytest.mark.parametrize("path", MODULES, ids=lambda path: str(path.relative_to(ROOT)))
def test_modules_and_functions_are_short(path: Path) -> None:
    text = path.read_text(encoding="utf-8")
    assert len(text.splitlines()) <= LONGEST_MODULE
    for node in ast.walk(ast.parse(text)):
        if isinstance(node, ast.FunctionDef | ast.AsyncFunctionDef):
            assert node.end_lineno is not None
            assert node.end_lineno - node.lineno < LONGEST_FUNCTION, node.name


def test_any_is_rare() -> None:
    lines = [line for path in MODULES for line in path.read_text(encoding="utf-8").splitlines()]
    words = sum(len(re.findall(r"\bAny\b", line)) for line in lines if not line.startswith(("from ", "import ")))
    assert words * LINES_PER_ANY <= len(lines)
