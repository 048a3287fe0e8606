"""Tennis2D: return a ball with a three-joint planar arm so that its second bounce lands in a target zone."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any, ClassVar

import numpy as np
from numpy.typing import NDArray

from sb3_tbc.aliases import Plain
from sb3_tbc.arrays import FloatArray
from sb3_tbc.smdp.spaces import GoalObservation, SubgoalSpace

from .base import Array
from .box2d import load_box2d
from .drawing import draw_tennis
from .replayed import ReplayedTask
from .tennis2d_world import RACKET_HALF, ROD_HALF, TennisWorld, clip_unit

DT = 0.01
LENGTH_SCALE, SPEED_SCALE, SPIN_SCALE = 6.0, 5.4, 5.0
MAX_JOINT_SPEED = 8.0
JOINT_SCALE = (0.7 * math.pi * 1.3, 0.7 * math.pi * 1.3, 0.3 * math.pi * 1.3)
LANDING_CENTRE, LANDING_SCALE = 3.0, 3.0
TOLERANCE = 0.4
NATIVE_DIM = 14
SECOND_BOUNCE = 3
"""Index of the flag in the observation."""


class Tennis2D(ReplayedTask):
    """Planar tennis (dynamic RL benchmarks, Guertler et al. 2021, on the physics of roboball2d); Box2D at 100 Hz.

    A gun 5 m away shoots a ball at an arm of two rods and a racket. Actions (3) are joint torques as shares of 0.14,
    0.07 and 0.03 N m.

    * ``observation``, compact (14): ball spin / 5, bounced at least once, at least twice, bouncing for the second time,
      ball x and y / 6, ball v_x and v_y / 5.4, then angle and velocity of each joint in [-1, 1]. Paper (30): these,
      then x, y, v_x, v_y of both rods and the racket, and of the ball relative to the racket, on the ball's scales.
    * Goal (4): ((ball x - 3) / 3, bounced, bouncing for the second time, bounced twice); desired (u, 1, 1, 1) with u in
      [0, 1]. Success: the flags agree and the ball is within 0.4 m, so only in the step of the second bounce.
    * Start: arm at (45, -90, 0) degrees; the shot's height, speed, angle and spin are random; 500 steps.
    * Subgoals (6): joint angles and velocities in [-1, 1], thresholds 0.2; the low level sees only these. The second
      bounce is an event: it returns control to the high level, and it alone can give hindsight goals.

    Fixed (unless ``legacy_quirks=True``): the shot's spin never reaches the ball, which keeps the spin of the episode
    before; solver impulses survive a reset; success does not end the episode; rounding adds a 501st step (through
    ``gymnasium.make`` only with ``max_episode_steps=501``).
    """

    metadata: ClassVar[Plain] = {"render_modes": ["rgb_array", "human"], "render_fps": 50}
    _not_copied: ClassVar[tuple[str, ...]] = (*ReplayedTask._not_copied, "_arena")
    dynamics_names = ("mass", "damping", "gravity", "actuator")
    max_episode_steps = 500
    action_bound = (1.0,) * 3
    goal_low = (-math.inf, 0.0, 0.0, 0.0)
    goal_high = (math.inf, 1.0, 1.0, 1.0)
    goal_tolerance = (TOLERANCE / LANDING_SCALE, 0.0, 0.0, 0.0)

    def __init__(
        self, *, observation: str = "paper", legacy_quirks: bool = False, render_mode: str | None = None
    ) -> None:
        self._engine = self._load_engine()
        super().__init__(observation=observation, legacy_quirks=legacy_quirks, render_mode=render_mode)
        self._scales = dict.fromkeys(self.dynamics_names, 1.0)
        self._new_world()
        self._bounces = 0
        self._second = False
        if legacy_quirks:
            self.success_terminates = False
            self.max_episode_steps = 501

    _load_engine = staticmethod(load_box2d)

    def _build(self) -> None:
        self._arena = TennisWorld(self._engine, **self._scales)

    def _describe(self) -> tuple[Array, Array, SubgoalSpace]:
        subgoals = SubgoalSpace(
            low=-np.ones(6),
            high=np.ones(6),
            thresholds=np.full(6, 0.2),
            achieved=_robot,
            local=_robot,
            local_scale=np.ones(6),
            names=tuple(f"joint_{i}_{what}" for i in range(3) for what in ("angle", "angular_vel")),
            event=SECOND_BOUNCE,
        )
        return np.ones(30 if self.layout == "paper" else NATIVE_DIM), np.ones(4), subgoals

    def _state_shapes(self) -> dict[str, tuple[int, ...]]:
        return {"ball_shot": (6,)}

    def _sample_goal(self) -> Sequence[float]:
        return [self.np_random.uniform(0.0, 1.0), 1.0, 1.0, 1.0]

    def _sample_shot(self) -> list[float]:
        """x, y, angle, v_x, v_y, spin of the ball as it leaves the gun."""
        rng = self.np_random
        height, speed = max(rng.normal(1.2, 0.1), 0.2), rng.normal(5.4, 0.2)
        direction, spin = rng.uniform(-0.1 * math.pi, 0.1 * math.pi), rng.normal(0.0, 5.0)
        return [6.0, height, 0.0, -speed * math.cos(direction), speed * math.sin(direction), spin]

    def _restart(self, state: dict[str, Array]) -> None:
        drawn = self._sample_shot()  # even where one is given, so that later episodes of the seed stay the same
        shot = state["ball_shot"].tolist() if "ball_shot" in state else drawn
        if not self.legacy_quirks:
            self._new_world()
        self._start(shot)

    def _begin(self, start: list[float]) -> None:
        self._arena.restart(start[:5], None if self.legacy_quirks else start[5])
        self._bounces, self._second = 0, False

    def _apply_dynamics(self, scales: dict[str, float]) -> None:
        self._scales = scales
        self._new_world()

    def _simulate(self, action: list[float]) -> None:
        arena = self._arena
        arena.step(action, DT)
        self._second = False
        if arena.floor_contact:
            self._bounces += 1
            self._second = self._bounces == 2

    def _observe(self, first: bool) -> tuple[Array, list[float]]:
        arena = self._arena
        x, y = arena.ball.position
        vx, vy = arena.ball.linearVelocity
        once, twice, second = float(self._bounces >= 1), float(self._bounces >= 2), float(self._second)
        values = [
            arena.ball.angularVelocity / SPIN_SCALE,
            once,
            twice,
            second,
            x / LENGTH_SCALE,
            y / LENGTH_SCALE,
            vx / SPEED_SCALE,
            vy / SPEED_SCALE,
        ]
        for joint, scale in zip(arena.joints, JOINT_SCALE, strict=True):
            values.append(clip_unit(joint.angle / scale))
            values.append(clip_unit(joint.speed / MAX_JOINT_SPEED))
        if self.layout == "paper":
            values.extend(self._links(x, y, vx, vy))
        return np.array(values), [(x - LANDING_CENTRE) / LANDING_SCALE, once, second, twice]

    def _links(self, x: float, y: float, vx: float, vy: float) -> list[float]:
        """Positions and velocities of the links, and the ball's relative to the racket, scaled."""
        values: list[float] = []
        for body in self._arena.links:
            bx, by = body.position
            bvx, bvy = body.linearVelocity
            values += [bx / LENGTH_SCALE, by / LENGTH_SCALE, bvx / SPEED_SCALE, bvy / SPEED_SCALE]
        return [
            *values,
            (x - bx) / LENGTH_SCALE,
            (y - by) / LENGTH_SCALE,
            (vx - bvx) / SPEED_SCALE,
            (vy - bvy) / SPEED_SCALE,
        ]

    def _holds(self, achieved: list[float], desired: list[float]) -> bool:
        return achieved[1:] == desired[1:] and abs(desired[0] - achieved[0]) * LANDING_SCALE <= TOLERANCE

    def _holds_batch(self, achieved: Array, desired: Array) -> Any:
        flags = (achieved[..., 1:] == desired[..., 1:]).all(axis=-1)
        return flags & (np.abs(desired[..., 0] - achieved[..., 0]) * LANDING_SCALE <= TOLERANCE)

    def task_state(self) -> dict[str, Array]:
        """Bodies as x, y, angle, v_x, v_y, spin; joint angles and speeds; contacts of the last step.

        ``contact`` is (racket touched, floor touched, ball x at the floor or nan, bounces so far).
        """
        arena = self._arena
        bodies = {"ball": arena.ball, **dict(zip(("rod0", "rod1", "racket"), arena.links, strict=True))}
        state = {
            name: np.array([*body.position, body.angle, *body.linearVelocity, body.angularVelocity])
            for name, body in bodies.items()
        }
        state["joint_angle"] = np.array([joint.angle for joint in arena.joints])
        state["joint_speed"] = np.array([joint.speed for joint in arena.joints])
        contact = (arena.racket_contact, arena.floor_contact, arena.floor_contact_x, self._bounces)
        state["contact"] = np.array(contact, dtype=np.float64)
        return state

    def _draw(self) -> NDArray[np.uint8]:
        halves = (ROD_HALF, ROD_HALF, RACKET_HALF)
        return draw_tennis(self.task_state(), halves, self._goal, self._overlay, self._elapsed)


def _robot(observation: GoalObservation) -> FloatArray:
    return observation["observation"][..., 8:14]
