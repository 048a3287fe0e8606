"""Any goal environment: what it lacks, and a subgoal space derived from its ``achieved_goal``."""

from __future__ import annotations

from typing import Any, NamedTuple

import gymnasium as gym
import numpy as np
from gymnasium import spaces
from numpy.typing import ArrayLike, NDArray

from sb3_tbc.smdp.spaces import FloatArray, GoalObservation, SubgoalSpace

from .time_limit import time_limit

GOAL_KEYS = ("observation", "achieved_goal", "desired_goal")


class GoalEnvDescription(NamedTuple):
    """What a hierarchical agent has to know of a task; our own tasks carry these as attributes."""

    subgoals: SubgoalSpace
    achieved_in_observation: bool
    observation_scale: NDArray[np.float64]
    goal_scale: NDArray[np.float64]
    max_episode_steps: int


def goal_env_problems(env: gym.Env[Any, Any], n_steps: int = 5) -> list[str]:
    """What keeps a hierarchical agent from acting in an environment, each with a cure; empty if nothing.

    :param env: any environment; it is reset and stepped ``n_steps`` times, so give a fresh one
    """
    problems = _space_problems(env)
    if not hasattr(env.unwrapped, "compute_reward"):
        problems.append("it has no compute_reward(achieved_goal, desired_goal, info), which relabelling goals needs")
    if time_limit(env) is None:
        problems.append("its episodes have no time limit; pass gymnasium.make(..., max_episode_steps=N)")
    return problems or _behaviour_problems(env, n_steps)


def check_goal_env(env: gym.Env[Any, Any]) -> None:
    """Explain what an environment lacks for hierarchical, goal-conditioned learning.

    :param env: any environment; it is reset and stepped a few times
    :raises ValueError: listing every problem with its cure
    """
    problems = goal_env_problems(env)
    if problems:
        name = env.spec.id if env.spec is not None else type(env.unwrapped).__name__
        raise ValueError(f"{name} cannot be used as a goal environment:\n" + "\n".join(f"  - {p}" for p in problems))


def _space_problems(env: gym.Env[Any, Any]) -> list[str]:
    problems, space, actions = [], env.observation_space, env.action_space
    if not isinstance(actions, spaces.Box) or len(actions.shape) != 1:
        problems.append(f"its actions must be a Box with one dimension, got {actions}")
    elif not np.all(np.isfinite(actions.low) & np.isfinite(actions.high)):
        problems.append(f"its action bounds must be finite, got {actions}; use gymnasium's RescaleAction or ClipAction")
    if not isinstance(space, spaces.Dict) or any(key not in space.spaces for key in GOAL_KEYS):
        found = sorted(space.spaces) if isinstance(space, spaces.Dict) else type(space).__name__
        return [*problems, f"its observation must be a Dict with the keys {list(GOAL_KEYS)}, got {found}"]
    for key in GOAL_KEYS:
        part = space.spaces[key]
        if not isinstance(part, spaces.Box) or len(part.shape) != 1:
            problems.append(f"observation[{key!r}] must be a Box with one dimension, got {part}; flatten it")
    if space["achieved_goal"].shape != space["desired_goal"].shape:
        problems.append(
            f"achieved_goal {space['achieved_goal'].shape} and desired_goal {space['desired_goal'].shape} "
            "must have one shape"
        )
    return problems


def _behaviour_problems(env: gym.Env[Any, Any], n_steps: int) -> list[str]:
    """Whether rewards can be recomputed, singly and in batches, from what steps return."""
    problems, seen, rewards, infos = [], [], [], []
    env.reset(seed=0)
    env.action_space.seed(0)
    for _ in range(n_steps):
        observation, reward, terminated, truncated, info = env.step(env.action_space.sample())
        seen.append(observation)
        rewards.append(float(reward))
        infos.append(info)
        if terminated or truncated:
            env.reset()
    achieved, desired = (np.stack([observation[key] for observation in seen]) for key in GOAL_KEYS[1:])
    compute: Any = env.unwrapped.compute_reward  # type: ignore[attr-defined]
    single = [float(compute(a, d, info)) for a, d, info in zip(achieved, desired, infos, strict=True)]
    if not np.allclose(single, rewards):
        problems.append(f"compute_reward gives {single}, but its steps gave {rewards}; the two must agree")
    try:
        batch = np.asarray(compute(achieved, desired, infos))
    except Exception as error:  # A user's function may fail in any way.
        return [*problems, f"compute_reward fails on a batch ({type(error).__name__}: {error}); vectorise it"]
    if batch.shape != (n_steps,) or not np.allclose(batch, single):
        problems.append(f"compute_reward on a batch of {n_steps} gives {batch!r}, one by one {single}; vectorise it")
    return problems


