"""Checks that observations and rewards are finite, and the error if they are not."""

from __future__ import annotations

import math

import numpy as np

from sb3_tbc.arrays import BoolArray, FloatArray, IntArray
from sb3_tbc.errors import NonFiniteError
from sb3_tbc.smdp.goal_spaces import GOAL_KEYS
from sb3_tbc.smdp.spaces import GoalObservation


def all_finite(*arrays: FloatArray) -> bool:
    """Whether arrays hold no NaN and nothing infinite."""
    # A sum of squares takes a third of the time of isfinite().all(); where it overflows, the slower test decides.
    return all(math.isfinite(np.vdot(a, a)) or bool(np.isfinite(a).all()) for a in arrays)


def bad_rows(seen: GoalObservation, rewards: FloatArray | None = None) -> BoolArray:
    """Which environments gave an observation or reward that is not finite, ``(n_envs,)``.

    :param seen: their observations, one row each
    :param rewards: their rewards, ``(n_envs,)``
    """
    bad = np.logical_or.reduce([~np.isfinite(seen[key]).all(axis=1) for key in GOAL_KEYS])
    return np.asarray(bad if rewards is None else bad | ~np.isfinite(rewards))


def describe(index: int, step: int, seen: GoalObservation, rewards: FloatArray | None = None) -> str:
    """What is not finite in one environment.

    :param index: of the environment
    :param step: of its episode; 0 at its reset
    """
    for key in GOAL_KEYS:
        if not np.isfinite(seen[key][index]).all():
            return f"{_place(index, step)}: observation[{key!r}] is not finite: {seen[key][index].tolist()}"
    reward = None if rewards is None else float(rewards[index])
    return f"{_place(index, step)}: its reward is {reward}"


def refusal(seen: GoalObservation, steps: IntArray, rewards: FloatArray | None = None) -> NonFiniteError:
    """The error for values that are not finite, which would spoil learning; it names environment, step and key.

    :param steps: of the episodes, ``(n_envs,)``
    """
    index = int(np.flatnonzero(bad_rows(seen, rewards))[0])
    return NonFiniteError(
        f"{describe(index, int(steps[index]), seen, rewards)}. The step was not stored: look into the environment"
    )


def _place(index: int, step: int) -> str:
    return f"environment {index}, {f'step {step} of its episode' if step else 'reset'}"
