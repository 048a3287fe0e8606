"""A small anti-aliased canvas in NumPy: shapes in world coordinates, text and the overlay that all tasks share."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from .font import text_mask

Point = Sequence[float] | NDArray[np.float64]
Color = tuple[int, int, int]

PAPER: Color = (250, 249, 246)
INK: Color = (43, 48, 58)
STATIC: Color = (173, 179, 189)
LIGHT_STATIC: Color = (222, 225, 230)
BODY: Color = (38, 103, 173)
LIGHT_BODY: Color = (122, 170, 217)
GOAL: Color = (34, 150, 83)
SUBGOAL: Color = (230, 119, 20)
TRIGGER: Color = (150, 80, 180)
WATER: Color = (178, 211, 232)


class Overlay(NamedTuple):
    """What an agent pursues, to be drawn into a picture."""

    subgoal: NDArray[np.float64] | None = None  # task units
    time_left: float | None = None  # remaining share of the time budget, 0 to 1
    text: str | None = None
    steps_left: int | None = None  # the same in environment steps


def in_steps(n: int) -> str:
    """A number of steps in words."""
    return f"{n} step" if n == 1 else f"{n} steps"


class Canvas:
    """A picture that shapes are drawn on, with world coordinates (x right, y up).

    :param width: pixels
    :param height: pixels
    :param left: world x at the left border
    :param bottom: world y at the bottom border
    :param scale: pixels per world unit
    """

    def __init__(self, width: int, height: int, left: float, bottom: float, scale: float) -> None:
        self.pixels: NDArray[np.uint8] = np.empty((height, width, 3), dtype=np.uint8)
        self.pixels[:] = PAPER
        self._left, self._top, self._scale = left, bottom + height / scale, scale

    @classmethod
    def over(cls, picture: NDArray[np.uint8]) -> Canvas:
        """A canvas on an existing picture; world coordinates are pixels with y up."""
        canvas = cls.__new__(cls)
        canvas.pixels = np.ascontiguousarray(picture)
        canvas._left, canvas._top, canvas._scale = 0.0, float(picture.shape[0]), 1.0
        return canvas

    def to_pixel(self, point: Point) -> tuple[float, float]:
        """Pixel coordinates (x right, y down) of a world point."""
        return (point[0] - self._left) * self._scale, (self._top - point[1]) * self._scale

    # -- shapes ----------------------------------------------------------------------------------------------------

    def polygon(self, points: Sequence[Point], color: Color, alpha: float = 1.0) -> None:
        """Fill a convex polygon, corners in either order."""
        corners = np.array([self.to_pixel(point) for point in points])
        edges = np.roll(corners, -1, axis=0) - corners
        area = float(np.sum(corners[:, 0] * np.roll(corners[:, 1], -1) - corners[:, 1] * np.roll(corners[:, 0], -1)))
        normals = np.stack([edges[:, 1], -edges[:, 0]], axis=1) * (1.0 if area > 0 else -1.0)
        normals /= np.maximum(np.linalg.norm(normals, axis=1, keepdims=True), 1e-9)
        window = self._window(corners.min(axis=0), corners.max(axis=0))
        if window is None:
            return
        x, y = _pixel_centres(window)
        distance = np.full((len(y), x.shape[1]), -np.inf)
        for (cx, cy), (nx, ny) in zip(corners, normals, strict=True):
            np.maximum(distance, (x - cx) * nx + (y - cy) * ny, out=distance)
        self._blend(window, distance, color, alpha)

    def box(self, centre: Point, half: Point, color: Color, alpha: float = 1.0, angle: float = 0.0) -> None:
        """Fill a rectangle turned by ``angle`` [rad] about its centre; upright opaque ones snap to pixels."""
        if angle == 0.0 and alpha == 1.0:
            left, top = self.to_pixel((centre[0] - half[0], centre[1] + half[1]))
            right, bottom = self.to_pixel((centre[0] + half[0], centre[1] - half[1]))
            rows, columns = (
                slice(max(round(top), 0), max(round(bottom), 0)),
                slice(max(round(left), 0), max(round(right), 0)),
            )
            self.pixels[rows, columns] = color
            return
        c, s = math.cos(angle), math.sin(angle)
        corners = [(sx * half[0], sy * half[1]) for sx, sy in ((1, 1), (-1, 1), (-1, -1), (1, -1))]
        self.polygon([(centre[0] + c * x - s * y, centre[1] + s * x + c * y) for x, y in corners], color, alpha)

    def circle(self, centre: Point, radius: float, color: Color, alpha: float = 1.0, line: float | None = None) -> None:
        """Fill a circle, or draw its outline ``line`` pixels wide."""
        cx, cy = self.to_pixel(centre)
        r = radius * self._scale
        reach = r + (line or 0.0)
        window = self._window((cx - reach, cy - reach), (cx + reach, cy + reach))
        if window is None:
            return
        x, y = _pixel_centres(window)
        distance = np.sqrt((x - cx) ** 2 + (y - cy) ** 2) - r
        self._blend(window, distance if line is None else np.abs(distance) - line / 2, color, alpha)

    def line(self, start: Point, end: Point, color: Color, width: float = 2.0, alpha: float = 1.0) -> None:
        """Draw a line with round ends, ``width`` pixels wide."""
        a, b = np.array(self.to_pixel(start)), np.array(self.to_pixel(end))
        window = self._window(np.minimum(a, b) - width / 2, np.maximum(a, b) + width / 2)
        if window is None:
            return
        x, y = _pixel_centres(window)
        dx, dy = b - a
        along = np.clip(((x - a[0]) * dx + (y - a[1]) * dy) / max(dx * dx + dy * dy, 1e-9), 0.0, 1.0)
        distance = np.sqrt((x - a[0] - along * dx) ** 2 + (y - a[1] - along * dy) ** 2) - width / 2
        self._blend(window, distance, color, alpha)

    def arrow(self, start: Point, vector: Point, color: Color, width: float = 2.0, alpha: float = 1.0) -> None:
        """Draw an arrow; nothing if it would be shorter than three pixels."""
        length = math.hypot(*vector)
        if length * self._scale < 3.0:
            return
        end = (start[0] + vector[0], start[1] + vector[1])
        head = min(3.5 * width / self._scale, 0.6 * length)
        ux, uy = vector[0] / length * head, vector[1] / length * head
        self.line(start, (end[0] - 0.7 * ux, end[1] - 0.7 * uy), color, width, alpha)
        sides = [(end[0] - ux - 0.5 * k * uy, end[1] - uy + 0.5 * k * ux) for k in (1, -1)]
        self.polygon([end, *sides], color, alpha)

    def outline(self, points: Sequence[Point], color: Color, width: float = 3.0, closed: bool = True) -> None:
        """Draw the border of a shape, or a path, with a light rim that sets it off from whatever lies below."""
        ends = [*points[1:], points[0]] if closed else points[1:]
        for shade, line, alpha in ((PAPER, width + 3.0, 0.8), (color, width, 1.0)):
            for start, end in zip(points, ends, strict=False):
                self.line(start, end, shade, line, alpha)

    def ring(self, centre: Point, radius: float, color: Color, width: float = 3.0) -> None:
        """Draw the border of a circle with a light rim."""
        self.circle(centre, radius, PAPER, 0.8, line=width + 3.0)
        self.circle(centre, radius, color, 1.0, line=width)

    def text(self, x: float, y: float, text: str, color: Color = INK, scale: int = 2) -> None:
        """Write a line with its upper left corner at pixel (x, y); what does not fit is cut off."""
        mask = text_mask(text, scale)
        rows, columns = int(y), int(x)
        target = self.pixels[max(rows, 0) : rows + mask.shape[0], max(columns, 0) : columns + mask.shape[1]]
        target[mask[: target.shape[0], : target.shape[1]]] = color

    # -- the overlay -----------------------------------------------------------------------------------------------

    def _pixel_ring(self, centre: Point, radius: float, line: float, color: Color) -> None:
        """A circle's border around a pixel (y down)."""
        reach = radius + line
        low, high = (centre[0] - reach, centre[1] - reach), (centre[0] + reach, centre[1] + reach)
        window = self._window(low, high)
        if window is not None:
            x, y = _pixel_centres(window)
            distance = np.sqrt((x - centre[0]) ** 2 + (y - centre[1]) ** 2) - radius
            self._blend(window, np.abs(distance) - line / 2, color, 1.0)

    def time_ring(self, centre: Point, radius: float, share: float) -> None:
        """A ring (pixels, y down) of which the remaining share, clockwise up to twelve o'clock, is filled."""
        cx, cy = centre
        reach = radius + 5
        window = self._window((cx - reach, cy - reach), (cx + reach, cy + reach))
        if window is None:
            return
        x, y = _pixel_centres(window)
        distance = np.abs(np.sqrt((x - cx) ** 2 + (y - cy) ** 2) - radius) - 4.0
        self._blend(window, distance, STATIC, 0.6)
        turn = np.arctan2(x - cx, cy - y) / (2 * math.pi) % 1.0
        self._blend(window, np.where(turn <= min(max(share, 0.0), 1.0), distance, 10.0), SUBGOAL, 1.0)

    def overlay(self, title: str, shown: Overlay) -> None:
        """Title, legend, remaining time of the live subgoal and the agent's line of text.

        Goals are filled shapes, subgoals outlines, so that they differ without their colours, too.
        """
        height = self.pixels.shape[0]
        self._panel(0, 0, 24 + 12 * max(len(title), 10), 56 if shown.subgoal is None else 76)
        self.text(12, 12, title)
        self.pixels[35:47, 12:24] = GOAL
        self.text(32, 34, "GOAL")
        if shown.subgoal is not None:
            self._pixel_ring((18, 61), 6.0, 3.0, SUBGOAL)
            self.text(32, 54, "SUBGOAL")
        if shown.time_left is not None:
            self._time_left(shown.time_left, shown.steps_left)
        if shown.text:
            self._panel(0, height - 36, 24 + 12 * len(shown.text), 36)
            self.text(12, height - 26, shown.text)

    def _time_left(self, share: float, steps: int | None) -> None:
        """A ring that empties in the upper right corner, and what it means in words."""
        width = self.pixels.shape[1]
        amount = f"{round(100 * min(max(share, 0.0), 1.0))} %" if steps is None else in_steps(steps)
        reach = 12 * max(len("time left"), len(amount)) + 76
        self._panel(width - reach, 0, reach, 64)
        self.time_ring((width - 32, 32), 18, share)
        for row, label in ((16, "time left"), (36, amount)):
            self.text(width - 64 - 12 * len(label), row, label)

    def _panel(self, x: int, y: int, width: int, height: int) -> None:
        """Lighten a rectangle of pixels so that text on it can be read."""
        target = self.pixels[y : y + height, x : x + width]
        target[:] = 0.35 * target + 0.65 * np.array(PAPER)

    # -- inner workings --------------------------------------------------------------------------------------------

    def _window(self, low: Point | NDArray[np.float64], high: Point | NDArray[np.float64]) -> _Window | None:
        """Rows and columns that a shape between two pixel corners touches; None outside the picture."""
        height, width = self.pixels.shape[:2]
        left, right = max(int(low[0]) - 1, 0), min(int(high[0]) + 2, width)
        top, bottom = max(int(low[1]) - 1, 0), min(int(high[1]) + 2, height)
        return (top, bottom, left, right) if left < right and top < bottom else None

    def _blend(self, window: _Window, distance: NDArray[np.float64], color: Color, alpha: float) -> None:
        """Blend a colour in where the signed distance [pixels] is negative, with one pixel of smooth border."""
        top, bottom, left, right = window
        target = self.pixels[top:bottom, left:right]
        cover = (np.clip(0.5 - distance, 0.0, 1.0) * alpha)[..., None]
        target[:] = target * (1.0 - cover) + np.array(color) * cover + 0.5


