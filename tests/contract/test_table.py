"""The page's table and the tests: each row is shown by a test, and all that SB3 offers has a row."""

from __future__ import annotations

import importlib.util
import inspect
import re
from pathlib import Path

import pytest
from contract import PAGE, SHOWN, table_rows
from stable_baselines3 import SAC
from stable_baselines3.common import callbacks, vec_env
from stable_baselines3.common.off_policy_algorithm import OffPolicyAlgorithm

HERE = Path(__file__).parent


@pytest.fixture(scope="module")
def rows() -> list[str]:
    """The rows of the page; the tests say theirs when their modules are imported."""
    for path in sorted(HERE.glob("test_*.py")):
        if path.name != Path(__file__).name:
            spec = importlib.util.spec_from_file_location(f"contract_{path.stem}", path)
            assert spec is not None
            assert spec.loader is not None
            spec.loader.exec_module(importlib.util.module_from_spec(spec))
    return table_rows()


def test_every_row_is_shown_by_a_test(rows: list[str]) -> None:
    assert len(rows) == len(set(rows)) > 80
    assert set(rows) - set(SHOWN) == set()


def test_every_test_has_its_row(rows: list[str]) -> None:
    assert set(SHOWN) - set(rows) == set()


def test_test_files_that_rows_name_exist() -> None:
    for name in re.findall(r"\| `(tests/\S+?)` \|", PAGE.read_text(encoding="utf-8")):
        assert (PAGE.parents[1] / name).is_file(), name


def named() -> str:
    """All names in the first columns."""
    return " ".join(row.rpartition(":")[0] for row in table_rows())


def test_every_method_argument_callback_and_vector_of_sb3_has_a_row() -> None:
    methods = {name for name in dir(OffPolicyAlgorithm) if not name.startswith("_")} - {"policy_aliases"}
    arguments = set(inspect.signature(SAC.__init__).parameters) - {"self", "_init_setup_model"}
    classes = {
        name
        for module in (callbacks, vec_env)
        for name, value in vars(module).items()
        if inspect.isclass(value) and value.__module__.startswith("stable_baselines3")
    } - {"VecEnv", "CloudpickleWrapper", "StackedObservations", "Logger"}
    missing = {name for name in methods | arguments | classes if not re.search(rf"\b{name}\b", named())}
    assert missing == set()


def test_the_page_says_how_sb3s_own_suite_is_run() -> None:
    assert "python scripts/sb3_suite" in PAGE.read_text(encoding="utf-8")
