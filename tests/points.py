"""A point in the plane as a goal environment, described in several ways."""

import gymnasium as gym
import numpy as np
from gymnasium import spaces


class Point(gym.Env):
    """A point in the plane; the observation holds position and velocity."""

    extra = {}  # noqa: RUF012 (what info holds)

    def __init__(self, bound=np.inf, hidden=False, threshold=None):
        self.action_space = spaces.Box(-1.0, 1.0, (2,), np.float32)
        goal = spaces.Box(-bound, bound, (2,), np.float64)
        size = 2 if hidden else 4
        self.observation_space = spaces.Dict(
            observation=spaces.Box(-np.inf, np.inf, (size,), np.float64), achieved_goal=goal, desired_goal=goal
        )
        self.hidden = hidden
        self.max_episode_steps = 30
        if threshold is not None:
            self.distance_threshold = threshold

    def _see(self):
        state = self.velocity if self.hidden else np.concatenate([self.velocity, self.position])
        return {
            "observation": state.copy(),
            "achieved_goal": self.position.copy(),
            "desired_goal": self.goal.copy(),
        }

    def reset(self, *, seed=None, options=None):
        super().reset(seed=seed)
        self.position, self.velocity = self.np_random.uniform(-0.1, 0.1, 2), np.zeros(2)
        self.goal = self.np_random.uniform(-2.0, 2.0, 2)
        self.steps = 0
        return self._see(), {}

    def step(self, action):
        self.velocity = 0.5 * self.velocity + 0.1 * np.asarray(action, float)
        self.position = self.position + self.velocity
        self.steps += 1
        observation = self._see()
        reward = self.compute_reward(observation["achieved_goal"], observation["desired_goal"], self.extra)
        return observation, float(reward), False, self.steps >= 30, dict(self.extra)

    def compute_reward(self, achieved_goal, desired_goal, info):
        return np.where(np.linalg.norm(achieved_goal - desired_goal, axis=-1) < 0.3, 0.0, -1.0)


class Boxed(Point):
    """Coordinates count one by one, the second not at all if ``slack`` is infinite."""

    slack = 0.5

    def compute_reward(self, achieved_goal, desired_goal, info):
        return np.where((np.abs(achieved_goal - desired_goal) < [0.3, self.slack]).all(axis=-1), 0.0, -1.0)


class Dense(Point):
    def compute_reward(self, achieved_goal, desired_goal, info):
        return -np.linalg.norm(achieved_goal - desired_goal, axis=-1)