def describe_goal_env(
    env: gym.Env[Any, Any],
    low: ArrayLike | None = None,
    high: ArrayLike | None = None,
    thresholds: ArrayLike | None = None,
    names: list[str] | None = None,
    n_probe_steps: int = 2000,
    seed: int = 0,
) -> GoalEnvDescription:
    """Subgoal space, scales and episode length of any goal environment.

    Subgoals are points of ``achieved_goal``. What is not given comes from the environment: bounds from a finite
    ``achieved_goal`` Box, else from where desired goals and nine tenths of the achieved ones lie in random episodes,
    widened by a tenth; thresholds from ``distance_threshold`` (Euclidean), else from how far off its rewards still
    count as the goal, else 5 % of each range; scales from the random episodes.

    :param env: a goal environment; random episodes are run in a copy made from its spec, or in it if it has none
    :param low: lower bounds of subgoals, ``(goal_dim,)``
    :param high: upper bounds
    :param thresholds: one per coordinate, or one for the Euclidean distance
    :param names: of the coordinates
    :param n_probe_steps: length of the random episodes together
    :param seed: of the random episodes
    :raises ValueError: if the environment is no goal environment or bounds do not fit
    """
    check_goal_env(_fresh(env))
    probe = _probe(_fresh(env), n_probe_steps, seed)
    goals = np.concatenate([probe["achieved_goal"], probe["desired_goal"]])
    low, high = _bounds(env, _extent(probe), low, high)
    within = _contains(probe["observation"], probe["achieved_goal"])
    local = _whole if within else _with_achieved
    dim = len(low)
    limits, groups = _thresholds(env, thresholds, low, high)
    subgoals = SubgoalSpace(
        low=low,
        high=high,
        thresholds=limits,
        achieved=_achieved_goal,
        local=local,
        local_scale=_magnitude(local(probe)),
        names=names or [f"goal_{i}" for i in range(dim)],
        groups=groups,
    )
    steps = time_limit(env)
    assert steps is not None  # checked by check_goal_env
    return GoalEnvDescription(subgoals, within, _magnitude(probe["observation"]), _magnitude(goals), steps)


def subgoal_space_of(env: gym.Env[Any, Any], **given: Any) -> SubgoalSpace:
    """The subgoal space that an environment brings, or one derived by :func:`describe_goal_env`.

    :param env: a goal environment
    :param given: ``low``, ``high``, ``thresholds``, ... of :func:`describe_goal_env`, instead of the environment's own
    """
    own = getattr(env.unwrapped, "subgoals", None)
    return own if isinstance(own, SubgoalSpace) and not given else describe_goal_env(env, **given).subgoals


