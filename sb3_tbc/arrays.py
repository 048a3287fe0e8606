"""Numbers and arrays that cross the borders between modules: their types, and what all modules ask of them."""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import Any, SupportsFloat

import numpy as np
from numpy.typing import NDArray

AnyArray = NDArray[Any]
"""Numbers of any kind."""

FloatArray = NDArray[np.floating[Any]]
"""Floating-point numbers of any precision."""

FloatType = type[np.floating[Any]]
"""A precision, such as ``np.float32``."""

Float32 = NDArray[np.float32]
"""Single precision: what networks see and replay buffers hold."""

BoolArray = NDArray[np.bool_]
IntArray = NDArray[np.int64]

Indices = NDArray[np.intp]
"""Positions in an array, such as the numbers of environments."""

Arrays = dict[str, NDArray[Any]]
"""Arrays by name, as they are written to files."""


def is_finite(number: SupportsFloat) -> bool:
    """Whether a number is finite; a whole number beyond the largest float is not."""
    try:
        return math.isfinite(number)
    except OverflowError:
        return False


def put_under(owner: str, arrays: Mapping[str, AnyArray]) -> Arrays:
    """Arrays under the name of their owner, ``owner.name``."""
    return {f"{owner}.{name}": array for name, array in arrays.items()}


def taken_from(owner: str, arrays: Mapping[str, AnyArray]) -> Arrays:
    """Those of many arrays that :func:`put_under` named, under their own names."""
    return {name.removeprefix(f"{owner}."): x for name, x in arrays.items() if name.startswith(f"{owner}.")}
