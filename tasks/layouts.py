"""Sizes of the tasks' observation layouts: from the size of an observation to the layout that it has."""

from __future__ import annotations

SIZES = {
    "Pendulum": {"paper": 3, "compact": 3},
    "Drawbridge": {"paper": 85, "compact": 4},
    "UR5Reacher": {"paper": 48, "compact": 6},
    "UR5ReacherBullet": {"paper": 48, "compact": 6},
    "AntFourRooms": {"paper": 111, "compact": 29},
    "Platforms": {"paper": 75, "compact": 13},
    "Tennis2D": {"paper": 30, "compact": 14},
}
"""Entries of ``observation`` by task and layout; the first layout is the default of ``gymnasium.make``."""


def layout_of(task: str, size: int) -> str | None:
    """The layout in which a task's observation has ``size`` entries; None if there is none.

    :param task: short name
    :param size: entries of ``observation``
    """
    return next((layout for layout, entries in SIZES.get(task, {}).items() if entries == size), None)


def layout_cure(expected: int, given: int) -> str:
    """What to do about an observation of another size, if the task has a layout of the right one; else nothing.

    :param expected: entries of ``observation`` that an agent was trained on
    :param given: entries that it got
    """
    for task in SIZES:
        wanted, got = layout_of(task, expected), layout_of(task, given)
        if wanted is not None and got is not None and expected != given:
            return (
                f" This looks like {task}, whose layout {wanted!r} has {expected} entries and {got!r} has {given}: "
                f'make it with gymnasium.make("sb3_tbc/{task}-v0", observation="{wanted}").'
            )
    return ""