class DescribedGoalEnv(gym.Wrapper[Any, Any, Any, Any]):
    """Gives any goal environment what our own tasks have: attributes, ``info["is_success"]``, rewards 0 and -1.

    Rewards are shifted so that the reward where achieved and desired goal coincide becomes 0: the mazes of
    Gymnasium-Robotics pay 1 and 0, its robots 0 and -1. Success is what ``info`` says under ``is_success`` or
    ``success``, else that highest reward.

    :param env: a goal environment with a sparse reward
    :param terminate_on_success: end episodes with success, as our own tasks do
    :param given: passed to :func:`describe_goal_env`
    """

    def __init__(self, env: gym.Env[Any, Any], terminate_on_success: bool = True, **given: Any) -> None:
        super().__init__(env)
        description = _described(env, given)
        self.subgoals = description.subgoals
        self.achieved_in_observation = description.achieved_in_observation
        self.observation_scale = description.observation_scale
        self.goal_scale = description.goal_scale
        self.max_episode_steps = description.max_episode_steps
        self._terminate_on_success = terminate_on_success
        self._compute: Any = env.unwrapped.compute_reward  # type: ignore[attr-defined]
        goal = 0.5 * (self.subgoals.low + self.subgoals.high)
        self._best = float(self._compute(goal, goal.copy(), {}))

    def compute_reward(self, achieved_goal: ArrayLike, desired_goal: ArrayLike, info: Any = None) -> Any:
        """The environment's own reward, shifted to 0 at the goal; single or batched."""
        reward = np.asarray(self._compute(np.asarray(achieved_goal), np.asarray(desired_goal), {})) - self._best
        return reward if reward.ndim else float(reward)

    def compute_terminated(self, achieved_goal: ArrayLike, desired_goal: ArrayLike, info: Any = None) -> Any:
        """Whether an episode ends with this achieved goal; single or batched."""
        return (self.compute_reward(achieved_goal, desired_goal) >= -1e-9) & self._terminate_on_success

    def step(self, action: Any) -> tuple[Any, Any, bool, bool, dict[str, Any]]:
        """Step; adds ``is_success``, shifts the reward, ends the episode with success."""
        observation, reward, terminated, truncated, info = self.env.step(action)
        reward = float(reward) - self._best
        info["is_success"] = success = bool(info.get("is_success", info.get("success", reward >= -1e-9)))
        return observation, reward, bool(terminated or (self._terminate_on_success and success)), truncated, info


_DESCRIPTIONS: dict[str, GoalEnvDescription] = {}
"""Descriptions found so far; environments of one vector need the random episodes only once."""


def _described(env: gym.Env[Any, Any], given: dict[str, Any]) -> GoalEnvDescription:
    if env.spec is None:
        return describe_goal_env(env, **given)
    key = repr((env.spec.id, env.spec.kwargs, env.spec.max_episode_steps, given))
    if key not in _DESCRIPTIONS:
        _DESCRIPTIONS[key] = describe_goal_env(env, **given)
    return _DESCRIPTIONS[key]


# -- what describe_goal_env is made of ---------------------------------------------------------------------------------


def _fresh(env: gym.Env[Any, Any]) -> gym.Env[Any, Any]:
    return env if env.spec is None else gym.make(env.spec)


def _probe(env: gym.Env[Any, Any], n_steps: int, seed: int) -> dict[str, NDArray[np.float64]]:
    """Goal observations along random actions held for a while, in episodes of at most 50 steps."""
    rng = np.random.default_rng(seed)
    actions = env.action_space
    assert isinstance(actions, spaces.Box)
    seen = [env.reset(seed=seed)[0]]
    action, ended = actions.low, False
    for step in range(n_steps):
        if ended or step % 50 == 49:
            seen.append(env.reset()[0])
        if step % 5 == 0:
            action = rng.uniform(actions.low, actions.high).astype(actions.dtype)
        observation, _, terminated, truncated, _ = env.step(action)
        seen.append(observation)
        ended = terminated or truncated
    return {key: np.stack([observation[key] for observation in seen]).astype(np.float64) for key in GOAL_KEYS}


