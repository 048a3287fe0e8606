"""The bodies, joints and contacts behind Tennis2D, with roboball2d's numbers."""

from __future__ import annotations

import functools
import math
from collections.abc import Sequence
from types import ModuleType
from typing import Any

from .box2d import box_fixture, circle_fixture

ROBOT_X = 1.0
ROD_HALF, RACKET_HALF = (0.025, 0.25), (0.25, 0.015)
BALL_RADIUS = 0.05
MAX_TORQUE = (0.14, 0.07, 0.03)
JOINT_LIMIT = (0.7 * math.pi, 0.7 * math.pi, 0.3 * math.pi)
START_ANGLES = (0.25 * math.pi, -0.5 * math.pi, 0.0)
MOTOR_SPEED = 200.0
DRAG = 5e-7


def clip_unit(value: float) -> float:
    """The value, at least -1 and at most 1."""
    return min(max(value, -1.0), 1.0)


class TennisWorld:
    """A Box2D world with ground, ball and the three-link arm.

    ``floor_contact``, ``racket_contact`` and ``floor_contact_x`` tell what the ball touched in the last step.

    :param b2: the Box2D module
    :param mass: factor on the mass of rods and racket
    :param damping: factor on their damping
    :param gravity: factor on gravity
    :param actuator: factor on the torques
    """

    def __init__(
        self, b2: ModuleType, mass: float = 1.0, damping: float = 1.0, gravity: float = 1.0, actuator: float = 1.0
    ) -> None:
        self._torques = [limit * actuator for limit in MAX_TORQUE]
        self.floor_contact = self.racket_contact = False
        self.floor_contact_x = math.nan
        self.world = world = b2.b2World(gravity=(0, -8.0 * gravity))
        self.ground = world.CreateStaticBody(position=(3, -10), fixtures=box_fixture(12, 10))
        ball = circle_fixture(BALL_RADIUS, density=0.01, restitution=0.9, groupIndex=-1)
        self.ball = world.CreateDynamicBody(position=(6, 1), fixtures=ball, bullet=True)
        self.links, self.joints = self._add_arm(damping)
        if mass != 1.0:
            for link in self.links:
                link.fixtures[0].density *= mass
                link.ResetMassData()
        # The world keeps no reference to its listener.
        self._listener = world.contactListener = _listener_class(b2)(self)

    def _add_arm(self, damping: float) -> tuple[list[Any], list[Any]]:
        rod = box_fixture(*ROD_HALF, density=0.1, restitution=0.0, groupIndex=-1)
        racket = box_fixture(*RACKET_HALF, density=0.1, restitution=0.75, groupIndex=0)
        links = [
            self.world.CreateDynamicBody(
                position=(ROBOT_X, y), linearDamping=0.1 * damping, angularDamping=4.4 * damping, fixtures=fixture
            )
            for fixture, y in ((rod, 0.25), (rod, 0.75), (racket, 1.015))
        ]
        joints = [
            self.world.CreateRevoluteJoint(
                bodyA=lower,
                bodyB=upper,
                anchor=(ROBOT_X, y),
                lowerAngle=-limit,
                upperAngle=limit,
                enableLimit=True,
                enableMotor=True,
                collideConnected=False,
            )
            for lower, upper, y, limit in zip((self.ground, *links), links, (0.0, 0.5, 1.0), JOINT_LIMIT, strict=False)
        ]
        return links, joints

    def restart(self, shot: Sequence[float], spin: float | None) -> None:
        """Put the arm into its start pose and the ball at the gun.

        :param shot: x, y, angle, v_x, v_y of the ball
        :param spin: its angular velocity; ``None`` leaves it as it is
        """
        x, y, angle = ROBOT_X, 0.0, 0.0
        for link, joint, turn, half in zip(
            self.links, self.joints, START_ANGLES, (ROD_HALF, ROD_HALF, RACKET_HALF), strict=True
        ):
            angle += turn
            dx, dy = -math.sin(angle) * half[1], math.cos(angle) * half[1]
            link.position, link.angle = (x + dx, y + dy), angle
            link.linearVelocity, link.angularVelocity = (0.0, 0.0), 0.0
            joint.motorSpeed, joint.maxMotorTorque = 0.0, 0.0
            x, y = x + 2 * dx, y + 2 * dy
        self.ball.position, self.ball.angle = (shot[0], shot[1]), shot[2]
        self.ball.linearVelocity = (shot[3], shot[4])
        if spin is not None:
            self.ball.angularVelocity = spin
        self._forget_contacts()

    def _forget_contacts(self) -> None:
        self.floor_contact = self.racket_contact = False
        self.floor_contact_x = math.nan

    def step(self, action: Sequence[float], dt: float) -> None:
        """Advance by ``dt`` seconds with torques given as shares of their maxima."""
        self._forget_contacts()
        for joint, share, limit in zip(self.joints, action, self._torques, strict=True):
            torque = share * limit
            joint.motorSpeed = math.copysign(MOTOR_SPEED, torque) if torque else 0.0
            joint.maxMotorTorque = min(abs(torque), limit)
        vx, vy = self.ball.linearVelocity
        drag = -DRAG * math.sqrt(vx * vx + vy * vy)
        self.ball.ApplyForceToCenter((drag * vx, drag * vy), True)
        self.world.Step(dt, 10, 8)
        self.world.ClearForces()

    def touched(self, one: object, other: object) -> None:
        """Note a contact that began in this step."""
        pair = (one, other)
        if self.ball not in pair:
            return
        if self.ground in pair:
            self.floor_contact, self.floor_contact_x = True, self.ball.position[0]
        elif self.links[2] in pair:
            self.racket_contact = True


@functools.cache
def _listener_class(b2: ModuleType) -> type:
    class Listener(b2.b2ContactListener):  # type: ignore[misc, name-defined]
        def __init__(self, arena: TennisWorld) -> None:
            super().__init__()
            self.arena = arena

        def BeginContact(self, contact: Any) -> None:
            self.arena.touched(contact.fixtureA.body, contact.fixtureB.body)

    return Listener
