"""Drawbridge: set the sails so that the ship reaches an opening bridge on time and at full speed."""

from __future__ import annotations

from collections.abc import Sequence
from typing import ClassVar

import numpy as np
from numpy.typing import NDArray

from sb3_tbc.aliases import Plain
from sb3_tbc.arrays import FloatArray
from sb3_tbc.smdp.spaces import GoalObservation, SubgoalSpace

from .base import Array, GoalTask
from .drawing import draw_drawbridge
from .history import FrameHistory

LENGTH = 10.0
MAX_SPEED = 0.03
BRIDGE = 4.3
MAX_STEPS = 1000
"""Time limit; the observed phase counts in it, also where another limit was set."""
N_FRAMES = 17
FRAME_DIM = 5


class Drawbridge(GoalTask):
    """A ship without brakes sails towards a bridge that opens late (dynamic RL benchmarks, Guertler et al. 2021).

    State: ship position p in [0, 10], velocity v, sails s in [0, 1], step k; nothing is random. One step with action a:
    ``s += 0.03 a`` (clipped), ``p += v`` (clipped), ``v += 0.0001 s`` (clipped to +-0.03), and while the bridge is less
    than 25 degrees open a ship beyond 4.3 bounces: ``v *= -0.1``. The bridge opens by 0.4 degrees a step from k = 500
    to 90 degrees.

    * ``observation``, compact (4): bridge phase, sails, position, velocity, each in [-1, 1]. Paper (85): 17 frames
      (oldest first) of position, velocity, sails, bridge phase, bridge opening.
    * Goal (1): normalised position; desired 0.8 (p = 9), success within 0.1, i.e. p >= 8.5; 1000 steps. Full sails from
      the start arrive after 854 steps, at best (first action at step 254) 704.
    * Subgoals (3): position, velocity, sails; thresholds 0.05, 0.2, 0.1 in normalised units.

    Quirks, all kept because the published results rest on them: the goal radius of 1.0 is halved by the normalisation;
    the maximal velocity is 0.03 (an earlier 0.1 is overwritten); the bridge test and the observed bridge phase use the
    step counter before its increment, so that the first step shows the same phase as the reset. ``legacy_quirks`` has
    no effect.
    """

    metadata: ClassVar[Plain] = {"render_modes": ["rgb_array", "human"], "render_fps": 60}
    dynamics_names = ("actuator", "bridge")
    goal_is_fixed = True
    max_episode_steps = MAX_STEPS
    goal_low = (-1.0,)
    goal_high = (1.0,)
    goal_tolerance = (0.1,)

    def __init__(
        self, *, observation: str = "paper", legacy_quirks: bool = False, render_mode: str | None = None
    ) -> None:
        super().__init__(observation=observation, legacy_quirks=legacy_quirks, render_mode=render_mode)
        self._history = FrameHistory(N_FRAMES, FRAME_DIM) if observation == "paper" else None
        self._position = self._speed = self._sails = 0.0
        self._angle = -0.0
        self._phase = -1.0
        self._thrust, self._bridge_speed = 0.0001, 0.4

    @property
    def frame_dim(self) -> int:
        """One frame."""
        return FRAME_DIM if self.layout == "paper" else 4

    def _describe(self) -> tuple[Array, Array, SubgoalSpace]:
        paper = self.layout == "paper"
        subgoals = SubgoalSpace(
            low=-np.ones(3),
            high=np.ones(3),
            thresholds=(0.05, 0.2, 0.1),
            achieved=_paper_subgoal if paper else _compact_subgoal,
            local=_paper_local if paper else _compact_local,
            local_scale=np.ones(4),
            names=("ship_pos", "ship_vel", "sails_unfurled"),
        )
        return np.ones(N_FRAMES * FRAME_DIM if paper else 4), np.ones(1), subgoals

    def _sample_goal(self) -> Sequence[float]:
        return [0.8]

    def _restart(self, state: dict[str, Array]) -> None:
        self._position = self._speed = self._sails = 0.0
        self._update_bridge(0)

    def _apply_dynamics(self, scales: dict[str, float]) -> None:
        self._thrust, self._bridge_speed = 0.0001 * scales["actuator"], 0.4 * scales["bridge"]

    def _angle_at(self, step: int) -> float:
        """The bridge's angle [degrees] in a step; 0 is closed."""
        return -min(max(step - 500, 0) * self._bridge_speed, 90.0)

    def _update_bridge(self, step: int) -> None:
        self._angle = self._angle_at(step)
        self._phase = 2.0 * step / MAX_STEPS - 1.0

    def _advance(self, action: list[float]) -> None:
        self._sails = min(max(self._sails + 0.03 * action[0], 0.0), 1.0)
        self._position = min(max(self._position + self._speed, 0.0), LENGTH)
        self._speed = min(max(self._speed + self._thrust * self._sails, -MAX_SPEED), MAX_SPEED)
        self._update_bridge(self._elapsed)
        if self._angle > -25.0 and self._position > BRIDGE and self._speed > 0.0:
            self._speed *= -0.1

    def _observe(self, first: bool) -> tuple[Array, list[float]]:
        position = 2.0 * self._position / LENGTH - 1.0
        speed = self._speed / MAX_SPEED
        sails = 2.0 * self._sails - 1.0
        if self._history is None:
            return np.array([self._phase, sails, position, speed]), [position]
        frame = (position, speed, sails, self._phase, -self._angle / 45.0 - 1.0)
        return self._history.reset(frame) if first else self._history.push(frame), [position]

    def task_state(self) -> dict[str, Array]:
        """``ship_pos``, ``ship_vel``, ``sails_unfurled``, ``current_step``, ``drawbridge_angle_deg``, each ``(1,)``."""
        return {
            "ship_pos": np.array([self._position]),
            "ship_vel": np.array([self._speed]),
            "sails_unfurled": np.array([self._sails]),
            "current_step": np.array([float(self._elapsed)]),
            # Of the present step, as in the recordings; observations keep the angle of the step before.
            "drawbridge_angle_deg": np.array([self._angle_at(self._elapsed)]),
        }

    def _draw(self) -> NDArray[np.uint8]:
        return draw_drawbridge(
            self._position, self._speed, self._sails, self._angle, self._goal_list[0], self._overlay, self._elapsed
        )


def _compact_local(observation: GoalObservation) -> FloatArray:
    return observation["observation"]


def _paper_local(observation: GoalObservation) -> FloatArray:
    return observation["observation"][..., [-2, -3, -5, -4]]


def _compact_subgoal(observation: GoalObservation) -> FloatArray:
    return observation["observation"][..., [2, 3, 1]]


def _paper_subgoal(observation: GoalObservation) -> FloatArray:
    return observation["observation"][..., -5:-2]
