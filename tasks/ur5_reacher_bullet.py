"""UR5ReacherBullet: the arm of UR5Reacher in PyBullet, to test policies in an engine they were not trained in."""

from __future__ import annotations

import contextlib
import os
import tempfile
from collections.abc import Iterator, Sequence
from pathlib import Path
from types import ModuleType
from typing import ClassVar

import numpy as np
from numpy.typing import NDArray

from .base import Array
from .replayed import ReplayedTask
from .ur5_reacher import ArmTask, UR5Reacher

TIME_STEP = 0.002
SUB_STEPS = 15
SERVO_GAIN = 10.0
DAMPING = 10.0
MAX_TORQUE = 150.0
MAX_COMMAND = (3.15, 5.0, 3.15)
Shape = tuple[str, float, float | None, str, str]
"""Kind, radius, length (None for a sphere), place and rotation of a collision shape."""
URDF_LINKS: tuple[
    tuple[str, float, str, tuple[float, float, float], list[Shape]], ...
] = (  # name, mass, centre of mass, diagonal inertia, shapes
    ("base_link", 4.0, "0 0 0", (0.00443333, 0.00443333, 0.0072), [("cylinder", 0.0735, 0.024, "0 0 0.009", "0 0 0")]),
    (
        "shoulder_link",
        3.7,
        "0 0 0",
        (0.0102675, 0.0102675, 0.00666),
        [("cylinder", 0.0595, 0.1336, "0 0 0.0016", "0 0 0")],
    ),
    (
        "upper_arm_link",
        8.393,
        "0 0 0.28",
        (0.226891, 0.226891, 0.0151074),
        [("sphere", 0.0597, None, "0 0 0.425", "0 0 0")],
    ),
    (
        "forearm_link",
        2.275,
        "0 0 0.25",
        (0.0494433, 0.0494433, 0.004095),
        [("capsule", 0.0385, 0.28, "0 0 0.26", "0 0 0")],
    ),
)
URDF_JOINTS = (  # name, origin, rpy, axis
    ("shoulder_pan", "0 0 0.089159", "0 0 0", "0 0 1"),
    ("shoulder_lift", "0 0.13585 0", "0 1.5707963267948966 0", "0 1 0"),
    ("elbow", "0 -0.1197 0.425", "0 0 0", "0 1 0"),
)


