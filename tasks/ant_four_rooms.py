"""AntFourRooms: walk a four-legged ant from one room into another."""

from __future__ import annotations

import functools
from collections.abc import Callable, Sequence
from typing import ClassVar

import mujoco
import numpy as np

from sb3_tbc.aliases import Plain
from sb3_tbc.arrays import FloatArray
from sb3_tbc.smdp.spaces import GoalObservation, SubgoalSpace

from .base import Array
from .mujoco_rendering import ASSETS, GOAL_RGBA, Scene
from .mujoco_task import MujocoTask
from .rendering import SUBGOAL, Canvas

ROOM_SIGNS = ((1, 1), (-1, 1), (-1, -1), (1, -1))
START_JOINTS = (0.0, 1.0, 0.0, -1.0, 0.0, -1.0, 0.0, 1.0)
MAX_SPEED = 3.0
WALLS = {  # centre x, y; half-size x, y
    "east_wall": (8.25, 0, 0.25, 8.25),
    "north_wall": (0, 8.25, 8.5, 0.25),
    "west_wall": (-8.25, 0, 0.25, 8.25),
    "south_wall": (0, -8.25, 8.5, 0.25),
    "center_vertical": (0, 0, 0.5, 3.5),
    "center_horizontal": (0, 0, 3.5, 0.5),
    "east_stick_out": (7.25, 0, 0.75, 0.5),
    "north_stick_out": (0, 7.25, 0.5, 0.75),
    "west_stick_out": (-7.25, 0, 0.75, 0.5),
    "south_stick_out": (0, -7.25, 0.5, 0.75),
}
LEGS = (  # name, sign x, sign y, ankle axis, ankle range
    ("front_left_leg", 1, 1, "-1 1 0", "30 70"),
    ("front_right_leg", -1, 1, "1 1 0", "-70 -30"),
    ("back_leg", -1, -1, "-1 1 0", "-70 -30"),
    ("right_back_leg", 1, -1, "1 1 0", "30 70"),
)


def ant_xml() -> str:
    """The model: ant, floor and walls."""
    legs = "".join(_leg(k + 1, *leg) for k, leg in enumerate(LEGS))
    walls = "".join(
        f'<body name="{name}" pos="{x} {y} 1">'
        f'<geom type="box" size="{hx} {hy} 1" conaffinity="1" material="wall"/></body>'
        for name, (x, y, hx, hy) in WALLS.items()
    )
    motors = "".join(f'<motor joint="{joint}_{k}"/>' for k in (4, 1, 2, 3) for joint in ("hip", "ankle"))
    return f"""
<mujoco model="ant_four_rooms">{ASSETS}
  <compiler angle="degree" inertiafromgeom="true" autolimits="true"/>
  <option timestep="0.02" integrator="RK4"><flag island="disable" midphase="disable"/></option>
  <size njmax="500" nconmax="200"/>
  <default>
    <joint armature="1" damping="1"/>
    <geom conaffinity="0" condim="3" density="5" friction="1 0.5 0.5" margin="0.01"/>
    <motor ctrllimited="true" ctrlrange="-1 1" gear="15"/>
  </default>
  <worldbody>
    <light pos="0 0 20" dir="0.2 0.15 -1" directional="true" diffuse="0.5 0.5 0.5"/>
    <geom name="floor" type="plane" size="40 40 40" conaffinity="1" material="tiles"/>
    <body name="torso" pos="0 0 0.75">
      <geom type="sphere" size="0.25" material="body"/>
      <joint name="root" type="free" armature="0" damping="0" margin="0.01" limited="false"/>{legs}
    </body>{walls}
  </worldbody>
  <actuator>{motors}</actuator>
</mujoco>
"""


def _leg(k: int, name: str, sx: int, sy: int, axis: str, span: str) -> str:
    near, far = f"{0.2 * sx} {0.2 * sy} 0", f"{0.4 * sx} {0.4 * sy} 0"
    link = f'<geom type="capsule" size="0.08" fromto="0 0 0 {near}" material="joint"/>'
    return f"""
      <body name="{name}">{link}
        <body name="aux_{k}" pos="{near}">
          <joint name="hip_{k}" axis="0 0 1" range="-30 30"/>{link}
          <body name="shin_{k}" pos="{near}">
            <joint name="ankle_{k}" axis="{axis}" range="{span}"/>
            <geom type="capsule" size="0.08" fromto="0 0 0 {far}" material="body"/>
          </body>
        </body>
      </body>"""


