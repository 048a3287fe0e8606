"""UR5Reacher: bring the three large joints of a UR5 arm to a desired configuration."""

from __future__ import annotations

import math
from abc import abstractmethod
from collections.abc import Sequence
from typing import ClassVar

import mujoco
import numpy as np

from sb3_tbc.aliases import Plain
from sb3_tbc.arrays import FloatArray
from sb3_tbc.smdp.spaces import GoalObservation, SubgoalSpace

from .base import Array, GoalTask
from .history import FrameHistory
from .mujoco_rendering import ASSETS, GOAL_RGBA, Scene
from .mujoco_task import MujocoTask
from .rendering import SUBGOAL, Canvas

N_FRAMES = 8
MAX_SPEED = 4.0
TYPICAL_ANGLE = 1.2  # rad, what the joints move by in an episode
BASE_HEIGHT, UPPER_ARM, FOREARM = 0.089159, 0.425, 0.39225
START = (3.22757851e-03, -1.27944547e-01)

MODEL = """
<mujoco model="ur5">
  <compiler angle="radian" autolimits="true"/>
  <option timestep="0.002" gravity="0 0 -9.81" cone="elliptic" impratio="5" tolerance="1e-4">
    <flag island="disable"/>
  </option>
  <default>
    <geom contype="0" conaffinity="0"/>
    <pair condim="3" solref="0.01 1" solimp="0.99 0.99 0.01" friction="1 1 0.005 0.0001 0.0001"/>
    <joint type="hinge" damping="10"/>
    <general gaintype="fixed" biastype="affine" gainprm="10" biasprm="0 0 -10" forcerange="-150 150"/>
  </default>
  <worldbody>
    <geom name="floor" type="plane" size="5 5 0.1"/>
    <geom name="base" type="cylinder" size="0.0735 0.012" pos="0 0 0.009"/>
    <body name="shoulder_link" pos="0 0 0.089159">
      <inertial pos="0 0 0" mass="3.7" diaginertia="0.0102675 0.0102675 0.00666"/>
      <joint name="shoulder_pan" axis="0 0 1"/>
      <geom name="shoulder" type="cylinder" size="0.0595 0.0668" pos="0 0 0.0016"/>
      <body name="upper_arm_link" pos="0 0.13585 0" quat="0.707107 0 0.707107 0">
        <inertial pos="0 0 0.28" mass="8.393" diaginertia="0.226891 0.226891 0.0151074"/>
        <joint name="shoulder_lift" axis="0 1 0"/>
        <geom name="elbow" type="sphere" size="0.0597" pos="0 0 0.425"/>
        <body name="forearm_link" pos="0 -0.1197 0.425">
          <inertial pos="0 0 0.25" mass="2.275" diaginertia="0.0494433 0.0494433 0.004095"/>
          <joint name="elbow" axis="0 1 0"/>
          <geom name="forearm" type="capsule" size="0.0385" fromto="0 0 0.12 0 0 0.4"/>
        </body>
      </body>
    </body>
  </worldbody>
  <contact>
    <pair geom1="floor" geom2="elbow"/>
    <pair geom1="floor" geom2="forearm"/>
    <pair geom1="base" geom2="forearm"/>
    <pair geom1="shoulder" geom2="forearm"/>
  </contact>
  <actuator>
    <general joint="shoulder_pan" ctrlrange="-3.15 3.15"/>
    <general joint="shoulder_lift" ctrlrange="-5 5"/>
    <general joint="elbow" ctrlrange="-3.15 3.15"/>
  </actuator>
</mujoco>
"""
"""What is stepped: the original's masses, joints and servos, and as few shapes as move on the floor like its meshes.

Only where the upper arm ends and the forearm ends touch the floor. One sphere and one capsule, one contact each, follow
the original closer than a set of cylinders and boxes that fills the links, and take half the time.
"""