class UR5ReacherBullet(ArmTask, ReplayedTask):
    """UR5Reacher with the dynamics of PyBullet; observations, actions, goals and subgoals are the same.

    Links have the same shapes and inertias. The servo torque ``10 (ctrl - qd)`` and the joint damping are computed as
    MuJoCo does, the damping at the velocity that the sub-step will reach, so that off the floor both engines agree
    closely; contacts differ. ``legacy_quirks`` has no effect: no public implementation exists.

    :raises ImportError: without PyBullet, naming the extra that installs it
    """

    _not_copied: ClassVar[tuple[str, ...]] = (*ReplayedTask._not_copied, "_client", "_twin")

    def __init__(
        self, *, observation: str = "paper", legacy_quirks: bool = False, render_mode: str | None = None
    ) -> None:
        self._engine = self._load_engine()
        super().__init__(observation=observation, legacy_quirks=legacy_quirks, render_mode=render_mode)
        self._twin: UR5Reacher | None = None
        self._new_world()

    def _state_shapes(self) -> dict[str, tuple[int, ...]]:
        return {"qpos": (3,), "qvel": (3,)}

    def _load_engine(self) -> ModuleType:
        return load_pybullet()

    def _build(self) -> None:
        """Load floor and arm into a world of their own."""
        bullet = self._engine
        self._client: int = bullet.connect(bullet.DIRECT)
        client = self._client
        bullet.setGravity(0, 0, -9.81, physicsClientId=client)
        bullet.setPhysicsEngineParameter(
            fixedTimeStep=TIME_STEP, deterministicOverlappingPairs=1, physicsClientId=client
        )
        plane = bullet.createCollisionShape(bullet.GEOM_PLANE, physicsClientId=client)
        floor = bullet.createMultiBody(0, plane, physicsClientId=client)
        flags = (
            bullet.URDF_USE_INERTIA_FROM_FILE
            | bullet.URDF_USE_SELF_COLLISION
            | bullet.URDF_USE_SELF_COLLISION_EXCLUDE_PARENT
        )
        with urdf_file() as path:
            self._arm = bullet.loadURDF(path, useFixedBase=True, flags=flags, physicsClientId=client)
        for body, link in ((floor, -1), *((self._arm, link) for link in range(-1, 3))):
            bullet.changeDynamics(
                body, link, linearDamping=0.0, angularDamping=0.0, jointDamping=0.0, lateralFriction=1.0,
                spinningFriction=0.005, restitution=0.0, physicsClientId=client,
            )  # fmt: skip
        # Joints of a loaded model hold their position unless their motors are switched off.
        bullet.setJointMotorControlArray(
            self._arm, range(3), bullet.VELOCITY_CONTROL, forces=[0.0] * 3, physicsClientId=client
        )
        self._pristine: int = bullet.saveState(physicsClientId=client)

    def _restart(self, state: dict[str, Array]) -> None:
        if self._client < 0:  # closed in the meantime
            self._new_world()
        angles, speeds = self._sample_start()
        self._record.clear()  # an episode begins from the world as it was built
        self._start([*state.get("qpos", angles), *state.get("qvel", speeds)])

    def _begin(self, start: list[float]) -> None:
        bullet, client = self._engine, self._client
        bullet.restoreState(self._pristine, physicsClientId=client)
        for joint in range(3):
            bullet.resetJointState(self._arm, joint, start[joint], start[3 + joint], physicsClientId=client)
        self._sub_step([0.0] * 3)

    def _simulate(self, action: list[float]) -> None:
        command = [min(max(a, -limit), limit) for a, limit in zip(action, MAX_COMMAND, strict=True)]
        for _ in range(SUB_STEPS):
            self._sub_step(command)

    def _joints(self) -> tuple[list[float], list[float]]:
        states = self._engine.getJointStates(self._arm, range(3), physicsClientId=self._client)
        return [joint[0] for joint in states], [joint[1] for joint in states]

    def _sub_step(self, command: list[float]) -> None:
        """Advance by 2 ms; solves ``(M + h D) a = servo - D qd - bias`` for the velocity that damping acts on."""
        bullet, client = self._engine, self._client
        angles, speeds = self._joints()
        servo = [min(max(SERVO_GAIN * (u - v), -MAX_TORQUE), MAX_TORQUE) for u, v in zip(command, speeds, strict=True)]
        bias = bullet.calculateInverseDynamics(self._arm, angles, speeds, [0.0] * 3, physicsClientId=client)
        mass = bullet.calculateMassMatrix(self._arm, angles, physicsClientId=client)
        wanted = [t - DAMPING * v - b for t, v, b in zip(servo, speeds, bias, strict=True)]
        acceleration = solve3(mass, TIME_STEP * DAMPING, wanted)
        torque = [t - DAMPING * (v + TIME_STEP * a) for t, v, a in zip(servo, speeds, acceleration, strict=True)]
        bullet.setJointMotorControlArray(
            self._arm, (0, 1, 2), bullet.TORQUE_CONTROL, forces=torque, physicsClientId=client
        )
        bullet.stepSimulation(physicsClientId=client)

    def task_state(self) -> dict[str, Array]:
        """``qpos`` and ``qvel`` of the three joints."""
        angles, speeds = self._joints()
        return {"qpos": np.array(angles), "qvel": np.array(speeds)}

    def _draw(self) -> NDArray[np.uint8]:
        """The same picture as UR5Reacher's, of this engine's state."""
        if self._twin is None:
            self._twin = UR5Reacher(render_mode="rgb_array")
            self._twin._title = type(self).__name__
        twin = self._twin
        twin.reset(options={"goal": self._goal, "state": self.task_state()})
        twin.data.qpos[:] = self.task_state()["qpos"]
        twin._overlay, twin._elapsed = self._overlay, self._elapsed
        return twin._draw()

    def close(self) -> None:
        """Close the window and leave the physics server."""
        super().close()
        if self._twin is not None:
            self._twin.close()
        if self._client >= 0:
            self._engine.disconnect(physicsClientId=self._client)
            self._client = -1


