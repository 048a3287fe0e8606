"""Makes any goal environment usable: derives a subgoal space from ``achieved_goal``, adds what our own tasks have."""

from __future__ import annotations

from functools import partial
from numbers import Integral
from typing import Any, NamedTuple, SupportsFloat, cast

import gymnasium as gym
import numpy as np
from gymnasium import spaces
from numpy.typing import ArrayLike, NDArray

from sb3_tbc.aliases import Env, Plain, Wrapper
from sb3_tbc.arrays import FloatArray
from sb3_tbc.smdp.goal_spaces import said_success
from sb3_tbc.smdp.spaces import GoalObservation, SubgoalSpace

from .goal_env_check import check_goal_env, goal_env_problems, name_of
from .probe import Floats, Probe, run_probe
from .success_test import SuccessTest, compute_reward_of, success_test_of
from .time_limit import time_limit
from .tolerances import Tolerances, quaternions, tolerances_of

__all__ = [
    "DescribedGoalEnv",
    "GoalEnvDescription",
    "check_goal_env",
    "describe_goal_env",
    "goal_env_problems",
    "subgoal_space_of",
]


class GoalEnvDescription(NamedTuple):
    """What a hierarchical agent needs to know about a task; our own tasks have these as attributes."""

    subgoals: SubgoalSpace
    achieved_in_observation: bool
    observation_scale: NDArray[np.float64]
    goal_scale: NDArray[np.float64]
    max_episode_steps: int
    success_test: SuccessTest


def describe_goal_env(
    env: Env,
    low: ArrayLike | None = None,
    high: ArrayLike | None = None,
    thresholds: ArrayLike | None = None,
    names: list[str] | None = None,
    n_probe_steps: int = 2000,
    seed: int = 0,
) -> GoalEnvDescription:
    """Subgoal space, scales and episode length of any goal environment.

    Subgoals are points of ``achieved_goal``. What is not given is measured in random episodes. Bounds: where desired
    goals and nine tenths of the achieved ones lie, widened by a tenth, within the declared Box. Thresholds: the largest
    distance from a goal at which the task's reward (or success test, if the reward is dense) counts it as reached.
    Scales: the largest observations. Four neighbouring coordinates that are unit quaternions are compared by angle.

    :param env: a goal environment; random episodes are run in it, so reset it afterwards
    :param low: lower bounds of subgoals, ``(goal_dim,)``
    :param high: upper bounds
    :param thresholds: one per coordinate, or one for the Euclidean distance
    :param names: of the coordinates
    :param n_probe_steps: length of the random episodes together
    :param seed: of the random episodes
    :raises ValueError: if the environment is not a goal environment, does not tell when a goal is reached, or what is
        given does not fit
    """
    if not isinstance(n_probe_steps, Integral) or n_probe_steps < 1:
        raise ValueError(f"n_probe_steps must be a whole number of at least 1, got {n_probe_steps!r}")
    given_bounds = _numbers("low", low), _numbers("high", high)
    thresholds = _numbers("thresholds", thresholds)
    check_goal_env(env)
    probe = run_probe(env, n_probe_steps, seed)
    low, high = _bounds(env, _extent(probe), *given_bounds)
    within = _contains(probe.seen["observation"], probe.seen["achieved_goal"])
    local = _whole if within else _with_achieved
    space = partial(
        SubgoalSpace,
        low=low,
        high=high,
        achieved=_achieved_goal,
        local=local,
        local_scale=_magnitude(local(probe.seen)),
        names=names or [f"goal_{i}" for i in range(len(low))],
    )
    given = None if thresholds is None else space(**_given_thresholds(thresholds, len(low))._asdict())
    try:
        success_test = success_test_of(env, probe, given)
    except ValueError as error:
        raise ValueError(f"{name_of(env)} cannot be used as a goal environment: {error}") from error
    goals = np.concatenate([probe.seen["achieved_goal"], probe.seen["desired_goal"]])
    if given is None:
        test = success_test.function_for(env)
        found = tolerances_of(test, probe.seen["desired_goal"], high - low, quaternions(goals))
        given = space(**found._asdict())
    steps = time_limit(env)
    assert steps is not None  # checked by check_goal_env
    scales = _magnitude(probe.seen["observation"]), _magnitude(goals)
    return GoalEnvDescription(given, within, *scales, steps, success_test)


