"""Goal-conditioned tasks, registered with Gymnasium as ``sb3_tbc/<Task>-v0``."""

from __future__ import annotations

from collections.abc import Mapping
from importlib import import_module
from inspect import signature

import gymnasium
from gymnasium.envs.registration import WrapperSpec

from sb3_tbc.aliases import Env, PlainMapping

_CLASSES = {  # module, time limit
    "Pendulum": ("pendulum", 1000),
    "Drawbridge": ("drawbridge", 1000),
    "UR5Reacher": ("ur5_reacher", 600),
    "UR5ReacherBullet": ("ur5_reacher_bullet", 600),
    "AntFourRooms": ("ant_four_rooms", 700),
    "Platforms": ("platforms", 500),
    "Tennis2D": ("tennis2d", 500),
}
TASKS = tuple(_CLASSES)
"""Names of the tasks; the id of each is ``sb3_tbc/<name>-v0``."""


def make_task(task: str, perturb: PlainMapping | None = None, **kwargs: object) -> Env:
    """Build a task; the entry point behind ``gymnasium.make("sb3_tbc/<task>-v0", **kwargs)``.

    :param task: one of :data:`TASKS`
    :param perturb: arguments of :class:`sb3_tbc.tasks.perturb.Perturb`; none by default
    :param kwargs: passed to the task's class
    :raises ValueError: for an unknown task or perturbation
    :raises TypeError: for a ``perturb`` that is no dictionary
    """
    if task not in _CLASSES:
        raise ValueError(f"task must be one of {TASKS}, got {task!r}")
    try:
        task_class = getattr(import_module(f"{__name__}.{_CLASSES[task][0]}"), task)
    except (ImportError, AttributeError) as error:
        if "mujoco" not in str(error).lower():
            raise
        raise import_module(f"{__name__}.mujoco_install").half_upgraded(error) from error
    env: Env = task_class(**kwargs)
    if not perturb:
        return env
    perturb_class = import_module(f"{__name__}.perturb").Perturb
    allowed = list(signature(perturb_class).parameters)[1:]
    if not isinstance(perturb, Mapping):
        raise TypeError(f"perturb must be a dictionary with keys of {allowed}, got {perturb!r}")
    unknown = sorted(set(perturb) - set(allowed), key=str)
    if unknown:
        raise ValueError(f"perturb has unknown keys {unknown}; allowed are {allowed}")
    perturbed: Env = perturb_class(env, **perturb)
    return perturbed


# What gymnasium.make reads of an entry point that is a class, so that render_mode="rgb_array_list" works.
make_task.metadata = {"render_modes": ["rgb_array", "human"]}  # type: ignore[attr-defined]


def register_tasks() -> None:
    """Register every task with Gymnasium; calling it again changes nothing.

    Of the wrappers that ``gymnasium.make`` adds, only the ``TimeLimit`` is kept: the tasks themselves check actions and
    the order of calls. Around it :class:`~sb3_tbc.tasks.goal_access.GoalAccess` shows the task's own attributes.
    """
    for task, (_, max_episode_steps) in _CLASSES.items():
        task_id = f"sb3_tbc/{task}-v0"
        if task_id not in gymnasium.registry:
            gymnasium.register(
                id=task_id,
                entry_point="sb3_tbc.tasks:make_task",
                kwargs={"task": task},
                max_episode_steps=max_episode_steps,
                order_enforce=False,
                disable_env_checker=True,
                additional_wrappers=(WrapperSpec("GoalAccess", "sb3_tbc.tasks.goal_access:GoalAccess", {}),),
            )
