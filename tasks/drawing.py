"""Pictures of the planar tasks; none needs OpenGL.

Desired goals are filled and green. Live subgoals are orange outlines, drawn last, so that nothing hides them.
"""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from .base import Array
from .rendering import BODY, GOAL, INK, LIGHT_BODY, LIGHT_STATIC, STATIC, SUBGOAL, TRIGGER, WATER, Canvas, Overlay

Picture = NDArray[np.uint8]


def draw_pendulum(angle: float, speed: float, goal: Array, overlay: Overlay, step: int) -> Picture:
    """Pole, ghosts of desired goal and live subgoal, and below them a scale of angular velocities."""
    canvas = Canvas(640, 480, -1.28, -0.86, 250.0)
    subgoal = overlay.subgoal
    canvas.line((-0.9, 0.0), (0.9, 0.0), STATIC, 2.0)
    end = _tip(goal[0])
    canvas.line((0, 0), end, GOAL, 7.0, 0.55)
    canvas.box(end, (0.05, 0.05), GOAL, 0.75, -goal[0])
    end = _tip(angle)
    canvas.line((0, 0), end, INK, 6.0)
    canvas.circle(end, 0.05, BODY)
    canvas.circle((0, 0), 0.022, INK)
    _speed_scale(canvas, speed, goal[1], None if subgoal is None else subgoal[1])
    canvas.overlay(f"Pendulum  step {step}", overlay)
    if subgoal is not None:
        canvas.outline([(0, 0), _tip(subgoal[0], 0.44)], SUBGOAL, closed=False)
        canvas.ring(_tip(subgoal[0]), 0.06, SUBGOAL)
    return canvas.pixels


def _tip(angle: float, length: float = 0.5) -> tuple[float, float]:
    """Where a pole of this angle ends."""
    return length * math.sin(angle), length * math.cos(angle)


def _speed_scale(canvas: Canvas, speed: float, goal: float, subgoal: float | None) -> None:
    y, reach, most = -0.7, 0.9, 15.0
    canvas.line((-reach, y), (reach, y), STATIC, 3.0)
    for tick in (-most, 0.0, most):
        canvas.line((tick / most * reach, y - 0.025), (tick / most * reach, y + 0.025), STATIC, 2.0)
    for x, label in ((-reach, "-15"), (0.0, "velocity, rad/s"), (reach, "+15")):
        column, row = canvas.to_pixel((x, y))
        canvas.text(column - 6 * len(label), row - 30, label)
    x_goal, x_now = (min(max(value / most, -1.1), 1.1) * reach for value in (goal, speed))
    canvas.box((x_goal, y), (0.035, 0.035), GOAL, 0.9)
    canvas.circle((x_now, y), 0.024, BODY, 0.9)
    if subgoal is not None:
        canvas.ring((min(max(subgoal / most, -1.1), 1.1) * reach, y), 0.036, SUBGOAL)


def draw_drawbridge(
    position: float, speed: float, sails: float, angle: float, goal: float, overlay: Overlay, step: int
) -> Picture:
    """Side view of the canal: ship with its sail, bridge leaf turned by its angle, stretch that counts as arrived."""
    canvas = Canvas(800, 360, -0.9, -1.7, 70.0)
    canvas.box((5.0, -1.2), (7.0, 1.2), WATER)
    goal_position = (goal + 1.0) * 5.0
    canvas.box((goal_position, -0.06), (0.5, 0.06), GOAL, 0.9)
    canvas.line((goal_position, 0.0), (goal_position, 1.5), GOAL, 3.0)
    canvas.polygon([(goal_position, 1.5), (goal_position, 1.1), (goal_position + 0.5, 1.3)], GOAL)
    _bridge(canvas, angle)
    _ship(canvas, position, speed, sails)
    canvas.overlay(f"Drawbridge  step {step}", overlay)
    if overlay.subgoal is not None:
        at, v, sail = overlay.subgoal
        _ship_outline(canvas, (at + 1.0) * 5.0, v * 0.03, (sail + 1.0) / 2.0)
    return canvas.pixels


def _bridge(canvas: Canvas, angle: float) -> None:
    """A closed leaf ends where the mast of a ship with its bow at 4.3 stands."""
    turn = math.radians(-angle)
    hinge, length = (4.85, 0.75), 0.93
    canvas.box((hinge[0] + 0.1, -0.45), (0.1, 1.25), STATIC)
    canvas.line(hinge, (hinge[0] - length * math.cos(turn), hinge[1] + length * math.sin(turn)), INK, 9.0)
    state = "open" if angle <= -25.0 else "closed"
    canvas.text(*canvas.to_pixel((3.6, 2.6)), f"bridge {state} {abs(angle):.0f} deg")


def _ship(canvas: Canvas, x: float, speed: float, sails: float) -> None:
    hull, mast, cloth = _ship_parts(x, sails)
    canvas.polygon(hull, INK)
    canvas.line(mast[0], mast[1], INK, 3.0)
    if cloth:
        canvas.polygon(cloth, BODY)
    canvas.arrow((x - 0.35, -0.4), (speed / 0.03, 0.0), BODY, 3.0)


def _ship_outline(canvas: Canvas, x: float, speed: float, sails: float) -> None:
    hull, mast, cloth = _ship_parts(x, sails)
    canvas.outline(mast, SUBGOAL, closed=False)
    for part in (hull, cloth):
        if part:
            canvas.outline(part, SUBGOAL)
    canvas.arrow((x - 0.35, -0.65), (speed / 0.03, 0.0), SUBGOAL, 3.0)


