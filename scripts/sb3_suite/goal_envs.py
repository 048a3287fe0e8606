"""Environments of Stable-Baselines3's tests as goal environments, and their observations as its tests read them."""

from __future__ import annotations

from typing import Any

import gymnasium as gym
import numpy as np
from gymnasium import spaces
from gymnasium.envs.registration import EnvSpec

from sb3_tbc import SubgoalSpace


class AsGoalEnv(gym.Wrapper):  # type: ignore[type-arg]
    """Any environment of the suite as a goal environment; its rewards and episodes stay as they are.

    :param env: an environment, a goal environment of other spaces than boxes included
    """

    keeps_keys = False
    """Whether the parts of observations that are dictionaries are shown beside the goals."""

    def __init__(self, env: gym.Env[Any, Any]) -> None:
        super().__init__(env)
        self.is_goal = isinstance(env.observation_space, spaces.Dict) and "desired_goal" in env.observation_space.spaces
        raw = env.observation_space
        flat = spaces.flatten_space(raw["observation"] if self.is_goal else raw)
        observed = spaces.Box(-np.inf, np.inf, flat.shape, np.float32)
        width = int(np.prod(raw["achieved_goal"].shape)) if self.is_goal else min(2, flat.shape[0])
        goal = spaces.Box(-np.inf, np.inf, (width,), np.float32)
        self.kept = dict(raw.spaces) if self.keeps_keys and isinstance(raw, spaces.Dict) else {}
        goals = {"observation": observed, "achieved_goal": goal, "desired_goal": goal}
        self.observation_space = spaces.Dict({**self.kept, **goals})
        self.discrete = isinstance(env.action_space, spaces.Discrete)
        if self.discrete:
            self.action_space = spaces.Box(-1.0, 1.0, (1,), np.float32)
        bounds = spaces.flatten_space(raw["achieved_goal"]) if self.is_goal else flat
        bounded = np.isfinite(bounds.low[:width]) & np.isfinite(bounds.high[:width])
        low = np.where(bounded, bounds.low[:width] - 0.1, -2.0)
        high = np.where(bounded, bounds.high[:width] + 0.1, 2.0)
        self.subgoals = SubgoalSpace.from_slices(
            low, high, np.full(width, 0.2), local_scale=np.ones(flat.shape[0]), names=[f"x{i}" for i in range(width)]
        )
        self.reward_range = (-20.0, 1.0)

    def __getattr__(self, name: str) -> Any:
        if name == "env":
            raise AttributeError(name)
        return getattr(self.env, name)

    def reset(self, **kwargs: Any) -> Any:
        """Begin an episode."""
        observation, info = self.env.reset(**{name: value for name, value in kwargs.items() if value is not None})
        return self._seen(observation), info

    def step(self, action: Any) -> Any:
        """One step."""
        if self.discrete:
            action = int((float(action[0]) + 1.0) / 2.0 * (self.env.action_space.n - 1) + 0.5)  # type: ignore[attr-defined]
        observation, reward, terminated, truncated, info = self.env.step(action)
        return self._seen(observation), reward, terminated, truncated, info

    def _seen(self, observation: Any) -> dict[str, Any]:
        raw, width = self.env.observation_space, self.observation_space["achieved_goal"].shape[0]  # type: ignore[index]
        if self.is_goal:
            return {key: np.asarray(part, dtype=np.float32).ravel() for key, part in observation.items()}
        flat = np.asarray(spaces.flatten(raw, observation), dtype=np.float32)
        goals = {"achieved_goal": flat[:width].copy(), "desired_goal": np.zeros(width, np.float32)}
        return {**{key: observation[key] for key in self.kept}, "observation": flat, **goals}

    def compute_reward(self, achieved_goal: Any, desired_goal: Any, info: Any) -> Any:
        """0 at the goal, -1 elsewhere."""
        return np.where(np.abs(np.asarray(achieved_goal) - desired_goal).max(axis=-1) < 0.2, 0.0, -1.0)


def goal_spec(env_id: str) -> EnvSpec:
    """What an id of Gymnasium is to mean, so that it gives a goal environment."""
    spec, raw_id = gym.spec(env_id), f"raw/{env_id}"
    if raw_id not in gym.registry:
        gym.register(raw_id, entry_point=spec.entry_point, kwargs=spec.kwargs)
    return EnvSpec(
        env_id,
        entry_point=lambda **kwargs: AsGoalEnv(gym.make(raw_id, **kwargs)),
        max_episode_steps=spec.max_episode_steps,
    )


class Limited(gym.wrappers.TimeLimit):  # type: ignore[type-arg]
    """A time limit that shows the attributes of what is in it."""

    def __getattr__(self, name: str) -> Any:
        if name == "env":
            raise AttributeError(name)
        return getattr(self.env, name)


def as_goal_env(env: Any) -> Any:
    """A goal environment with a time limit; what SB3 refuses by itself stays as it is."""
    space = env.observation_space
    if isinstance(space, spaces.Dict) and any(isinstance(part, spaces.Dict) for part in space.spaces.values()):
        return env
    goal = AsGoalEnv(env)
    return goal if env.spec and env.spec.max_episode_steps else Limited(goal, 100)


class Batch(dict):  # type: ignore[type-arg]
    """Observations of several environments, with the shape and the rows that tests ask an array for."""

    def __getitem__(self, key: Any) -> Any:
        return {name: part[key] for name, part in self.items()} if isinstance(key, int) else super().__getitem__(key)

    @property
    def shape(self) -> tuple[int, ...]:
        """Shape of ``observation``."""
        return tuple(self["observation"].shape)


class OurNumPy:
    """NumPy, which also puts goal observations together."""

    def __getattr__(self, name: str) -> Any:
        return getattr(np, name)

    @staticmethod
    def concatenate(parts: Any, axis: int = 0) -> Any:
        """As NumPy's, for dictionaries key by key."""
        if isinstance(parts[0], dict):
            return {key: np.concatenate([part[key] for part in parts], axis=axis) for key in parts[0]}
        return np.concatenate(parts, axis=axis)

    @staticmethod
    def allclose(one: Any, other: Any, *more: Any) -> bool:
        """As NumPy's, likewise."""
        if isinstance(one, dict):
            return all(np.allclose(one[key], other[key], *more) for key in one)
        return np.allclose(one, other, *more)
