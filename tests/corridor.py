"""A corridor whose every quantity can be worked out by hand: the test suite's smallest goal environment."""

from __future__ import annotations

from typing import Any

import numpy as np
from gymnasium import spaces
from gymnasium_robotics.core import GoalEnv

from sb3_tbc.smdp.spaces import SubgoalSpace


def achieved(observation: Any) -> Any:
    return np.asarray(observation["achieved_goal"], dtype=np.float64)


def local(observation: Any) -> Any:
    return np.asarray(observation["observation"], dtype=np.float64)


class Corridor(GoalEnv):
    """A point moves by 0.1 * action on [-1, 1]; the observation is (position, steps so far, serial number)."""

    serial = 0

    def __init__(self, max_episode_steps: int = 50, goal: float | None = None) -> None:
        self.max_episode_steps = max_episode_steps
        self.fixed_goal = goal
        box = spaces.Box(-1.0, 1.0, (1,), np.float64)
        self.observation_space = spaces.Dict(
            observation=spaces.Box(-np.inf, np.inf, (3,), np.float64), achieved_goal=box, desired_goal=box
        )
        self.action_space = spaces.Box(-1.0, 1.0, (1,), np.float32)
        self.subgoals = SubgoalSpace([-1.0], [1.0], [0.05], achieved, local, [1.0, 50.0, 100.0], ["position"])
        self.episode = 0

    def _observation(self) -> dict[str, Any]:
        return {
            "observation": np.array([self.position, self.steps, self.episode]),
            "achieved_goal": np.array([self.position]),
            "desired_goal": np.array([self.goal]),
        }

    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None) -> Any:
        super().reset(seed=seed)
        self.position, self.steps = 0.0, 0
        self.episode = 1 if seed is not None else self.episode + 1
        self.goal = self.fixed_goal if self.fixed_goal is not None else float(self.np_random.uniform(-1, 1))
        return self._observation(), {}

    def step(self, action: Any) -> Any:
        self.position = float(np.clip(self.position + 0.1 * float(action[0]), -1, 1))
        self.steps += 1
        observation = self._observation()
        goals = observation["achieved_goal"], observation["desired_goal"]
        success = bool(self.compute_terminated(*goals, {}))
        truncated = not success and self.steps >= self.max_episode_steps
        return observation, float(self.compute_reward(*goals, {})), success, truncated, {"is_success": success}

    def compute_reward(self, achieved_goal: Any, desired_goal: Any, info: Any) -> Any:
        return np.where(np.abs(achieved_goal - desired_goal)[..., 0] <= 0.05, 0.0, -1.0)

    def compute_terminated(self, achieved_goal: Any, desired_goal: Any, info: Any) -> Any:
        return np.abs(achieved_goal - desired_goal)[..., 0] <= 0.05

    def compute_truncated(self, achieved_goal: Any, desired_goal: Any, info: Any) -> Any:
        return self.steps >= self.max_episode_steps
