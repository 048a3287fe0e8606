"""What each level sees of the task: how goal observations become the levels' flat observation vectors."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from gymnasium import spaces

from sb3_tbc.arrays import FloatArray
from sb3_tbc.smdp.goal_spaces import width
from sb3_tbc.smdp.spaces import GoalObservation, SubgoalSpace


class LevelViews(NamedTuple):
    """How the flat observation and action vectors of both levels are put together."""

    subgoals: SubgoalSpace
    achieved_in_observation: bool = True
    relative_subgoals: bool = False
    remaining_time: bool = True  # whether the low level sees how much of its time budget is left
    timed_actions: bool = True  # whether the high level's action ends with a time budget

    def high(self, observation: GoalObservation) -> FloatArray:
        """What the high level sees: desired goal, observation and, where the task needs it, achieved goal."""
        parts = [observation["desired_goal"], observation["observation"]]
        if not self.achieved_in_observation:
            parts.append(observation["achieved_goal"])
        return np.concatenate(parts, axis=-1).astype(np.float32)

    def low(self, observation: GoalObservation, subgoal: FloatArray, remaining: FloatArray) -> FloatArray:
        """What the low level sees: local state, subgoal (task units), remaining time in [0, 1]."""
        here = self.subgoals.achieved(observation) if self.relative_subgoals else None
        return self.low_from(self.subgoals.local(observation), here, subgoal, np.asarray(remaining)[..., None])

    def low_from(
        self, local: FloatArray, here: FloatArray | None, subgoal: FloatArray, remaining: FloatArray
    ) -> FloatArray:
        """The same from its parts: ``here`` is the subgoal-space point of the state, ``remaining`` has a last axis."""
        asked = subgoal - here if self.relative_subgoals and here is not None else subgoal
        parts = [local, asked, remaining] if self.remaining_time else [local, asked]
        return np.concatenate(parts, axis=-1, dtype=np.float32)

    def high_space(self, space: spaces.Dict) -> spaces.Box:
        """Observation space of the high level."""
        keys = ["desired_goal", "observation"] + ([] if self.achieved_in_observation else ["achieved_goal"])
        size = sum(width(space, key) for key in keys)
        return spaces.Box(-np.inf, np.inf, (size,), np.float32)

    def low_space(self) -> spaces.Box:
        """Observation space of the low level."""
        size = self.subgoals.local_dim + self.subgoals.dim + int(self.remaining_time)
        return spaces.Box(-np.inf, np.inf, (size,), np.float32)

    def high_action_space(self) -> spaces.Box:
        """Action space of the high level in unit coordinates: subgoal, then time budget where it chooses one."""
        return spaces.Box(-1.0, 1.0, (self.subgoals.dim + int(self.timed_actions),), np.float32)

    def low_scale(self) -> FloatArray:
        """Fixed scales that bring the low level's observation to about [-1, 1]."""
        time = [1.0] if self.remaining_time else []
        return np.concatenate([self.subgoals.local_scale, self.subgoals.resolution_scale, time])