class AntFourRooms(MujocoTask):
    """The ant of the HAC and HiTS benchmarks in four rooms of 16 m x 16 m with 3 m doorways.

    One control step is 15 Runge-Kutta steps of 20 ms. Actions (8) are motor signals in the order hip_4, ankle_4, hip_1,
    ankle_1, hip_2, ankle_2, hip_3, ankle_3.

    * ``observation``, compact (29): x, y, z, quaternion, hip_1, ankle_1, ... hip_4, ankle_4, then velocities. Paper
      (111): these without x and y, then the external contact wrenches of world and 13 bodies clipped to [-1, 1]; x and
      y are in ``achieved_goal`` alone.
    * Goal (3): torso position. Desired: a room at random, x and y 3 to 6.5 m from the axes, z in [0.45, 0.55]. Success
      within 0.4, 0.4, 0.2 m; 700 steps.
    * Start: in one of the three other rooms, standing still.
    * Subgoals (5): x, y, z (at most 1), v_x, v_y (clipped to +-3 m/s); thresholds 0.4, 0.4, 0.2, 0.8, 0.8.

    Quirks kept: one simulator sub-step at reset. Fixed (unless ``legacy_quirks=True``): the public subgoals read the
    angle of ankle 4 and v_x where v_x and v_y are meant (an index off by one); solver warm start and clock of the
    episode before survive its reset.
    """

    xml: ClassVar[str] = ant_xml()
    frame_skip: ClassVar[int] = 15
    metadata: ClassVar[Plain] = {"render_modes": ["rgb_array", "human"], "render_fps": 10}
    max_episode_steps = 700
    action_bound = (1.0,) * 8
    goal_low = (-10.0,) * 3
    goal_high = (10.0,) * 3
    goal_tolerance = (0.4, 0.4, 0.2)

    def _describe(self) -> tuple[Array, Array, SubgoalSpace]:
        paper = self.layout == "paper"
        goal_scale = np.array([8.0, 8.0, 1.0])
        local_scale = np.concatenate([goal_scale, np.ones(4), np.ones(8), np.full(6, MAX_SPEED), np.full(8, 5.0)])
        bound = np.array([9.5, 9.5, 1.0, MAX_SPEED, MAX_SPEED])
        self.achieved_in_observation = not paper
        local = _paper_local if paper else _compact_local
        first = 14 if self.legacy_quirks else 15
        subgoals = SubgoalSpace(
            low=-bound,
            high=bound,
            thresholds=(0.4, 0.4, 0.2, 0.8, 0.8),
            achieved=functools.partial(_subgoal, local, first),
            local=local,
            local_scale=local_scale,
            names=("x", "y", "z", "ankle_4", "v_x") if self.legacy_quirks else ("x", "y", "z", "v_x", "v_y"),
        )
        scale = np.concatenate([local_scale[2:], np.ones(84)]) if paper else local_scale.copy()
        return scale, goal_scale, subgoals

    def _sample_goal(self) -> Sequence[float]:
        signs = ROOM_SIGNS[int(self.np_random.integers(4))]
        x, y = self.np_random.uniform(3.0, 6.5, size=2) * signs
        return [x, y, self.np_random.uniform(0.45, 0.55)]

    def _sample_start(self) -> tuple[Array, Array]:
        room = (self._room_of_goal() + 1 + int(self.np_random.integers(3))) % 4
        position = self.np_random.uniform(3.0, 6.5, size=2) * ROOM_SIGNS[room]
        return np.array([*position, 0.55, 1.0, 0.0, 0.0, 0.0, *START_JOINTS]), np.zeros(14)

    def _room_of_goal(self) -> int:
        x, y, _ = self._goal_list
        return ROOM_SIGNS.index((1 if x >= 0 else -1, 1 if y >= 0 else -1))

    def _restart(self, state: dict[str, Array]) -> None:
        self._ctrl[:] = 0.0
        super()._restart(state)

    def _observe(self, first: bool) -> tuple[Array, list[float]]:
        achieved = self._qpos[:3].tolist()
        if self.layout == "compact":
            return np.concatenate([self._qpos, self._qvel]), achieved
        mujoco.mj_rnePostConstraint(self.model, self.data)
        wrenches = np.clip(self.data.cfrc_ext[:14], -1.0, 1.0)
        return np.concatenate([self._qpos[2:], self._qvel, wrenches.ravel()]), achieved

    def _make_scene(self, model: mujoco.MjModel) -> Scene:
        return Scene(model, (640, 640), lookat=(0.0, 0.3, 0.0), distance=25.0, azimuth=90.0, elevation=-75.0)

    def _add_markers(self, scene: Scene) -> None:
        scene.add_geom(mujoco.mjtGeom.mjGEOM_BOX, self.goal_tolerance, self._goal, GOAL_RGBA)

    def _draw_subgoal(self, canvas: Canvas, scene: Scene, subgoal: Array) -> None:
        """A ring around the place, and an arrow to where the velocity leads in a second."""
        at = scene.project(subgoal[:3])
        canvas.ring(at, 12.0, SUBGOAL)
        if not self.legacy_quirks:
            ahead = scene.project(subgoal[:3] + np.array([*subgoal[3:], 0.0]))
            canvas.arrow(at, (ahead[0] - at[0], ahead[1] - at[1]), SUBGOAL, 3.0)


def _compact_local(observation: GoalObservation) -> FloatArray:
    return observation["observation"]


def _paper_local(observation: GoalObservation) -> FloatArray:
    return np.concatenate([observation["achieved_goal"][..., :2], observation["observation"][..., :27]], axis=-1)


def _subgoal(
    local: Callable[[GoalObservation], FloatArray], first_velocity: int, observation: GoalObservation
) -> FloatArray:
    subgoal = local(observation)[..., [0, 1, 2, first_velocity, first_velocity + 1]]
    subgoal[..., 2] = np.minimum(subgoal[..., 2], 1.0)
    subgoal[..., 3:] = np.clip(subgoal[..., 3:], -MAX_SPEED, MAX_SPEED)
    return subgoal
