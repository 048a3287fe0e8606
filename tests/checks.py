"""What tests of several folders check in the same way."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest


def said(capsys: pytest.CaptureFixture[str]) -> str:
    """Standard error, which must be one line without a traceback."""
    captured = capsys.readouterr()
    assert captured.err.count("\n") == 1, captured.err
    assert "Traceback" not in captured.err
    return captured.err


def assert_same(first: dict[str, Any], second: dict[str, Any]) -> None:
    """Equal to the bit, by name."""
    assert first.keys() == second.keys()
    for key, value in first.items():
        np.testing.assert_array_equal(second[key], value, err_msg=key)
