"""Checks that observations and rewards are finite, and the error if they are not."""

from __future__ import annotations

import math

import numpy as np

from sb3_tbc.arrays import AnyArray
from sb3_tbc.smdp.goal_spaces import GOAL_KEYS
from sb3_tbc.smdp.spaces import GoalObservation


def all_finite(*arrays: AnyArray) -> bool:
    """Whether arrays hold no NaN and nothing infinite."""
    # A sum of squares takes a third of the time of isfinite().all(); where it overflows, the slower test decides.
    squares = 0.0
    for array in arrays:
        squares += float(np.vdot(array, array))
    return math.isfinite(squares) or all(bool(np.isfinite(array).all()) for array in arrays)


def not_finite(seen: GoalObservation, reward: float = 0.0) -> str | None:
    """What is not finite in one environment; None if all is.

    :param seen: what it shows
    :param reward: what it paid
    """
    for key in GOAL_KEYS:
        if not np.isfinite(seen[key]).all():
            return f"observation[{key!r}] is not finite: {np.asarray(seen[key]).tolist()}"
    return None if math.isfinite(reward) else f"its reward is {reward}"


def place(index: int, step: int) -> str:
    """Which environment, and when.

    :param step: of its episode; 0 at its reset
    """
    return f"environment {index}, {f'step {step} of its episode' if step else 'reset'}"
