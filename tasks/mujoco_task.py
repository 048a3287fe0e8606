"""What the MuJoCo tasks share: loading a model, stepping it, starting from a recorded state."""

from __future__ import annotations

from abc import abstractmethod
from collections.abc import Mapping
from typing import ClassVar

import mujoco
import numpy as np
from numpy.typing import NDArray

from .base import Array, GoalTask
from .mujoco_install import check_mujoco
from .mujoco_rendering import Scene
from .rendering import Canvas


class MujocoTask(GoalTask):
    """A goal task whose physics is one MuJoCo model; actions are written to ``ctrl`` and held for a control step.

    A reset draws ``qpos`` and ``qvel`` and then advances the simulator by one sub-step before the first observation,
    as the public benchmark does. Ours starts from a cleared simulator; with ``legacy_quirks=True`` controls, solver
    warm start and clock of the episode before stay, as there.
    """

    xml: ClassVar[str]
    """The model that is stepped."""
    drawn_xml: ClassVar[str | None] = None
    """The model that is drawn: the same joints, with shapes that are only seen and would slow down every step."""
    frame_skip: ClassVar[int]
    dynamics_names: ClassVar[tuple[str, ...]] = ("mass", "damping", "gravity", "friction", "actuator")
    _not_copied: ClassVar[tuple[str, ...]] = ("_viewer", "_scene", "_drawn", "model", "_qpos", "_qvel", "_ctrl")

    def __init__(
        self, *, observation: str = "paper", legacy_quirks: bool = False, render_mode: str | None = None
    ) -> None:
        check_mujoco(mujoco)
        self.data = mujoco.MjData(mujoco.MjModel.from_xml_string(self.xml))
        self._reconnect()
        self._scene: Scene | None = None
        self._title = type(self).__name__
        self._nominal = nominal_fields(self.model)
        super().__init__(observation=observation, legacy_quirks=legacy_quirks, render_mode=render_mode)

    def _reconnect(self) -> None:
        """Take the model and views into the simulator's memory from ``data``, whose copies bring a model of their own.

        The views stay valid for the simulator's lifetime; asking the bindings each step is slower.
        """
        self.model: mujoco.MjModel = self.data.model
        self._qpos: Array = self.data.qpos
        self._qvel: Array = self.data.qvel
        self._ctrl: Array = self.data.ctrl

    @abstractmethod
    def _sample_start(self) -> tuple[Array, Array]:
        """Draw ``qpos`` and ``qvel`` from ``self.np_random``."""

    def _state_shapes(self) -> dict[str, tuple[int, ...]]:
        return {"qpos": (self.model.nq,), "qvel": (self.model.nv,)}

    def _restart(self, state: dict[str, Array]) -> None:
        if not self.legacy_quirks:
            mujoco.mj_resetData(self.model, self.data)
        qpos, qvel = self._sample_start()
        self._qpos[:] = state.get("qpos", qpos)
        self._qvel[:] = state.get("qvel", qvel)
        mujoco.mj_step(self.model, self.data)

    def _advance(self, action: list[float]) -> None:
        self._ctrl[:] = action
        mujoco.mj_step(self.model, self.data, self.frame_skip)

    def task_state(self) -> dict[str, Array]:
        """``qpos`` and ``qvel`` of the model."""
        return {"qpos": self._qpos.copy(), "qvel": self._qvel.copy()}

    def _apply_dynamics(self, scales: dict[str, float]) -> None:
        scale_fields(self.model, self._nominal, scales)

    # -- pictures --------------------------------------------------------------------------------------------------

    def _make_scene(self, model: mujoco.MjModel) -> Scene:
        """The camera on this task.

        :param model: what is to be drawn
        """
        raise NotImplementedError

    def _add_markers(self, scene: Scene) -> None:
        """Add the goal and what else helps to the scene."""

    def _draw_subgoal(self, canvas: Canvas, scene: Scene, subgoal: Array) -> None:
        """Draw the live subgoal over the finished picture, so that nothing hides it."""

    def _draw(self) -> NDArray[np.uint8]:
        if self._scene is None:
            model = self.model if self.drawn_xml is None else mujoco.MjModel.from_xml_string(self.drawn_xml)
            self._scene, self._drawn = self._make_scene(model), mujoco.MjData(model)
        # Drawing works on a copy, because kinematics on the simulator's own data would change what a step returns.
        self._drawn.qpos[:] = self._qpos
        mujoco.mj_kinematics(self._drawn.model, self._drawn)
        self._scene.update(self._drawn)
        self._add_markers(self._scene)
        canvas = Canvas.over(self._scene.picture())
        canvas.overlay(f"{self._title}  step {self._elapsed}", self._overlay)
        if self._overlay.subgoal is not None:
            self._draw_subgoal(canvas, self._scene, self._overlay.subgoal)
        return canvas.pixels

    def close(self) -> None:
        """Close the window and free the OpenGL context."""
        super().close()
        if self._scene is not None:
            self._scene.close()
            self._scene = None


def nominal_fields(model: mujoco.MjModel) -> dict[str, list[Array]]:
    """Copies of the numbers that :func:`scale_fields` changes."""
    return {name: [field.copy() for field in fields] for name, fields in _fields(model).items()}


def scale_fields(model: mujoco.MjModel, nominal: dict[str, list[Array]], scales: Mapping[str, float]) -> None:
    """Set a model's numbers to multiples of their nominal values.

    :param nominal: from :func:`nominal_fields`
    :param scales: factors by name; 1 where absent
    """
    for name, fields in _fields(model).items():
        for field, value in zip(fields, nominal[name], strict=True):
            field[:] = value * scales.get(name, 1.0)
    mujoco.mj_setConst(model, mujoco.MjData(model))


def _fields(model: mujoco.MjModel) -> dict[str, list[Array]]:
    """Views of the model's numbers behind each name of ``dynamics_names``."""
    return {
        "mass": [model.body_mass, model.body_inertia],
        "damping": [model.dof_damping],
        "gravity": [model.opt.gravity],
        "friction": [model.geom_friction[:, :1], model.pair_friction[:, :2]],
        "actuator": [model.actuator_gainprm[:, :1], model.actuator_biasprm[:, :3]],
    }
