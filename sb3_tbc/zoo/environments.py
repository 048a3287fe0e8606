"""Makes goal environments from a name on the command line."""

from __future__ import annotations

import traceback
from collections.abc import Iterable, Mapping
from functools import partial
from pathlib import Path
from typing import Any

import gymnasium as gym
from stable_baselines3.common.base_class import BaseAlgorithm
from stable_baselines3.common.env_util import make_vec_env
from stable_baselines3.common.vec_env import VecEnv

from sb3_tbc.aliases import Env, PlainMapping
from sb3_tbc.errors import ConfigError, nearest
from sb3_tbc.outside import one_line
from sb3_tbc.smdp.goal_spaces import goal_parts, goal_space_problems
from sb3_tbc.smdp.goal_vec_env import GoalVecEnv
from sb3_tbc.tasks.foreign import ROBOTICS, home_of, import_quietly
from sb3_tbc.tasks.generic import DescribedGoalEnv, GoalEnvDescription

NAMESPACE = "sb3_tbc/"
OTHER_PACKAGES = {  # how ids begin: module that registers them, name of its distribution
    **dict.fromkeys(
        ("Fetch", "PointMaze", "AntMaze", "Adroit", "Hand", "FrankaKitchen"), (ROBOTICS, "gymnasium-robotics")
    ),
    "Panda": ("panda_gym", "panda-gym"),
    "parking": ("highway_env", "highway-env"),
}
_DESCRIPTIONS: dict[str, GoalEnvDescription] = {}
"""Descriptions by id and arguments, so that equal environments need the random episodes only once."""


def task_names() -> dict[str, str]:
    """Short task names and their environment ids."""
    ids = sorted(i for i in gym.registry if i.startswith(NAMESPACE))
    return {i.removeprefix(NAMESPACE).rpartition("-v")[0]: i for i in ids}


def resolve_env(name: str) -> tuple[str, str]:
    """Task name and environment id of ``Pendulum``, ``sb3_tbc/Pendulum-v0``, any registered id, or ``module:id``.

    Upper and lower case are not distinguished.

    Ids of Gymnasium-Robotics need no module: where it is installed, ``FetchReach-v4`` finds it.

    :return: name (as in run folders and sections of configuration files), and id with its module, so that a saved
        agent finds its environment again
    :raises ConfigError: naming the nearest known one
    """
    tasks = task_names()
    name = _as_spelt(name, tasks)
    if name in tasks:
        return name, tasks[name]
    module, _, env_id = name.rpartition(":")
    if module:
        _import(module, name)
    home = module or (home_of(env_id) if "-v" in env_id else None)
    env_id = _as_spelt(env_id, gym.registry)
    if env_id in gym.registry:
        short = {i: task for task, i in tasks.items()}
        return short.get(env_id, env_id), f"{home}:{env_id}" if home else env_id
    raise ConfigError(f"unknown environment {name!r}; {nearest(name, _known(name, tasks))}{_hint(env_id)}")


def _as_spelt(name: str, known: Iterable[str]) -> str:
    """The known name that equals ``name`` but for upper and lower case, if there is exactly one; else ``name``."""
    alike = [other for other in known if other.lower() == name.lower()]
    return name if name in alike or len(alike) != 1 else alike[0]


def _import(module: str, name: str) -> None:
    try:
        import_quietly(module)
    except ImportError as error:
        raise ConfigError(f"cannot import module {module!r} of environment {name!r}: {error}") from error


def _hint(env_id: str) -> str:
    """The part of a message that says how to get the environments of a known package."""
    found = [place for start, place in OTHER_PACKAGES.items() if env_id.startswith(start)]
    if not found:
        return ""
    module, distribution = found[0]
    if module == ROBOTICS:
        installed = any(i.startswith(("Fetch", "PointMaze", "AntMaze")) for i in gym.registry)
        return "" if installed else f"; it is one of {module}'s: pip install {distribution}"
    return f"; ids of {distribution} are written with its module, {module}:{env_id} (pip install {distribution})"


def _known(name: str, tasks: Mapping[str, str]) -> list[str]:
    """Names to suggest: ids if the name looks like an id, else our short names."""
    return [*tasks, *gym.registry] if "-v" in name or "/" in name else list(tasks)


