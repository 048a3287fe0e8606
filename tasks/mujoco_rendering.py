"""Off-screen pictures of MuJoCo tasks, with ghosts and markers of goals; needs EGL, OSMesa or a display."""

from __future__ import annotations

import atexit
import os
import sys
import warnings
import weakref
from collections.abc import Sequence
from importlib import import_module
from typing import Any

import mujoco
import numpy as np
from numpy.typing import ArrayLike, NDArray

UNTEXTURED = "matid" if hasattr(mujoco.MjvGeom, "matid") else "texid"
"""What says of a shape how it is painted: MuJoCo before 3.2 names a texture, later ones a material; -1 is neither."""

GOAL_RGBA = (0.13, 0.59, 0.33, 0.45)

ASSETS = """
  <visual>
    <headlight ambient="0.6 0.6 0.6" diffuse="0.25 0.25 0.25" specular="0.1 0.1 0.1"/>
    <quality offsamples="4"/>
    <map znear="0.01"/>
  </visual>
  <asset>
    <texture type="skybox" builtin="gradient" rgb1="0.98 0.98 0.97" rgb2="0.80 0.85 0.90" width="64" height="384"/>
    <texture name="tiles" type="2d" builtin="checker" rgb1=".93 .93 .92" rgb2=".86 .87 .88" width="64" height="64"/>
    <material name="tiles" texture="tiles" texrepeat="1 1" texuniform="true" specular="0"/>
    <material name="wall" rgba="0.68 0.70 0.74 1"/>
    <material name="body" rgba="0.15 0.40 0.68 1" specular="0.4" shininess="0.5"/>
    <material name="joint" rgba="0.17 0.19 0.23 1" specular="0.4" shininess="0.5"/>
  </asset>
"""
"""Lights and colours for a model; they do not touch its physics."""


class GLUnavailable(RuntimeError):
    """No way to draw with OpenGL; the message says what to install."""


def _open_context(model: mujoco.MjModel, width: int, height: int) -> tuple[Any, mujoco.MjrContext]:
    """The first OpenGL context that works: the one named by MUJOCO_GL, or EGL, OSMesa, GLFW in this order."""
    named = os.environ.get("MUJOCO_GL", "").lower().strip()
    kinds = [named] if named in ("egl", "osmesa", "glfw", "cgl") else ["egl", "osmesa", "glfw"]
    failures, chosen = [], "PYOPENGL_PLATFORM" in os.environ
    for kind in kinds:
        try:
            with warnings.catch_warnings():
                warnings.simplefilter("ignore")  # GLFW says by warnings that there is no display
                context = import_module(f"mujoco.{kind}").GLContext(width, height)
                context.make_current()
            return context, mujoco.MjrContext(model, mujoco.mjtFontScale.mjFONTSCALE_100.value)
        except Exception as error:  # Each backend fails with errors of its own library.
            failures.append(f"{kind}: {type(error).__name__}: {error}".splitlines()[0])
            if not chosen:
                _forget_pyopengl()
    raise GLUnavailable(
        "Drawing this task needs OpenGL, and no backend works here. Install one, e.g. `apt-get install libegl1 "
        "libgl1-mesa-dri` (EGL) or `apt-get install libosmesa6` (software, with MUJOCO_GL=osmesa set before Python "
        f"starts). Tried {'; '.join(failures)}"
    )


def _forget_pyopengl() -> None:
    """Make PyOpenGL be imported again, because it keeps the backend that it found first, even one that failed."""
    os.environ.pop("PYOPENGL_PLATFORM", None)
    backends = ("mujoco.egl", "mujoco.osmesa")
    for name in list(sys.modules):
        if name.partition(".")[0] == "OpenGL" or name.startswith(backends):
            del sys.modules[name]


def _release(gl: Any, context: mujoco.MjrContext) -> None:
    gl.make_current()  # a context frees its objects by number, in whichever context is current
    context.free()
    gl.free()


