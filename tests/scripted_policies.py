"""Hand-written policies that show the tasks can be solved; they read the compact layout."""

import numpy as np


def sail_late(start=254):
    """Drawbridge: set full sails at action ``start``; 254 is best possible."""
    step = -1

    def act(observation):
        nonlocal step
        step += 1
        return np.array([1.0 if step >= start else 0.0], dtype=np.float32)

    return act


def servo(observation):
    """UR5Reacher: a velocity command proportional to the error, plus a share against gravity."""
    state = observation["observation"]
    error = observation["desired_goal"] - state[:3]
    lift, elbow = state[1], state[2]
    forearm = 2.275 * 0.25 * np.cos(lift + elbow)
    gravity = 9.81 * np.array([0.0, 8.393 * 0.28 * np.cos(lift) + 2.275 * 0.425 * np.cos(lift) + forearm, forearm])
    command = 8.0 * error - gravity / 10.0
    return np.clip(command, [-3.15, -5, -3.15], [3.15, 5, 3.15]).astype(np.float32)


class Roll:
    """Platforms: over the trigger onto platform 0, across to platform 1 when both are level, then to the goal."""

    def __init__(self, wait=54):
        self.wait, self.step, self.stage = wait, 0, 0

    def __call__(self, observation):
        y1, (x, y, vx) = observation["observation"][6], observation["observation"][9:12]
        self.stage = self._next_stage(x, y, y1)
        target = (0.75, 0.6, 0.25, observation["desired_goal"][0])[self.stage]
        if self.step < self.wait:
            target = -0.8
        self.step += 1
        speed = np.clip(4.0 * (target - x), -0.85, 0.85)
        return np.clip([3.0 * (speed - vx)], -1.0, 1.0).astype(np.float32)

    def _next_stage(self, x, y, y1):
        if self.stage == 0 and x > 0.55:
            return 1
        if self.stage == 1 and y > -0.3 and y1 + 0.05 < y - 0.045:
            return 2
        return 3 if self.stage == 2 and y > 0.42 else self.stage


def episode_length(env, policy, **reset):
    """Steps to success, or None."""
    observation, _ = env.reset(**reset)
    for step in range(env.unwrapped.max_episode_steps):
        observation, _, terminated, truncated, _ = env.step(policy(observation))
        if terminated:
            return step + 1
        if truncated:
            break
    return None
