"""Pendulum: swing an underactuated inverted pendulum up to an angle and a velocity near the top."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import ClassVar

import numpy as np
from numpy.typing import NDArray

from sb3_tbc.aliases import Plain
from sb3_tbc.arrays import FloatArray
from sb3_tbc.smdp.spaces import GoalObservation, SubgoalSpace

from .base import Array, GoalTask
from .drawing import draw_pendulum

TIME_STEP = 0.002
SUB_STEPS = 10
HEIGHT, LENGTH, INERTIA = 0.6, 0.5, 0.001  # of the pivot and the rod, m; about the bob's own axis, kg m^2
DAMPING, GRAVITY = 0.1, 9.81  # N m s, m/s^2
MAX_SPEED = 15.0
TYPICAL_SPEED = 4.0  # rad/s, on the way up


class Pendulum(GoalTask):
    """The inverted pendulum of the HAC and HiTS benchmarks: 1 kg on a 0.5 m rod, at most 2 N m of torque.

    Angle 0 is upright. ``0.251 qdd = u - 0.1 qd + 4.905 sin(q)``; one control step is 10 Euler steps of 2 ms,
    semi-implicit and with the damping taken at the new velocity. The original is a MuJoCo model; for one hinge its
    arithmetic fits into a few lines of plain floats, which agree to the last bit and take half the time.

    * ``observation`` (both layouts, 3): cos q, sin q, qd [rad/s].
    * Goal (2): angle in [-pi, pi], velocity clipped to +-15 rad/s; desired angle within +-16 degrees, velocity within
      +-0.6. Success within 9.5 degrees and 0.6 rad/s (no wrap in the difference); passing through once is enough.
    * Start: angle uniform in [pi/4, 7 pi/4], velocity within +-0.05; 1000 steps.
    * Subgoals (2): angle and velocity, thresholds as for the goal.

    Quirks kept: one simulator sub-step at reset; the evaluation goals are the training goals. Fixed (unless
    ``legacy_quirks=True``): the sub-step at reset acts under the last torque of the episode before; a subgoal angle of
    exactly pi reads as 0.
    """

    metadata: ClassVar[Plain] = {"render_modes": ["rgb_array", "human"], "render_fps": 50}
    max_episode_steps = 1000
    dynamics_names = ("mass", "damping", "gravity", "actuator")
    velocity_entries = (2,)
    action_bound = (2.0,)
    goal_low = (-math.pi, -MAX_SPEED)
    goal_high = (math.pi, MAX_SPEED)
    goal_tolerance = (math.radians(9.5), 0.6)

    def __init__(
        self, *, observation: str = "paper", legacy_quirks: bool = False, render_mode: str | None = None
    ) -> None:
        super().__init__(observation=observation, legacy_quirks=legacy_quirks, render_mode=render_mode)
        self._angle = self._speed = self._torque = 0.0
        self._apply_dynamics({})

    def _describe(self) -> tuple[Array, Array, SubgoalSpace]:
        goal_scale = np.array([math.pi, MAX_SPEED])
        local_scale = np.array([1.0, 1.0, TYPICAL_SPEED])
        subgoals = SubgoalSpace(
            low=-goal_scale,
            high=goal_scale,
            thresholds=self.goal_tolerance,
            achieved=_legacy_subgoal if self.legacy_quirks else _subgoal,
            local=_local,
            local_scale=local_scale,
            names=("angle", "velocity"),
        )
        return local_scale.copy(), goal_scale, subgoals

    def subgoals_without_velocities(self) -> SubgoalSpace:
        """Angle and velocity as before, of which the low level sees the angle alone."""
        whole = self.subgoals
        return SubgoalSpace(
            whole.low, whole.high, whole.thresholds, _achieved_goal, _angle_alone, whole.local_scale[:2], whole.names
        )

    def _sample_goal(self) -> Sequence[float]:
        angle = math.radians(16.0)
        return [self.np_random.uniform(-angle, angle), self.np_random.uniform(-0.6, 0.6)]

    def _state_shapes(self) -> dict[str, tuple[int, ...]]:
        return {"qpos": (1,), "qvel": (1,)}

    def _apply_dynamics(self, scales: dict[str, float]) -> None:
        self._mass, self._gain = scales.get("mass", 1.0), scales.get("actuator", 1.0)
        self._damping, self._gravity = DAMPING * scales.get("damping", 1.0), GRAVITY * scales.get("gravity", 1.0)

    def _restart(self, state: dict[str, Array]) -> None:
        angle, speed = self.np_random.uniform(math.pi / 4, 7 * math.pi / 4), self.np_random.uniform(-0.05, 0.05)
        self._angle = float(state["qpos"][0]) if "qpos" in state else angle
        self._speed = float(state["qvel"][0]) if "qvel" in state else speed
        if not self.legacy_quirks:
            self._torque = 0.0
        self._simulate(1)

    def _advance(self, action: list[float]) -> None:
        self._torque = action[0]
        self._simulate(SUB_STEPS)

    def _simulate(self, n_steps: int) -> None:
        """Advance by ``n_steps`` of 2 ms; in local names, because this loop is most of a step's time.

        ``x`` and ``z`` point from the hinge to the bob. Gravity and centrifugal forces (whose torques cancel but for
        rounding), inertia and damping appear in MuJoCo's order and with its detours: balancing at the top amplifies
        rounding by a factor of 80 a second, so another order would end elsewhere.
        """
        angle, speed, sin, cos = self._angle, self._speed, math.sin, math.cos
        torque, mass, damping, gravity = self._gain * self._torque, self._mass, self._damping, self._gravity
        for _ in range(n_steps):
            half = 0.5 * angle
            c, s = cos(half), sin(half)
            x = 2.0 * LENGTH * (c * s)
            c, s = c * c, s * s
            z = (HEIGHT + LENGTH * (c - s)) - HEIGHT
            unit = c + s
            z_speed = z * speed
            bias = mass * (x * (speed * z_speed - gravity) - z * (speed * (x * speed)))
            inertia = mass * (unit * (unit * INERTIA) + z * z + x * x) + TIME_STEP * damping
            speed += TIME_STEP * ((torque - (damping * speed + bias)) * (1.0 / inertia))
            angle += TIME_STEP * speed
        self._angle, self._speed = angle, speed

    def _observe(self, first: bool) -> tuple[Array, list[float]]:
        angle, speed = self._angle, self._speed
        achieved = [(angle + math.pi) % (2 * math.pi) - math.pi, min(max(speed, -MAX_SPEED), MAX_SPEED)]
        return np.array([math.cos(angle), math.sin(angle), speed]), achieved

    def task_state(self) -> dict[str, Array]:
        """``qpos`` (angle, unwrapped) and ``qvel``, one entry each."""
        return {"qpos": np.array([self._angle]), "qvel": np.array([self._speed])}

    def _draw(self) -> NDArray[np.uint8]:
        return draw_pendulum(self._angle, self._speed, self._goal, self._overlay, self._elapsed)


def _achieved_goal(observation: GoalObservation) -> FloatArray:
    return observation["achieved_goal"]


def _angle_alone(observation: GoalObservation) -> FloatArray:
    return observation["observation"][..., :2]


def _local(observation: GoalObservation) -> FloatArray:
    return observation["observation"]


def _subgoal(observation: GoalObservation) -> FloatArray:
    state = observation["observation"]
    angle = np.arctan2(state[..., 1], state[..., 0])
    return np.stack([angle, np.clip(state[..., 2], -MAX_SPEED, MAX_SPEED)], axis=-1)


def _legacy_subgoal(observation: GoalObservation) -> FloatArray:
    state = observation["observation"]
    angle = np.sign(state[..., 1]) * np.arccos(np.clip(state[..., 0], -1.0, 1.0))
    return np.stack([angle, np.clip(state[..., 2], -MAX_SPEED, MAX_SPEED)], axis=-1)
