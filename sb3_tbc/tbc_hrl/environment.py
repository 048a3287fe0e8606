"""The vector that an agent learns in, and what it asks of it: attributes of the task, how long an episode lasts."""

from __future__ import annotations

import contextlib
import math
import re
from collections.abc import Iterator
from typing import Any

import gymnasium as gym
import numpy as np
from stable_baselines3.common.base_class import BaseAlgorithm
from stable_baselines3.common.type_aliases import GymEnv
from stable_baselines3.common.utils import check_for_correct_spaces
from stable_baselines3.common.vec_env import VecEnv

from sb3_tbc.errors import ConfigError
from sb3_tbc.outside import one_line
from sb3_tbc.smdp.bounds import RewardRange
from sb3_tbc.smdp.episode_limit import with_episode_limit
from sb3_tbc.smdp.faults import watch
from sb3_tbc.smdp.goal_spaces import check_goal_space
from sb3_tbc.smdp.goal_test import check_goal_test
from sb3_tbc.smdp.goal_vec_env import in_goal_vec_env
from sb3_tbc.smdp.spaces import SubgoalSpace
from sb3_tbc.tasks.layouts import layout_cure
from sb3_tbc.tasks.time_limit import declared_limit, time_limit
from sb3_tbc.tbc_hrl.checks import refuse_vec_normalize


def attribute_of(env: VecEnv, name: str) -> Any:
    """Attribute of the first task under its wrappers; None where there is none."""
    # Asking for what is not there would end the process of an environment that has one of its own.
    return env.get_attr(name, indices=[0])[0] if env.has_attr(name) else None


def in_vector(env: GymEnv, verbose: int = 0, monitor_wrapper: bool = True) -> VecEnv:
    """A vector of environments whose episodes an agent can end; single ones in one that can be resumed.

    :param verbose: see SB3
    :param monitor_wrapper: likewise
    :raises TypeError: if it is neither an environment nor a vector
    :raises ValueError: if an agent cannot reach goals in it, naming every reason
    """
    if not isinstance(env, gym.Env | VecEnv):
        raise TypeError(
            f"env must be an environment, the id of one, or a vector of them (VecEnv), got {one_line(repr(env), 100)}"
        )
    given = in_goal_vec_env(env) if monitor_wrapper else env
    venv = BaseAlgorithm._wrap_env(given, verbose, monitor_wrapper)
    check_goal_space(venv.observation_space, venv.action_space)
    watch(venv)
    return with_episode_limit(venv)


def in_fitting_vector(env: GymEnv, agent: BaseAlgorithm) -> VecEnv:
    """As :func:`in_vector`, of an environment in which an agent is to go on learning.

    :raises ValueError: if its spaces are others, it normalises observations, or goals cannot be relabelled in it
    """
    venv = in_vector(env, agent.verbose)
    refuse_vec_normalize(venv)
    check_for_correct_spaces(venv, agent.observation_space, agent.action_space)
    check_goal_test(venv)
    return venv


def subgoals_of(env: VecEnv) -> SubgoalSpace | None:
    """The subgoal space that a task defines; None where it does not.

    :raises ConfigError: if its attribute of this name is something else
    """
    found = attribute_of(env, "subgoals")
    if found is not None and not isinstance(found, SubgoalSpace):
        raise ConfigError(
            f"the environment's attribute subgoals must be a SubgoalSpace, got {one_line(repr(found), 100)}; "
            "SubgoalSpace.from_slices makes one"
        )
    return found


def reward_range(env: VecEnv) -> RewardRange | None:
    """Lowest and highest reward of a step, which tasks say as ``reward_range``; None where the environment does not.

    :raises ConfigError: if what it says is no range
    """
    said = attribute_of(env, "reward_range")
    if said is None:
        return None
    try:
        low, high = map(float, said)
    except (TypeError, ValueError):
        low, high = math.nan, math.nan
    if not low <= high:
        raise ConfigError(f"the environment's reward_range must be (lowest, highest), two numbers, got {said!r}")
    return RewardRange(low, high) if np.isfinite([low, high]).all() else None


def episode_length(env: VecEnv) -> int | None:
    """Time limit of the task under its wrappers, environment steps; None where it has none.

    Environments in this process are examined wrapper by wrapper, those in other processes by their attributes.
    """
    inner = getattr(env.unwrapped, "envs", None)
    limit: int | None
    if inner:
        limit = time_limit(inner[0])
    else:
        keeps_own = attribute_of(env, "truncates_itself") in (None, True)
        limit = declared_limit(attribute_of(env, "spec"), attribute_of(env, "max_episode_steps"), keeps_own)
        wrapped = attribute_of(env, "_max_episode_steps")  # of the outermost TimeLimit
        limit = min(limit, int(wrapped)) if limit and wrapped else limit or wrapped
    return limit


@contextlib.contextmanager
def mismatch_explained() -> Iterator[None]:
    """Name the layout to use where SB3 finds that an agent and an environment do not have the same observations.

    :raises ValueError: SB3's message and the cure
    """
    try:
        yield
    except ValueError as error:
        sizes = re.findall(r"'observation': Box\([^()]*\((\d+),\)", str(error))
        if "Observation spaces do not match" not in str(error) or len(sizes) != 2:
            raise
        expected, given = map(int, sizes)
        raise ValueError(
            f"this agent was trained on observations of {expected} entries, the environment gives {given}."
            f"{layout_cure(expected, given)}"
        ) from error