DRAWN_MODEL = f"""
<mujoco model="ur5">{ASSETS}
  <compiler angle="radian" autolimits="true"/>
  <default><joint type="hinge"/></default>
  <worldbody>
    <light pos="1 -1 3" dir="-0.3 0.3 -1" directional="true" diffuse="0.5 0.5 0.5"/>
    <geom name="floor" type="plane" size="5 5 0.1" material="tiles"/>
    <body name="base_link">
      <inertial pos="0 0 0" quat="0.5 0.5 -0.5 0.5" mass="4" diaginertia="0.0072 0.00443333 0.00443333"/>
      <geom type="cylinder" size="0.0735 0.012" pos="0 0 0.009" material="joint"/>
      <body name="shoulder_link" pos="0 0 0.089159">
        <inertial pos="0 0 0" mass="3.7" diaginertia="0.0102675 0.0102675 0.00666"/>
        <joint name="shoulder_pan" axis="0 0 1"/>
        <geom type="cylinder" size="0.0595 0.0668" pos="0 0 0.0016" material="joint"/>
        <body name="upper_arm_link" pos="0 0.13585 0" quat="0.707107 0 0.707107 0">
          <inertial pos="0 0 0.28" mass="8.393" diaginertia="0.226891 0.226891 0.0151074"/>
          <joint name="shoulder_lift" axis="0 1 0"/>
          <geom type="cylinder" size="0.0597" fromto="0 -0.0652 0 0 0.0686 0" material="joint"/>
          <geom type="cylinder" size="0.0597" fromto="0 -0.0652 0.425 0 0.0672 0.425" material="joint"/>
          <geom type="box" size="0.0597 0.0669 0.2125" pos="0 0.0017 0.2125" material="body"/>
          <body name="forearm_link" pos="0 -0.1197 0.425">
            <inertial pos="0 0 0.25" mass="2.275" diaginertia="0.0494433 0.0494433 0.004095"/>
            <joint name="elbow" axis="0 1 0"/>
            <geom type="sphere" size="0.058" material="joint"/>
            <geom type="capsule" size="0.0525" fromto="0 0 0.05 0 0 0.15" material="body"/>
            <geom type="capsule" size="0.0455" fromto="0 0 0.15 0 0 0.27" material="body"/>
            <geom type="cylinder" size="0.0385" fromto="0 0 0.27 0 0 0.4313" material="body"/>
          </body>
        </body>
      </body>
    </body>
  </worldbody>
</mujoco>
"""
"""The arm as it is drawn."""


SKELETON = (
    ("shoulder_link", (0.0, 0.0, 0.0)),
    ("upper_arm_link", (0.0, 0.0, 0.0)),
    ("forearm_link", (0.0, 0.0, 0.0)),
    ("forearm_link", (0.0, 0.0, 0.4313)),
)
"""Points along the arm: body, place in its frame."""


class ArmTask(GoalTask):
    """The reaching task, whichever engine moves the arm."""

    metadata: ClassVar[Plain] = {"render_modes": ["rgb_array", "human"], "render_fps": 33}
    max_episode_steps = 600
    action_bound = (3.15, 5.0, 3.15)
    goal_low = (-2 * math.pi,) * 3
    goal_high = (2 * math.pi,) * 3
    goal_tolerance = (math.radians(10.0),) * 3
    velocity_entries = (3, 4, 5)

    def __init__(
        self, *, observation: str = "paper", legacy_quirks: bool = False, render_mode: str | None = None
    ) -> None:
        super().__init__(observation=observation, legacy_quirks=legacy_quirks, render_mode=render_mode)
        self._history = FrameHistory(N_FRAMES, 6) if observation == "paper" else None

    @property
    def frame_dim(self) -> int:
        """Angles and velocities."""
        return 6

    @abstractmethod
    def _joints(self) -> tuple[list[float], list[float]]:
        """Angles and velocities."""

    def _describe(self) -> tuple[Array, Array, SubgoalSpace]:
        local_scale = np.array([TYPICAL_ANGLE] * 3 + [MAX_SPEED] * 3)
        bound = np.array([2 * math.pi] * 3 + [MAX_SPEED] * 3)
        subgoals = SubgoalSpace(
            low=-bound,
            high=bound,
            thresholds=(math.radians(10.0),) * 3 + (2.0,) * 3,
            achieved=_subgoal,
            local=_local,
            local_scale=local_scale,
            names=("pan", "lift", "elbow", "pan_velocity", "lift_velocity", "elbow_velocity"),
        )
        return np.tile(local_scale, N_FRAMES if self.layout == "paper" else 1), np.full(3, math.pi), subgoals

    def subgoals_without_velocities(self) -> SubgoalSpace:
        """The joint angles alone; the low level does not see the velocities either."""
        whole, first = self.subgoals, slice(3)
        return SubgoalSpace(
            whole.low[first], whole.high[first], whole.thresholds[first], _achieved_goal, _angles,
            whole.local_scale[first], whole.names[first],
        )  # fmt: skip

    def _sample_goal(self) -> Sequence[float]:
        """Draw a desired configuration (pan, lift, elbow) that keeps elbow and wrist clear of the floor."""
        rng = self.np_random
        while True:
            pan = rng.uniform(-math.pi, math.pi)
            lift, elbow = rng.uniform(-math.pi / 4, 0.0), rng.uniform(-math.pi / 4, math.pi / 4)
            elbow_height = BASE_HEIGHT - UPPER_ARM * math.sin(lift)
            wrist_height = elbow_height - FOREARM * math.sin(lift + elbow)
            if abs(pan) > math.pi / 4 and elbow_height > 0.05 and wrist_height > 0.15:
                return [pan, lift, elbow]

    def _sample_start(self) -> tuple[Array, Array]:
        pan = self.np_random.uniform(-math.pi / 8, math.pi / 8)
        return np.array([pan, *START]), np.zeros(3)

    def _observe(self, first: bool) -> tuple[Array, list[float]]:
        angles, speeds = self._joints()
        frame = angles + speeds
        achieved = [math.fmod(q, 2 * math.pi) for q in angles]
        if self._history is None:
            return np.array(frame), achieved
        return self._history.reset(frame) if first else self._history.push(frame), achieved