def subgoal_space_of(env: Env, **given: Any) -> SubgoalSpace:
    """The subgoal space that an environment brings, or one derived by :func:`describe_goal_env`.

    :param env: a goal environment
    :param given: ``low``, ``high``, ``thresholds``, ... of :func:`describe_goal_env`, instead of the environment's own
    """
    own = env.get_wrapper_attr("subgoals") if env.has_wrapper_attr("subgoals") else None
    return own if isinstance(own, SubgoalSpace) and not given else describe_goal_env(env, **given).subgoals


class DescribedGoalEnv(Wrapper):
    """Gives any goal environment what our own tasks have: attributes, ``info["is_success"]``, rewards up to 0.

    Rewards are shifted so that the reward at the goal becomes 0: the mazes of Gymnasium-Robotics pay 1 and 0, its
    robots 0 and -1. In hindsight a goal is reached where the task pays its highest reward or, if the reward is dense,
    where the task's success test says so. Success of a step is what ``info`` says under ``is_success`` or ``success``,
    else the same test. Where ``env`` is a ``Monitor``, as in ``make_vec_env(id, wrapper_class=DescribedGoalEnv)``, the
    Monitor sees episodes end with success, too, and keeps the task's own rewards.

    :param env: a goal environment
    :param terminate_on_success: end episodes with success, as our own tasks do
    :param description: of an equal environment, from :func:`describe_goal_env`; None to describe this one
    :param given: passed to :func:`describe_goal_env`
    :raises ValueError: as :func:`describe_goal_env`
    """

    def __init__(
        self,
        env: Env,
        terminate_on_success: bool = True,
        description: GoalEnvDescription | None = None,
        **given: Any,
    ) -> None:
        super().__init__(env)
        monitor = _monitor_in(env) if terminate_on_success else None
        task = env if monitor is None else monitor.env  # its random episodes are none of the Monitor's
        self.description = description or describe_goal_env(task, **given)
        if monitor is not None:
            monitor.env = _EndsWithSuccess(task, self.description.success_test)
        self.subgoals = self.description.subgoals
        self.achieved_in_observation = self.description.achieved_in_observation
        self.observation_scale = self.description.observation_scale
        self.goal_scale = self.description.goal_scale
        self.max_episode_steps = self.description.max_episode_steps
        self._terminate_on_success = terminate_on_success
        self._best, worst = self.description.success_test.best, self.description.success_test.worst
        self.reward_range = None if worst is None else (worst - self._best, 0.0)

    def compute_reward(self, achieved_goal: ArrayLike, desired_goal: ArrayLike, info: object = None) -> Any:
        """The environment's own reward, shifted to 0 at the goal; single or batched."""
        goals = np.asarray(achieved_goal, dtype=np.float64), np.asarray(desired_goal, dtype=np.float64)
        reward = compute_reward_of(self.env)(*goals) - self._best
        return reward if reward.ndim else float(reward)

    def compute_terminated(self, achieved_goal: ArrayLike, desired_goal: ArrayLike, info: object = None) -> Any:
        """Whether an episode ends with this achieved goal; single or batched."""
        success = _reached(self.description.success_test, self.env, achieved_goal, desired_goal)
        success = success & self._terminate_on_success
        return success if np.ndim(achieved_goal) > 1 else bool(success)

    def step(self, action: object) -> tuple[GoalObservation, SupportsFloat, bool, bool, Plain]:
        """Step; adds ``is_success``, shifts the reward, ends the episode with success."""
        observation, reward, terminated, truncated, info = self.env.step(action)
        success = info["is_success"] = _succeeded(self.description.success_test, self.env, observation, info)
        ended = bool(terminated or (self._terminate_on_success and success))
        return observation, float(reward) - self._best, ended, truncated, info


class _EndsWithSuccess(Wrapper):
    """Ends episodes with success beneath a Monitor. Above it, SB3 would count those alone that end otherwise."""

    def __init__(self, env: Env, success_test: SuccessTest) -> None:
        super().__init__(env)
        self.success_test = success_test

    def step(self, action: object) -> tuple[GoalObservation, SupportsFloat, bool, bool, Plain]:
        observation, reward, terminated, truncated, info = self.env.step(action)
        success = info["is_success"] = _succeeded(self.success_test, self.env, observation, info)
        return observation, reward, bool(terminated or success), truncated, info


def _reached(test: SuccessTest, env: Env, achieved: ArrayLike, desired: ArrayLike) -> NDArray[np.bool_]:
    """Whether goals are reached; single ones ``(goal_dim,)`` or a batch ``(n, goal_dim)``."""
    one, other = np.asarray(achieved, dtype=np.float64), np.asarray(desired, dtype=np.float64)
    success = test.function_for(env)(np.atleast_2d(one), np.atleast_2d(other))
    return success if one.ndim > 1 else success[0]