class Scene:
    """Draws a model from a fixed camera.

    :param model: the task's model
    :param size: width and height, pixels
    :param lookat: the point in the middle of the picture
    :param distance: of the camera from it, metres
    :param azimuth: degrees
    :param elevation: degrees, negative looks down
    :raises GLUnavailable: without OpenGL
    """

    def __init__(
        self,
        model: mujoco.MjModel,
        size: tuple[int, int],
        lookat: Sequence[float],
        distance: float,
        azimuth: float,
        elevation: float,
    ) -> None:
        self.model, (width, height) = model, size
        model.vis.global_.offwidth, model.vis.global_.offheight = width, height
        self._gl, self._context = _open_context(model, width, height)
        self.close = weakref.finalize(self, _release, self._gl, self._context)
        """Free the OpenGL context; also called when the scene is deleted, at the latest when Python ends."""
        self.close.atexit = False
        atexit.register(self.close)  # weakref's own hook may run only after EGL has ended
        mujoco.mjr_setBuffer(mujoco.mjtFramebuffer.mjFB_OFFSCREEN.value, self._context)
        self._viewport = mujoco.MjrRect(0, 0, width, height)
        self.scene = mujoco.MjvScene(model, maxgeom=400)
        # Without a graphics card shadows take five times as long as all the rest.
        self.scene.flags[mujoco.mjtRndFlag.mjRND_SHADOW.value] = 0
        self._camera = mujoco.MjvCamera()
        self._camera.lookat[:] = lookat
        self._camera.distance, self._camera.azimuth, self._camera.elevation = distance, azimuth, elevation
        self._option, self._perturb = mujoco.MjvOption(), mujoco.MjvPerturb()
        self._ghost_data = mujoco.MjData(model)

    def update(self, data: mujoco.MjData) -> None:
        """Show the present poses; removes ghosts and markers."""
        everything = mujoco.mjtCatBit.mjCAT_ALL.value
        mujoco.mjv_updateScene(self.model, data, self._option, self._perturb, self._camera, everything, self.scene)

    def add_ghost(self, qpos: ArrayLike, rgba: Sequence[float], without: Sequence[int] = ()) -> None:
        """Add the moving bodies in another configuration, in one translucent colour.

        :param without: geoms to leave out, because they would coincide with the real ones
        """
        ghost, first = self._ghost_data, self.scene.ngeom
        ghost.qpos[:] = qpos
        mujoco.mj_kinematics(self.model, ghost)
        dynamic = mujoco.mjtCatBit.mjCAT_DYNAMIC.value
        mujoco.mjv_addGeoms(self.model, ghost, self._option, self._perturb, dynamic, self.scene)
        for geom in self.scene.geoms[first : self.scene.ngeom]:
            geom.rgba[:] = (0.0, 0.0, 0.0, 0.0) if geom.objid in without else rgba
            setattr(geom, UNTEXTURED, -1)

    def add_geom(self, kind: mujoco.mjtGeom, size: ArrayLike, position: ArrayLike, rgba: Sequence[float]) -> None:
        """Add a free-standing shape (a ``mujoco.mjtGeom``) of half-sizes ``size``."""
        geom = self.scene.geoms[self.scene.ngeom]
        self.scene.ngeom += 1
        mujoco.mjv_initGeom(
            geom, kind.value, np.array(size, float), np.array(position, float), np.eye(3).ravel(), np.array(rgba, "f4")
        )

    def project(self, point: ArrayLike) -> tuple[float, float]:
        """Where a point of the world appears: pixels from the left and from the bottom of the picture."""
        left, right = self.scene.camera
        forward, up = np.array(left.forward, float), np.array(left.up, float)
        seen = np.array(point, float) - 0.5 * (np.array(left.pos, float) + np.array(right.pos, float))
        scale = 0.5 * self._viewport.height * left.frustum_near / left.frustum_top / max(seen @ forward, 1e-6)
        x, y = seen @ np.cross(forward, up), seen @ up
        return 0.5 * self._viewport.width + scale * x, 0.5 * self._viewport.height + scale * y

    def places(self, qpos: ArrayLike, on_bodies: Sequence[tuple[str, ArrayLike]]) -> list[NDArray[np.float64]]:
        """World positions in another configuration.

        :param on_bodies: names of bodies, and points in their frames
        """
        ghost = self._ghost_data
        ghost.qpos[:] = qpos
        mujoco.mj_kinematics(self.model, ghost)
        bodies = [(ghost.body(name), np.array(point, float)) for name, point in on_bodies]
        return [body.xpos + body.xmat.reshape(3, 3) @ point for body, point in bodies]

    def picture(self) -> NDArray[np.uint8]:
        """Render, ``(height, width, 3)``."""
        self._gl.make_current()
        mujoco.mjr_render(self._viewport, self.scene, self._context)
        pixels = np.empty((self._viewport.height, self._viewport.width, 3), dtype=np.uint8)
        mujoco.mjr_readPixels(pixels, None, self._viewport, self._context)
        return np.ascontiguousarray(pixels[::-1])
