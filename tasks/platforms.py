"""Platforms: roll a ball over a trigger and ride two moving platforms up to a ledge."""

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
from .box2d import box_fixture, circle_fixture, load_box2d
from .drawing import draw_platforms
from .history import FrameHistory
from .replayed import ReplayedTask

DT = 1.0 / 60.0
RADIUS = 0.05
MAX_SPIN = 20.0
FORCE = 0.1
AMPLITUDE = 0.25
TRIGGER_STEPS = 2 * math.pi / DT / 2
TRIGGER = (0.0, -0.55, 0.05)  # centre x, y, half-size
STATIC = (  # centre, full size: pit floor, ground, walls, upper ledge
    ((0.0, -1.5), (2.0, 1.0)),
    ((-0.25, -0.95), (1.5, 0.7)),
    ((-1.5, 0.0), (1.0, 10.0)),
    ((1.5, 0.0), (1.0, 10.0)),
    ((-0.5, 0.35), (1.0, 0.1)),
)
PLATFORM_SIZE = (0.5, 0.1)
N_FRAMES = 5
FRAME_DIM = 15


class Platforms(ReplayedTask):
    """A ball, a trigger and two platforms (dynamic RL benchmarks, Guertler et al. 2021); Box2D at 60 Hz.

    The action is a horizontal force of up to 0.1 N on a ball of 7.9 g. Platform 0 always moves between pit and level 1;
    platform 1 moves down from level 2 and back once the ball has rolled over the trigger, for pi seconds.

    * ``observation``, compact (13): spin / 20, platform 0 (x, y, v_x, v_y), platform 1, ball position, ball velocity.
      Paper (75): the last 5 frames, oldest first, of these and the trigger: active (-1 or 1), share of its time
      that has passed (-1 to 1).
    * Goal (2): ball position; desired (x, 0.45) with x in [-0.6, -0.4], success within 0.05 m; 500 steps.
    * Start: at rest at (-0.8, -0.55), platforms at the beginning of their period; only the goal is random.
    * Subgoals (4): ball position and velocity in [-1, 1]; thresholds 0.05 m and 0.2 m/s, Euclidean.

    Quirks kept: velocities are clipped to 0.9 m/s and 19.9 rad/s after each step; the trigger's clock stays where it
    ended. Fixed (unless ``legacy_quirks=True``): platform 1's velocity is computed with platform 0's frequency, 1.5
    times too large; a reset leaves platforms (in a fresh environment at the origin) and contact impulses as they were.
    """

    metadata: ClassVar[Plain] = {"render_modes": ["rgb_array", "human"], "render_fps": 60}
    _not_copied: ClassVar[tuple[str, ...]] = (
        *ReplayedTask._not_copied, "_world", "_platform0", "_platform1", "_ball",
    )  # fmt: skip
    dynamics_names = ("mass", "gravity", "friction", "actuator")
    max_episode_steps = 500
    goal_low = (-2.0, -2.0)
    goal_high = (2.0, 2.0)
    goal_tolerance = (0.05, 0.05)

    def __init__(
        self, *, observation: str = "paper", legacy_quirks: bool = False, render_mode: str | None = None
    ) -> None:
        self._engine = self._load_engine()
        super().__init__(observation=observation, legacy_quirks=legacy_quirks, render_mode=render_mode)
        self._history = FrameHistory(N_FRAMES, FRAME_DIM) if observation == "paper" else None
        self._frequency1 = 3.0 if legacy_quirks else 2.0
        self._active = False
        self._since = 0
        self._scales = dict.fromkeys(self.dynamics_names, 1.0)
        self._new_world()

    _load_engine = staticmethod(load_box2d)

    @property
    def frame_dim(self) -> int:
        """One frame."""
        return FRAME_DIM if self.layout == "paper" else 13

    def _describe(self) -> tuple[Array, Array, SubgoalSpace]:
        paper = self.layout == "paper"
        subgoals = SubgoalSpace(
            low=-np.ones(4),
            high=np.ones(4),
            thresholds=(0.05, 0.2),
            achieved=_paper_subgoal if paper else _compact_subgoal,
            local=_paper_local if paper else _compact_local,
            local_scale=np.ones(13),
            names=("x", "y", "v_x", "v_y"),
            groups=((0, 1), (2, 3)),
        )
        return np.ones(N_FRAMES * FRAME_DIM if paper else 13), np.ones(2), subgoals

    def _build(self) -> None:
        scales = self._scales
        self._force = FORCE * scales["actuator"]
        self._world = world = self._engine.b2World(gravity=(0, -9.8 * scales["gravity"]))
        for centre, (width, height) in STATIC:
            world.CreateStaticBody(position=centre, fixtures=box_fixture(width / 2, height / 2))
        platform = box_fixture(PLATFORM_SIZE[0] / 2, PLATFORM_SIZE[1] / 2)
        self._platform0 = world.CreateKinematicBody(position=(0, 0), fixtures=platform)
        self._platform1 = world.CreateKinematicBody(position=(0, 0), fixtures=platform)
        # The order of creation is the order in which contacts are solved, so it matters to the last bit.
        ball = circle_fixture(RADIUS, density=1.0, restitution=0.4)
        self._ball = world.CreateDynamicBody(position=(-0.8, -0.55), fixtures=ball)
        if scales["friction"] != 1.0 or scales["mass"] != 1.0:
            fixture = self._ball.fixtures[0]
            fixture.friction, fixture.density = 0.2 * scales["friction"], scales["mass"]
            self._ball.ResetMassData()

    def _apply_dynamics(self, scales: dict[str, float]) -> None:
        self._scales = scales
        self._new_world()

    def _sample_goal(self) -> Sequence[float]:
        return [-0.5 + self.np_random.uniform(-0.1, 0.1), 0.45]

    def _restart(self, state: dict[str, Array]) -> None:
        if not self.legacy_quirks:
            self._new_world()
        self._start([])

    def _begin(self, start: list[float]) -> None:
        self._active = False
        self._since = 0
        if not self.legacy_quirks:
            self._move_platforms(0)
        ball = self._ball
        ball.position, ball.angle = (-0.8, -0.55), 0.0
        ball.linearVelocity, ball.angularVelocity = (0.0, 0.0), 0.0

    def _move_platforms(self, step: int) -> None:
        phase = 3.0 * (step * DT) - 0.8 * math.pi
        self._platform0.position = (0.75, -0.4 + AMPLITUDE * math.sin(phase))
        self._platform0.linearVelocity = (0.0, 3.0 * AMPLITUDE * math.cos(phase))
        phase = 2.0 * (self._since * DT)
        self._platform1.position = (0.25, 0.1 + AMPLITUDE * math.cos(phase))
        speed = -self._frequency1 * AMPLITUDE * math.sin(phase) if self._active else 0.0
        self._platform1.linearVelocity = (0.0, speed)

    def _simulate(self, action: list[float]) -> None:
        ball = self._ball
        ball.ApplyForceToCenter((action[0] * self._force, 0.0), True)
        self._move_platforms(self._elapsed)
        self._world.Step(DT, 10, 8)
        self._world.ClearForces()
        vx, vy = ball.linearVelocity
        if not (-0.9 <= vx <= 0.9 and -0.9 <= vy <= 0.9):
            ball.linearVelocity = (min(max(vx, -0.9), 0.9), min(max(vy, -0.9), 0.9))
        if abs(ball.angularVelocity) > MAX_SPIN - 0.1:
            ball.angularVelocity = math.copysign(MAX_SPIN - 0.1, ball.angularVelocity)
        self._update_trigger()

    def _update_trigger(self) -> None:
        if self._active:
            self._since += 1
            self._active = self._since < TRIGGER_STEPS
        if not self._active:
            x, y = self._ball.position
            if abs(x - TRIGGER[0]) < TRIGGER[2] and abs(y - TRIGGER[1]) < TRIGGER[2]:
                self._active, self._since = True, 0

    def _observe(self, first: bool) -> tuple[Array, list[float]]:
        ball = self._ball
        position = list(ball.position)
        native = [
            ball.angularVelocity / MAX_SPIN,
            *self._platform0.position,
            *self._platform0.linearVelocity,
            *self._platform1.position,
            *self._platform1.linearVelocity,
            *position,
            *ball.linearVelocity,
        ]
        if self._history is None:
            return np.array(native), position
        native.append(1.0 if self._active else -1.0)
        native.append(2.0 * min(self._since / TRIGGER_STEPS, 1.0) - 1.0)
        return self._history.reset(native) if first else self._history.push(native), position

    def _holds(self, achieved: list[float], desired: list[float]) -> bool:
        dx, dy = achieved[0] - desired[0], achieved[1] - desired[1]
        return math.sqrt(dx * dx + dy * dy) <= self.goal_tolerance[0]

    def _holds_batch(self, achieved: Array, desired: Array) -> Any:
        difference = achieved - desired
        dx, dy = difference[..., 0], difference[..., 1]
        return np.sqrt(dx * dx + dy * dy) <= self.goal_tolerance[0]

    def task_state(self) -> dict[str, Array]:
        """Ball (``ball_pos``, ``ball_angle``, ``ball_linvel``, ``ball_angvel``), ``trigger``, step and platforms."""
        ball = self._ball
        return {
            "ball_pos": np.array(ball.position),
            "ball_angle": np.array([ball.angle]),
            "ball_linvel": np.array(ball.linearVelocity),
            "ball_angvel": np.array([ball.angularVelocity]),
            "trigger": np.array([float(self._active), float(self._since)]),
            "current_step": np.array([float(self._elapsed)]),
            "platform0": np.array([*self._platform0.position, *self._platform0.linearVelocity]),
            "platform1": np.array([*self._platform1.position, *self._platform1.linearVelocity]),
        }

    def _draw(self) -> NDArray[np.uint8]:
        return draw_platforms(self.task_state(), STATIC, self._goal, self._overlay)


def _compact_local(observation: GoalObservation) -> FloatArray:
    return observation["observation"]


def _paper_local(observation: GoalObservation) -> FloatArray:
    return observation["observation"][..., -15:-2]


def _compact_subgoal(observation: GoalObservation) -> FloatArray:
    return observation["observation"][..., 9:13]


def _paper_subgoal(observation: GoalObservation) -> FloatArray:
    return observation["observation"][..., -6:-2]