def solve3(matrix: Sequence[Sequence[float]], diagonal: float, right: Sequence[float]) -> tuple[float, float, float]:
    """Solve ``(matrix + diagonal I) x = right`` for a symmetric 3 x 3 matrix; LAPACK from Python is slower."""
    (a, b, c), (_, d, e), (_, _, f) = matrix
    a, d, f = a + diagonal, d + diagonal, f + diagonal
    ca, cb, cc = d * f - e * e, c * e - b * f, b * e - c * d
    cd, ce, cf = a * f - c * c, b * c - a * e, a * d - b * b
    scale = 1.0 / (a * ca + b * cb + c * cc)
    x, y, z = right
    return (ca * x + cb * y + cc * z) * scale, (cb * x + cd * y + ce * z) * scale, (cc * x + ce * y + cf * z) * scale


def load_pybullet() -> ModuleType:
    """Import PyBullet, without the line it prints.

    :raises ImportError: naming the extra that installs it
    """
    try:
        with _silent():
            import pybullet
    except ImportError as error:
        raise ImportError("UR5ReacherBullet needs PyBullet. Install it with: pip install 'sb3_tbc[bullet]'") from error
    module: ModuleType = pybullet
    return module


@contextlib.contextmanager
def _silent() -> Iterator[None]:
    """Send what C code prints nowhere."""
    saved = os.dup(2)
    try:
        with open(os.devnull, "wb") as nowhere:
            os.dup2(nowhere.fileno(), 2)
        yield
    finally:
        os.dup2(saved, 2)
        os.close(saved)


@contextlib.contextmanager
def urdf_file() -> Iterator[str]:
    """The arm as a URDF file that exists inside the ``with`` block; PyBullet reads models from files only."""
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "ur5.urdf"
        path.write_text(urdf())
        yield str(path)


def urdf() -> str:
    """The arm of ``ur5_reacher.MODEL`` in URDF."""
    links = "".join(_link(*link) for link in URDF_LINKS)
    names = [link[0] for link in URDF_LINKS]
    joints = "".join(
        f'<joint name="{name}" type="continuous"><parent link="{parent}"/><child link="{child}"/>'
        f'<origin xyz="{xyz}" rpy="{rpy}"/><axis xyz="{axis}"/><dynamics damping="0" friction="0"/></joint>'
        for (name, xyz, rpy, axis), parent, child in zip(URDF_JOINTS, names[:-1], names[1:], strict=True)
    )
    return f'<robot name="ur5">{links}{joints}</robot>'


def _link(name: str, mass: float, com: str, inertia: tuple[float, ...], shapes: list[Shape]) -> str:
    ixx, iyy, izz = inertia
    collisions = "".join(
        f'<collision><origin xyz="{xyz}" rpy="{rpy}"/><geometry>{_geometry(kind, size, length)}</geometry></collision>'
        for kind, size, length, xyz, rpy in shapes
    )
    return (
        f'<link name="{name}"><inertial><origin xyz="{com}"/><mass value="{mass}"/>'
        f'<inertia ixx="{ixx}" iyy="{iyy}" izz="{izz}" ixy="0" ixz="0" iyz="0"/></inertial>{collisions}</link>'
    )


def _geometry(kind: str, size: float, length: float | None) -> str:
    return f'<{kind} radius="{size}"' + (f' length="{length}"/>' if length is not None else "/>")
