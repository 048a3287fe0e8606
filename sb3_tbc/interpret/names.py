"""Names of what enters and leaves a low level: sensory neurons and actions in the task's own words."""

from __future__ import annotations

from sb3_tbc.smdp.views import LevelViews

_QUATERNION = ("q_w", "q_x", "q_y", "q_z")
_LEGS = tuple(f"{joint}_{k}" for k in range(1, 5) for joint in ("hip", "ankle"))
_ARM = ("pan", "lift", "elbow")

SENSES: dict[str, tuple[str, ...]] = {
    "Pendulum": ("cos angle", "sin angle", "velocity"),
    "Drawbridge": ("time", "sails", "position", "velocity"),
    "UR5Reacher": (*_ARM, *(f"{joint} speed" for joint in _ARM)),
    "UR5ReacherBullet": (*_ARM, *(f"{joint} speed" for joint in _ARM)),
    "Platforms": (
        "spin",
        *(f"platform {k} {part}" for k in range(2) for part in ("x", "y", "v_x", "v_y")),
        "ball x", "ball y", "ball v_x", "ball v_y",
    ),
    "AntFourRooms": (
        "x", "y", "z", *_QUATERNION, *_LEGS, "v_x", "v_y", "v_z", "w_x", "w_y", "w_z",
        *(f"{leg} speed" for leg in _LEGS),
    ),
    "Tennis2D": tuple(f"joint {k}{part}" for k in range(3) for part in ("", " speed")),
}  # fmt: skip
"""What the low level sees of each task, entry by entry."""

ACTIONS: dict[str, tuple[str, ...]] = {
    "Pendulum": ("torque",),
    "Drawbridge": ("sails",),
    "UR5Reacher": _ARM,
    "UR5ReacherBullet": _ARM,
    "Platforms": ("force",),
    "AntFourRooms": tuple(f"{joint}_{k}" for k in (4, 1, 2, 3) for joint in ("hip", "ankle")),
    "Tennis2D": tuple(f"torque {k}" for k in range(3)),
}


def input_names(task: str, views: LevelViews) -> tuple[str, ...]:
    """A name for each sensory neuron: local state, subgoal, remaining time.

    :param task: short name; the local state of a task that is not known here is numbered
    :param views: of the agent
    """
    subgoals = views.subgoals
    known = SENSES.get(task, ())
    senses = known if len(known) == subgoals.local_dim else tuple(f"state {i}" for i in range(subgoals.local_dim))
    to = "to" if views.relative_subgoals else "subgoal"
    asked = tuple(f"{to} {name.replace('_', ' ')}" for name in subgoals.names)
    return (*senses, *asked, *(("time left",) if views.remaining_time else ()))


def action_names(task: str, n_actions: int) -> tuple[str, ...]:
    """A name for each action.

    :param task: short name; the actions of a task that is not known here are numbered
    :param n_actions: how many there are
    """
    known = ACTIONS.get(task, ())
    return known if len(known) == n_actions else tuple(f"action {i}" for i in range(n_actions))