def _extent(probe: dict[str, NDArray[np.float64]]) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Least and largest desired goal or, farther out, 5 % and 95 % quantile of the achieved goals."""
    achieved, desired = probe["achieved_goal"], probe["desired_goal"]
    low, high = np.quantile(achieved, (0.05, 0.95), axis=0)
    return np.minimum(low, desired.min(axis=0)), np.maximum(high, desired.max(axis=0))


def _bounds(
    env: gym.Env[Any, Any],
    extent: tuple[NDArray[np.float64], NDArray[np.float64]],
    low: ArrayLike | None,
    high: ArrayLike | None,
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    assert isinstance(env.observation_space, spaces.Dict)
    box = env.observation_space["achieved_goal"]
    assert isinstance(box, spaces.Box)
    least, most = extent
    margin = np.maximum(0.1 * (most - least), 1e-3)
    declared_low = np.where(np.isfinite(box.low), box.low, least - margin)
    declared_high = np.where(np.isfinite(box.high), box.high, most + margin)
    bounds = (
        declared_low if low is None else np.array(low, float),
        declared_high if high is None else np.array(high, float),
    )
    for name, bound in zip(("low", "high"), bounds, strict=True):
        if bound.shape != box.shape:
            raise ValueError(f"{name} must have the shape of achieved_goal {box.shape}, got {bound.shape}")
    return bounds


def _thresholds(
    env: gym.Env[Any, Any], given: ArrayLike | None, low: NDArray[np.float64], high: NDArray[np.float64]
) -> tuple[NDArray[np.float64], list[list[int]] | None]:
    """Thresholds and the groups whose distance they limit (``None``: each coordinate by itself)."""
    together = [list(range(len(low)))]
    if given is not None:
        limits = np.atleast_1d(np.asarray(given, dtype=np.float64))
        return limits, together if len(limits) == 1 and len(low) > 1 else None
    distance = getattr(env.unwrapped, "distance_threshold", None)
    if distance is not None:
        return np.array([float(distance)]), together
    tolerances = _tolerances(env, low, high)
    if tolerances is None:
        return 0.05 * (high - low), None
    if len(low) > 1 and np.allclose(tolerances, tolerances[0], rtol=1e-3) and not _counts(env, low, high, tolerances):
        return tolerances[:1], together
    return tolerances, None


def _counts(
    env: gym.Env[Any, Any], low: NDArray[np.float64], high: NDArray[np.float64], offset: NDArray[np.float64]
) -> bool:
    """Whether a point nine tenths of ``offset`` away from a goal in the middle has the goal's own reward."""
    compute: Any = env.unwrapped.compute_reward  # type: ignore[attr-defined]
    goal = 0.5 * (low + high)
    return bool(np.isclose(compute(goal + 0.9 * offset, goal, {}), compute(goal, goal.copy(), {})))


def _tolerances(
    env: gym.Env[Any, Any], low: NDArray[np.float64], high: NDArray[np.float64]
) -> NDArray[np.float64] | None:
    """Per coordinate, how far off the goal its reward still holds, by bisection; ``None`` if rewards do not tell."""
    compute: Any = env.unwrapped.compute_reward  # type: ignore[attr-defined]
    goal, tolerances = 0.5 * (low + high), np.empty(len(low))
    best = float(compute(goal, goal.copy(), {}))
    for i, half in enumerate(0.5 * (high - low)):
        inside, outside = 0.0, float(half)
        for _ in range(40):
            middle = 0.5 * (inside + outside)
            point = goal.copy()
            point[i] += middle
            inside, outside = (middle, outside) if float(compute(point, goal, {})) == best else (inside, middle)
        if not 1e-3 * half < inside < 0.999 * half:  # a dense reward falls at once, a coordinate without say never
            return None
        tolerances[i] = float(f"{inside:.6g}")
    return tolerances


def _contains(observation: NDArray[np.float64], achieved: NDArray[np.float64]) -> bool:
    """Whether each coordinate of the achieved goal is some entry of the observation throughout."""
    return all(np.isclose(observation, column[:, None], atol=1e-6).all(axis=0).any() for column in achieved.T)


def _magnitude(values: FloatArray) -> NDArray[np.float64]:
    """A typical largest magnitude per column; 1 where nothing moved."""
    magnitude = np.quantile(np.abs(values), 0.98, axis=0)
    return np.where(magnitude > 1e-6, magnitude, 1.0)


def _achieved_goal(observation: GoalObservation) -> FloatArray:
    return observation["achieved_goal"]


def _whole(observation: GoalObservation) -> FloatArray:
    return observation["observation"]


def _with_achieved(observation: GoalObservation) -> FloatArray:
    return np.concatenate([observation["achieved_goal"], observation["observation"]], axis=-1)