def _succeeded(test: SuccessTest, env: Env, observation: GoalObservation, info: Plain) -> bool:
    """Success of a step: what ``info`` says, else a test."""
    said = said_success(info)
    if said is not None:
        return said
    return bool(_reached(test, env, observation["achieved_goal"], observation["desired_goal"]))


def _monitor_in(env: Env) -> Wrapper | None:
    """The innermost Monitor; None without one.

    :raises ValueError: if another wrapper is around it, which may see other goals than the Monitor does
    """
    layers = [env]
    while isinstance(layers[-1], gym.Wrapper):
        layers.append(layers[-1].env)
    places = [place for place, layer in enumerate(layers) if _is_monitor(layer)]
    between = [type(layer).__name__ for layer in layers[: max(places, default=0)] if not _is_monitor(layer)]
    if between:
        raise ValueError(
            f"the Monitor beneath {', '.join(between)} does not see the episodes that DescribedGoalEnv ends with "
            "success: put the Monitor around all wrappers, or DescribedGoalEnv directly around the Monitor"
        )
    return cast(Wrapper, layers[places[-1]]) if places else None


def _is_monitor(env: Env) -> bool:
    """Whether it is SB3's Monitor or derived from it, found by name, as tasks need no SB3."""
    return any(kind.__module__ == "stable_baselines3.common.monitor" for kind in type(env).__mro__)


# -- what describe_goal_env is made of ---------------------------------------------------------------------------------


def _extent(probe: Probe) -> tuple[Floats, Floats]:
    """Least and largest desired goal or, farther out, 5 % and 95 % quantile of the achieved goals."""
    achieved, desired = probe.seen["achieved_goal"], probe.seen["desired_goal"]
    low, high = np.quantile(achieved, (0.05, 0.95), axis=0)
    return np.minimum(low, desired.min(axis=0)), np.maximum(high, desired.max(axis=0))


def _numbers(name: str, given: ArrayLike | None) -> Floats | None:
    """What was given, as an array of its own; None where nothing was.

    :raises ValueError: if it is not made of numbers
    """
    try:
        return None if given is None else np.array(given, dtype=np.float64)
    except (TypeError, ValueError) as error:
        raise ValueError(f"{name} must be a number or a list of numbers, got {given!r}") from error


def _bounds(env: Env, extent: tuple[Floats, Floats], low: Floats | None, high: Floats | None) -> tuple[Floats, Floats]:
    """Given bounds; else the extent that was seen and a margin, within the declared Box."""
    assert isinstance(env.observation_space, spaces.Dict)
    box = env.observation_space["achieved_goal"]
    assert isinstance(box, spaces.Box)
    least, most = extent
    span = most - least
    margin = np.maximum(0.1 * span, 1e-3 * (span.max() or 1.0))  # of a coordinate that never changes, in any unit
    bounds = (
        np.maximum(least - margin, box.low) if low is None else low,
        np.minimum(most + margin, box.high) if high is None else high,
    )
    for name, bound in zip(("low", "high"), bounds, strict=True):
        if bound.shape != box.shape:
            raise ValueError(f"{name} must have the shape of achieved_goal {box.shape}, got {bound.shape}")
    return bounds


def _given_thresholds(given: Floats, dim: int) -> Tolerances:
    """Given thresholds: one for each coordinate, or one for the Euclidean distance."""
    limits: list[float] = np.atleast_1d(given).tolist()
    single = [[i] for i in range(dim)]
    return Tolerances(limits, [list(range(dim))] if len(limits) == 1 and dim > 1 else single, [])


def _contains(observation: Floats, achieved: Floats) -> bool:
    """Whether each coordinate of the achieved goal always equals some entry of the observation."""
    return all(np.isclose(observation, column[:, None], atol=1e-6).all(axis=0).any() for column in achieved.T)


def _magnitude(values: FloatArray) -> Floats:
    """A typical largest magnitude per column; 1 where nothing moved."""
    magnitude = np.quantile(np.abs(values), 0.98, axis=0)
    return np.where(magnitude > 1e-6, magnitude, 1.0)


def _achieved_goal(observation: GoalObservation) -> FloatArray:
    return observation["achieved_goal"]


def _whole(observation: GoalObservation) -> FloatArray:
    return observation["observation"]


def _with_achieved(observation: GoalObservation) -> FloatArray:
    return np.concatenate([observation["achieved_goal"], observation["observation"]], axis=-1)