def _ship_parts(x: float, sails: float) -> tuple[list[tuple[float, float]], ...]:
    """Corners of hull, mast and sail; the bow, not the middle, is where the ship is."""
    hull = [(x - 0.75, 0.16), (x, 0.16), (x - 0.15, -0.16), (x - 0.62, -0.16)]
    mast = [(x - 0.4, 0.1), (x - 0.4, 1.25)]
    cloth = [(x - 0.36, 1.2), (x - 0.36, 1.2 - 0.9 * sails), (x + 0.12, 1.2 - 0.9 * sails)]
    return hull, mast, cloth if sails > 0.01 else []


def draw_platforms(state: dict[str, Array], statics: Sequence, goal: Array, overlay: Overlay) -> Picture:  # type: ignore[type-arg]
    """The level: ball with spin mark and velocity, platforms, trigger with its clock, target zone, goal, subgoal."""
    canvas = Canvas(640, 560, -1.1, -1.12, 291.0)
    for centre, (width, height) in statics:
        canvas.box(centre, (width / 2, height / 2), STATIC)
    canvas.box((-0.5, 0.405), (0.15, 0.006), GOAL, 0.9)  # where desired goals lie
    canvas.box(goal, (0.05, 0.05), GOAL)
    for name in ("platform0", "platform1"):
        canvas.box(state[name][:2], (0.25, 0.05), LIGHT_BODY)
        canvas.arrow(state[name][:2], 0.2 * state[name][2:], INK, 2.0)
    active, since = state["trigger"]
    canvas.box((0.0, -0.55), (0.05, 0.05), TRIGGER, 0.9 if active else 0.35)
    if active:
        left = 1.0 - since / 188.5
        canvas.box((0.0, -0.69), (0.15, 0.012), LIGHT_STATIC)
        canvas.box((-0.15 + 0.15 * left, -0.69), (0.15 * left, 0.012), TRIGGER)
    x, row = canvas.to_pixel((-0.145, -0.62))
    canvas.text(x, row, "trigger")
    ball, angle = state["ball_pos"], state["ball_angle"][0]
    canvas.circle(ball, 0.05, BODY)
    canvas.line(ball, ball + 0.04 * np.array([math.cos(angle), math.sin(angle)]), (255, 255, 255), 2.0)
    canvas.arrow(ball, 0.3 * state["ball_linvel"], INK, 2.5)
    canvas.overlay(f"Platforms  step {state['current_step'][0]:.0f}", overlay)
    if overlay.subgoal is not None:
        canvas.ring(overlay.subgoal[:2], 0.06, SUBGOAL)
        canvas.arrow(overlay.subgoal[:2], 0.3 * overlay.subgoal[2:], SUBGOAL, 3.0)
    return canvas.pixels


def draw_tennis(
    state: dict[str, Array], halves: Sequence[tuple[float, float]], goal: Array, overlay: Overlay, step: int
) -> Picture:
    """Arm, ball and gun, the target zone on the floor, and the subgoal as a ghost of the arm."""
    canvas = Canvas(800, 400, -1.15, -0.55, 107.0)
    canvas.box((3.0, -1.0), (12.0, 1.0), STATIC)
    landing = 3.0 + 3.0 * goal[0]
    canvas.box((landing, -0.05), (0.4, 0.05), GOAL)
    canvas.line((landing, -0.1), (landing, 0.14), GOAL, 3.0)
    for name, half in zip(("rod0", "rod1", "racket"), halves, strict=True):
        x, y, angle = state[name][:3]
        canvas.box((x, y), half, INK if name != "racket" else BODY, angle=angle)
    for name, half in zip(("rod0", "rod1"), halves, strict=False):
        x, y, angle = state[name][:3]
        canvas.circle((x + half[1] * math.sin(angle), y - half[1] * math.cos(angle)), 0.04, STATIC)
    canvas.box((6.13, 1.2), (0.1, 0.08), INK)
    canvas.text(*canvas.to_pixel((5.92, 1.46)), "gun")
    ball = state["ball"]
    canvas.circle(ball[:2], 0.05, TRIGGER)
    canvas.arrow(ball[:2], 0.06 * ball[3:5], TRIGGER, 2.0, 0.6)
    bounces = state["contact"][3]
    canvas.text(12, 80, f"bounces {bounces:.0f}")
    canvas.overlay(f"Tennis2D  step {step}", overlay)
    if overlay.subgoal is not None:
        _arm_outline(canvas, overlay.subgoal[0::2] * np.array([2.85884931, 2.85884931, 1.22522113]), halves)
    return canvas.pixels


def _arm_outline(canvas: Canvas, angles: Array, halves: Sequence[tuple[float, float]]) -> None:
    x, y, angle = 1.0, 0.0, 0.0
    for turn, half in zip(angles, halves, strict=True):
        angle += turn
        dx, dy = -math.sin(angle) * half[1], math.cos(angle) * half[1]
        wide, tall = max(half[0], 0.03), max(half[1], 0.03)
        c, sine = math.cos(angle), math.sin(angle)
        corners = ((wide, tall), (-wide, tall), (-wide, -tall), (wide, -tall))
        canvas.outline([(x + dx + c * u - sine * v, y + dy + sine * u + c * v) for u, v in corners], SUBGOAL, 2.5)
        x, y = x + 2 * dx, y + 2 * dy
