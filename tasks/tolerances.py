"""Thresholds of subgoals: how far from a goal a task's success test still counts it as reached, found by bisection."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from .probe import Floats
from .success_test import Test

N_GOALS = 8
"""Number of observed goals that the test is asked about."""
HALVINGS = 40


class Tolerances(NamedTuple):
    """Thresholds of groups of coordinates."""

    thresholds: list[float]  # task units; radians for rotations
    groups: list[list[int]]
    rotations: list[int]  # which groups are unit quaternions


def quaternions(goals: Floats) -> list[list[int]]:
    """Runs of four coordinates that form unit quaternions throughout.

    :param goals: observed goals ``(n, goal_dim)``
    """
    found, first = [], 0
    while first + 4 <= goals.shape[1]:
        unit = np.allclose(np.linalg.norm(goals[:, first : first + 4], axis=1), 1.0, atol=1e-4)
        if unit:
            found.append(list(range(first, first + 4)))
        first += 4 if unit else 1
    return found


def tolerances_of(success: Test, goals: Floats, span: Floats, rotated: list[list[int]]) -> Tolerances:
    """Ask a success test how far each coordinate, and each rotation, may be off.

    Coordinates that count together, as in a Euclidean distance, share a group. A coordinate that the task ignores gets
    twice the widest span of all, so that every subgoal counts as reached in it. If the task demands the exact value,
    the tolerance is 5 % of the span.

    :param success: the task's test
    :param goals: observed goals ``(n, goal_dim)``
    :param span: between the bounds of subgoals, ``(goal_dim,)``
    :param rotated: coordinates that form :func:`quaternions`
    """
    single = [i for i in range(goals.shape[1]) if not any(i in block for block in rotated)]
    some = goals[np.unique(np.linspace(0, len(goals) - 1, N_GOALS).astype(int))]
    reach = 2.0 * float(span.max())
    along = reach * np.eye(len(span))[single]
    shares = np.minimum(_largest(success, some, along), _largest(success, some, -along)) if single else np.zeros(0)
    exact = 0.05 * span[single]
    limits = np.array([float(f"{s * reach:.6g}") if s > 1e-9 else e for s, e in zip(shares, exact, strict=True)])
    groups = [[single[i] for i in part] for part in _coupled(success, some, limits, shares, single)]
    of = dict(zip(single, limits.tolist(), strict=True))
    thresholds = [of[part[0]] for part in groups]
    angles = [_angle(success, some, block) for block in rotated]
    return Tolerances([*thresholds, *angles], [*groups, *rotated], list(range(len(groups), len(groups) + len(rotated))))


def _largest(success: Test, goals: Floats, directions: Floats) -> Floats:
    """Largest share of each direction ``(k, goal_dim)`` that every goal tolerates, ``(k,)``; at most 1."""
    k = len(directions)
    desired = np.repeat(goals, k, axis=0)
    along = np.tile(directions, (len(goals), 1))
    inside, outside = np.zeros(len(desired)), np.ones(len(desired))
    everything = success(desired + along, desired)
    for _ in range(HALVINGS):
        middle = 0.5 * (inside + outside)
        near = success(desired + middle[:, None] * along, desired)
        inside, outside = np.where(near, middle, inside), np.where(near, outside, middle)
    least: Floats = np.where(everything, 1.0, inside).reshape(len(goals), k).min(axis=0)
    return least


def _coupled(success: Test, goals: Floats, limits: Floats, shares: Floats, single: list[int]) -> list[list[int]]:
    """Groups of positions in ``single`` that have one tolerance and count together.

    Two coordinates count together if a point nine tenths of the tolerance away in both is too far.
    """
    groups: list[list[int]] = []
    for i in range(len(single)):
        home = next((g for g in groups if _together(success, goals, limits, shares, single, g[0], i)), None)
        if home is None:
            groups.append([i])
        else:
            home.append(i)
    return groups


def _together(success: Test, goals: Floats, limits: Floats, shares: Floats, single: list[int], i: int, j: int) -> bool:
    if max(shares[i], shares[j]) == 1.0 or not np.isclose(limits[i], limits[j], rtol=1e-3):
        return False
    away = np.zeros(goals.shape[1])
    away[[single[i], single[j]]] = 0.9 * limits[[i, j]]
    return not success(goals + away, goals).any()


def _angle(success: Test, goals: Floats, block: list[int]) -> float:
    """Largest rotation [rad] about any axis that every goal tolerates; beyond pi where the task ignores rotations.

    ``cos(t/2) q + sin(t/2) u`` with ``u`` perpendicular to the quaternion ``q`` is ``q`` turned by ``t``, whichever
    order its entries have.
    """
    inside, outside = 0.0, np.pi
    if _turns(success, goals, block, np.pi).all():
        return float(np.pi) + 0.1
    for _ in range(HALVINGS):
        middle = 0.5 * (inside + outside)
        if _turns(success, goals, block, middle).all():
            inside = middle
        else:
            outside = middle
    return float(f"{inside:.6g}") if inside > 1e-6 else 0.05 * float(np.pi)


def _turns(success: Test, goals: Floats, block: list[int], angle: float) -> np.ndarray[tuple[int], np.dtype[np.bool_]]:
    turned, desired = [], []
    for goal in goals:
        quaternion = goal[block]
        for u in np.linalg.svd(quaternion[None])[2][1:]:
            point = goal.copy()
            point[block] = np.cos(angle / 2) * quaternion + np.sin(angle / 2) * u
            turned.append(point)
            desired.append(goal)
    return np.asarray(success(np.stack(turned), np.stack(desired)))
