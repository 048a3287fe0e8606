"""The compiler of updates on machines that are not as torch expects them."""

from __future__ import annotations

import logging
import os
import shlex
from pathlib import Path

import pytest
import torch as th
from torch.utils import cpp_extension

from sb3_tbc.level import compilation
from tests.levels import COMPILER


def double(x: th.Tensor) -> None:
    x.mul_(2.0).add_(th.tanh(x))


@pytest.fixture
def spaced(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> str:
    """Torch's libraries in a folder with a space in its name, as in a checkout in ``my projects``."""
    folder = tmp_path / "my projects"
    folder.symlink_to(cpp_extension.TORCH_LIB_PATH, target_is_directory=True)
    monkeypatch.setattr(cpp_extension, "TORCH_LIB_PATH", str(folder))
    monkeypatch.setenv("TORCHINDUCTOR_CACHE_DIR", str(tmp_path / "cache"))
    return str(folder)


@pytest.mark.skipif(os.name != "posix", reason="torch quotes the folder there")
def test_folder_of_libraries_is_one_word(spaced: str) -> None:
    with compilation.libraries_found():
        assert shlex.split(f"-L{cpp_extension.TORCH_LIB_PATH} -ltorch") == [f"-L{spaced}", "-ltorch"]
    assert spaced == cpp_extension.TORCH_LIB_PATH


@pytest.mark.slow
@COMPILER
@pytest.mark.usefixtures("spaced")
def test_compiles_in_a_folder_with_a_space() -> None:
    compiled = compilation.compile_step(double, [th.zeros(3)], True)
    x, y = th.ones(3), th.ones(3)
    compiled(x)
    double(y)
    assert th.allclose(x, y)


def test_log_says_what_the_compiler_said(monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture) -> None:
    def fail(*args: object) -> None:
        raise RuntimeError("C++ compile error\n\nCommand:\ng++ a.cpp\n\nOutput:\n/usr/bin/ld: cannot find -ltorch\n")

    monkeypatch.setattr(compilation, "compiler_problem", lambda: None)
    monkeypatch.setattr(compilation, "_compile", fail)
    with caplog.at_level(logging.WARNING):
        assert compilation.compile_step(double, [th.zeros(3)], "auto") is double
    assert "cannot find -ltorch" in caplog.text
