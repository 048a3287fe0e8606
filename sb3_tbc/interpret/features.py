"""What a task is about: the space its trajectories are drawn in, and the features that neurons may follow."""

from __future__ import annotations

from collections.abc import Callable
from typing import NamedTuple

import numpy as np

from sb3_tbc.arrays import FloatArray
from sb3_tbc.interpret.episodes import Trace
from sb3_tbc.smdp.spaces import SubgoalSpace


class TaskSpace(NamedTuple):
    """A task's natural space; functions take subgoal-space points ``(T, subgoal_dim)`` and observations ``(T, obs)``.

    ``height`` is None where nothing goes up or down, ``speed`` where the change of the place serves as speed.
    """

    labels: tuple[str, str]
    place: Callable[[FloatArray, FloatArray], FloatArray]  # (T, 2)
    height: Callable[[FloatArray, FloatArray], FloatArray] | None = None  # (T,)
    speed: Callable[[FloatArray, FloatArray], FloatArray] | None = None  # (T,)


UPPER_ARM, FOREARM, SHOULDER = 0.425, 0.39225, 0.089159  # of the UR5, m


def wrist(angles: FloatArray) -> FloatArray:
    """The wrist of a UR5: distance from the base's axis, and height, ``(T, 2)``; pan turns it around the axis."""
    lift, fore = angles[:, 1], angles[:, 1] + angles[:, 2]
    reach = UPPER_ARM * np.cos(lift) + FOREARM * np.cos(fore)
    return np.stack([reach, SHOULDER - UPPER_ARM * np.sin(lift) - FOREARM * np.sin(fore)], axis=1)


def _wrist_from_above(points: FloatArray, _: FloatArray) -> FloatArray:
    reach, pan = wrist(points)[:, 0], points[:, 0]
    return np.stack([reach * np.cos(pan), reach * np.sin(pan)], axis=1)


SPACES = {
    "Pendulum": TaskSpace(
        ("angle, rad (0 is upright)", "velocity, rad/s"),
        lambda point, _: point[:, :2],
        lambda point, _: 0.5 * np.cos(point[:, 0]),
        lambda point, _: np.abs(point[:, 1]),
    ),
    "Drawbridge": TaskSpace(
        ("position of the ship", "velocity of the ship"),
        lambda point, _: point[:, :2],
        None,
        lambda point, _: np.abs(point[:, 1]),
    ),
    "UR5Reacher": TaskSpace(
        ("wrist x, m", "wrist y, m"),
        _wrist_from_above,
        lambda point, _: wrist(point)[:, 1],
        lambda point, _: np.linalg.norm(point[:, 3:6], axis=1),
    ),
    "Platforms": TaskSpace(
        ("ball x, m", "ball y, m"),
        lambda point, _: point[:, :2],
        lambda point, _: point[:, 1],
        lambda point, _: np.linalg.norm(point[:, 2:4], axis=1),
    ),
    "AntFourRooms": TaskSpace(
        ("x, m", "y, m"),
        lambda point, _: point[:, :2],
        lambda point, _: point[:, 2],
        lambda point, _: np.linalg.norm(point[:, 3:5], axis=1),
    ),
    "Tennis2D": TaskSpace(
        ("joint 0", "joint 1"),
        lambda point, _: point[:, [0, 2]],
        None,
        lambda point, _: np.linalg.norm(point[:, 1::2], axis=1),
    ),
}
SPACES["UR5ReacherBullet"] = SPACES["UR5Reacher"]


def space_of(task: str, subgoals: SubgoalSpace) -> TaskSpace:
    """The space of a task; of a task that has none of its own, its first two subgoal coordinates.

    :param task: short name
    :param subgoals: of the agent
    """
    if task in SPACES:
        return SPACES[task]
    if subgoals.dim == 1:
        return TaskSpace(
            (subgoals.names[0], "step"),
            lambda p, _: np.stack([p[:, 0], np.arange(len(p))], axis=1),
            speed=lambda p, _: np.append(np.abs(np.diff(p[:, 0])), 0.0),
        )
    return TaskSpace((subgoals.names[0], subgoals.names[1]), lambda point, _: point[:, :2])


def points_of(trace: Trace, subgoals: SubgoalSpace) -> FloatArray:
    """Subgoal-space points of an episode before each step and after the last, ``(T+1, subgoal_dim)``."""
    episode = trace.episode
    seen = {
        "observation": episode.observation.astype(np.float64),
        "achieved_goal": episode.achieved_goal,
        "desired_goal": episode.desired_goal,
    }
    return np.asarray(subgoals.achieved(seen))


def places_of(trace: Trace, space: TaskSpace, subgoals: SubgoalSpace) -> FloatArray:
    """The trajectory in the task's space, ``(T+1, 2)``."""
    return space.place(points_of(trace, subgoals), trace.episode.observation)


def features_of(trace: Trace, space: TaskSpace, subgoals: SubgoalSpace, dt_max: float) -> dict[str, FloatArray]:
    """Task features at every step of an episode, each ``(T,)``.

    *speed*; *height change* over the step; *energy*, the squared action; *distance to subgoal* in units of the
    tolerance; *remaining time* as a share of the longest window.

    :param space: from :func:`space_of`
    :param subgoals: of the agent
    :param dt_max: longest time budget, steps
    """
    points, observation = points_of(trace, subgoals), trace.episode.observation
    if space.speed is None:
        place = space.place(points, observation)
        features = {"speed": np.linalg.norm(np.diff(place, axis=0), axis=1)}
    else:
        features = {"speed": space.speed(points, observation)[:-1]}
    if space.height is not None:
        features["height change"] = np.diff(space.height(points, observation))
    features["energy"] = (trace.episode.actions.astype(np.float64) ** 2).sum(axis=1)
    features["distance to subgoal"] = np.linalg.norm((points[:-1] - trace.subgoal) / subgoals.tolerance, axis=1)
    features["remaining time"] = trace.steps_left / dt_max
    return features