class UR5Reacher(ArmTask, MujocoTask):
    """The UR5 reaching task of the HAC and HiTS benchmarks: three joints driven by velocity servos, gravity, a floor.

    Servo torque is ``10 (ctrl - qd)``, joint damping 10 acts besides; one control step is 15 simulator steps of 2 ms.

    * ``observation``, compact (6): joint angles (pan, lift, elbow; unwrapped) [rad] and velocities [rad/s]. Paper (48):
      the last 8 frames of these, oldest first.
    * Goal (3): angles modulo 2 pi with their sign kept. Desired: pan in [-pi, pi] but beyond +-pi/4, lift in
      [-pi/4, 0], elbow in [-pi/4, pi/4], elbow point above 0.05 m and wrist above 0.15 m. Success within 10 degrees
      per joint; 600 steps.
    * Start: pan within +-pi/8, the arm almost straight and level, at rest.
    * Subgoals (6): goal angles and velocities clipped to +-4 rad/s; thresholds 10 degrees and 2 rad/s.

    A sphere and a capsule stand for the original collision meshes; free motion is the original's.

    Quirks kept: one simulator sub-step at reset; no wrap-around between +350 and -10 degrees; training goals are the
    evaluation goals. Fixed (unless ``legacy_quirks=True``): the sub-step at reset acts under the last command of the
    episode before, with its solver warm start.
    """

    xml: ClassVar[str] = MODEL
    drawn_xml: ClassVar[str | None] = DRAWN_MODEL
    frame_skip: ClassVar[int] = 15

    def _joints(self) -> tuple[list[float], list[float]]:
        return self._qpos.tolist(), self._qvel.tolist()

    def _make_scene(self, model: mujoco.MjModel) -> Scene:
        return Scene(model, (640, 480), lookat=(0.0, 0.0, 0.32), distance=2.3, azimuth=150.0, elevation=-25.0)

    def _add_markers(self, scene: Scene) -> None:
        shoulder = np.flatnonzero(scene.model.geom_bodyid == scene.model.body("shoulder_link").id)
        scene.add_ghost(self._goal, GOAL_RGBA, without=shoulder.tolist())

    def _draw_subgoal(self, canvas: Canvas, scene: Scene, subgoal: Array) -> None:
        """The arm as lines from joint to joint."""
        points = [scene.project(place) for place in scene.places(subgoal[:3], SKELETON)]
        canvas.outline(points, SUBGOAL, 4.0, closed=False)
        for point in points:
            canvas.ring(point, 6.0, SUBGOAL)


def _achieved_goal(observation: GoalObservation) -> FloatArray:
    return observation["achieved_goal"]


def _angles(observation: GoalObservation) -> FloatArray:
    return observation["observation"][..., -6:-3]


def _local(observation: GoalObservation) -> FloatArray:
    return observation["observation"][..., -6:]


def _subgoal(observation: GoalObservation) -> FloatArray:
    state = observation["observation"]
    angles, speeds = state[..., -6:-3], state[..., -3:]
    bounded = np.minimum(np.maximum(speeds, -MAX_SPEED), MAX_SPEED)  # several times as fast as clip on so few
    return np.concatenate([np.fmod(angles, 2 * math.pi), bounded], axis=-1)