_Window = tuple[int, int, int, int]


def _pixel_centres(window: _Window) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    top, bottom, left, right = window
    x, y = np.arange(left, right, dtype=np.float64), np.arange(top, bottom, dtype=np.float64)
    return x[None, :] + 0.5, y[:, None] + 0.5


def with_caption(picture: NDArray[np.uint8], shown: Overlay, goal: NDArray[np.float64]) -> NDArray[np.uint8]:
    """Any environment's picture with a strip below it: remaining time as a bar, subgoal and goal as numbers.

    :param picture: ``(height, width, 3)``
    :param shown: what the agent pursues
    :param goal: the desired goal, task units
    :return: a taller picture
    """
    width = picture.shape[1]
    scale = 2 if width >= 400 else 1
    row = 10 * scale
    strip = Canvas(width, 4 * row + 12, 0.0, 0.0, 1.0)
    lines = [shown.text or "", "time left", f"subgoal {_numbers(shown.subgoal)}", f"goal    {_numbers(goal)}"]
    if shown.time_left is not None:
        lines[1] += f" {in_steps(shown.steps_left or 0)}"
        left, top = 6 * scale * 22, 6 + row
        strip.pixels[top : top + 7 * scale, left : width - 8] = LIGHT_STATIC
        end = left + round(min(max(shown.time_left, 0.0), 1.0) * (width - 8 - left))
        strip.pixels[top : top + 7 * scale, left:end] = SUBGOAL
    most = (width - 16) // (6 * scale)
    for index, line in enumerate(lines):
        if index != 1 or shown.time_left is not None:
            fits = line if len(line) <= most else line[: most - 3] + "..."
            strip.text(8, 6 + index * row, fits, SUBGOAL if index == 2 else GOAL if index == 3 else INK, scale)
    return np.concatenate([picture, strip.pixels])


def _numbers(values: NDArray[np.float64] | None) -> str:
    return "" if values is None else " ".join(f"{value:.2f}" for value in values)
