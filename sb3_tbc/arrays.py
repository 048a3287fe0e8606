"""Types of the arrays that cross the borders between modules."""

from __future__ import annotations

from typing import Any

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