def make_envs(env_id: str, n_envs: int, seed: int | None, env_kwargs: PlainMapping | None = None) -> VecEnv:
    """A vector of monitored goal environments in this process.

    :param env_id: as registered
    :param n_envs: how many
    :param seed: environment ``i`` gets ``seed + i``
    :param env_kwargs: arguments of ``gymnasium.make``; ``subgoals`` goes to
        :class:`~sb3_tbc.tasks.generic.DescribedGoalEnv` instead (``low``, ``high``, ``thresholds``, ``names``)
    :raises ConfigError: if it cannot be made, is not a goal environment, its actions are not a Box, or ``subgoals`` is
        given for an environment that defines its own
    """
    try:
        kwargs = dict(env_kwargs or {})
        return make_vec_env(partial(make_env, env_id), n_envs, seed=seed, env_kwargs=kwargs, vec_env_cls=GoalVecEnv)
    except ConfigError:
        raise
    except Exception as error:  # An environment's own code may fail in any way.
        given = f" with {dict(env_kwargs)}" if env_kwargs else ""
        raise ConfigError(f"cannot make environment {env_id!r}{given}: {_cause(error)}") from error


def _cause(error: Exception) -> str:
    """Return one line: the message if it explains the error, else also the error's type and place."""
    if isinstance(error, (gym.error.Error, ImportError, TypeError, ValueError)) and str(error):
        return str(error)
    place = traceback.extract_tb(error.__traceback__)[-1]
    message = str(error) or place.line or "no message"
    return f"{type(error).__name__} in {Path(place.filename).name}, line {place.lineno}: {message}"


def make_env(env_id: str, subgoals: PlainMapping | None = None, **env_kwargs: Any) -> Env:
    """Make one environment, with pictures if it can draw them; a foreign goal environment gets a derived subgoal space.

    Training, evaluation, films and the check of exports all make their environments here.

    :param env_id: as registered, with its module if it has one
    :param subgoals: arguments of :class:`~sb3_tbc.tasks.generic.DescribedGoalEnv`
    :param env_kwargs: arguments of ``gymnasium.make``
    :raises ConfigError: if its module cannot be imported, it is no goal environment, its actions are not a Box, or
        ``subgoals`` is given although it defines its own
    """
    module = env_id.rpartition(":")[0]
    if module:
        _import(module, env_id)
    env: Env
    try:
        env = gym.make(env_id, **{"render_mode": "rgb_array", **env_kwargs})
    except TypeError:
        env = gym.make(env_id, **env_kwargs)
    try:
        check_goal_env(env, env_id)  # before a vector is made of it, which fails on spaces within spaces
    except ConfigError:
        env.close()
        raise
    if env.has_wrapper_attr("subgoals"):
        if subgoals:
            raise ConfigError(f"{env_id!r} defines its own subgoal space; leave out `subgoals`, got {dict(subgoals)}")
        return env
    made_alike = repr((env.spec, sorted(env_kwargs.items()), sorted((subgoals or {}).items())))
    env = described = DescribedGoalEnv(env, description=_DESCRIPTIONS.get(made_alike), **(subgoals or {}))
    _DESCRIPTIONS[made_alike] = described.description
    return env


def refuse_other_spaces(model: BaseAlgorithm, env: Env | VecEnv) -> None:
    """Refuse an environment in which an agent cannot act.

    :raises ConfigError: if its observations or actions are not those of the agent's own
    """
    for name in ("observation_space", "action_space"):
        own, given = goal_parts(getattr(model, name)), goal_parts(getattr(env, name))
        if given != own:
            raise ConfigError(
                f"agent and environment do not fit: the agent's {name} is {one_line(own, 200)}, the environment's "
                f"{one_line(given, 200)}; --env names another one"
            )


def check_goal_env(env: Env, env_id: str) -> None:
    """Refuse environments in which a hierarchical agent cannot act.

    :raises ConfigError: naming what is missing
    """
    problems = goal_space_problems(env.observation_space, env.action_space)
    if problems:
        raise ConfigError(
            f"{env_id!r} cannot be used: {'; '.join(problems)}. Use a goal environment with continuous actions, "
            f"derived from gymnasium_robotics.core.GoalEnv, e.g. {', '.join(task_names())}"
        )
