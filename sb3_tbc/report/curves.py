"""Learning curves as inline SVG: every seed's measured points, the mean with its band, the paper's value as a line.

Drawn without a library, so that nothing is resampled, the page works without scripts, and equal runs give equal files.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from html import escape

import numpy as np

from sb3_tbc.report.paper import Paper
from sb3_tbc.report.runs import Run, is_shipped, on_union_of_steps
from sb3_tbc.stats import bootstrap_band

WIDTH, HEIGHT = 440, 290
LEFT, RIGHT, TOP, BOTTOM = 40, 410, 14, 250
LABEL = 10.5  # distance between the labels at the curves' ends
# Blue, vermilion, green, purple of Okabe and Ito: told apart with any common colour blindness.
SHIPPED_COLOURS = {"tbc-hrl": 0, "hits": 1, "hac": 2, "sac": 3}
DASHES = ("", "6 3", "2 2", "8 3 2 3", "10 4", "4 2 1 2", "1 3")


class Style:
    """Colours, dashes and labels of a figure's methods; no two methods have the same combination.

    :param methods: the figure's methods in order
    """

    def __init__(self, methods: Sequence[str]) -> None:
        variants = [method for method in methods if method not in SHIPPED_COLOURS]
        self.label = {method: str(index + 1) for index, method in enumerate(shipped_first(methods))}
        self.colour = {m: f"var(--c{SHIPPED_COLOURS[m]})" for m in methods if m in SHIPPED_COLOURS}
        self.dash = dict.fromkeys(self.colour, "")
        for index, method in enumerate(variants):  # hues a golden angle apart, so that neighbours differ most
            self.colour[method] = f"oklch(var(--variant-light) 0.13 {(40 + 137.508 * index) % 360:.0f})"
            self.dash[method] = DASHES[1 + index % (len(DASHES) - 1)]


def shipped_first(methods: Iterable[str]) -> list[str]:
    """Methods in order, those with shipped settings before the variants."""
    return sorted(methods, key=lambda method: not is_shipped(method))


def figure(task: str, methods: Mapping[str, Sequence[Run]], paper: Paper) -> str:
    """One task's curves; methods without an evaluation are left out, variants are hidden at first.

    :return: SVG text, empty if no method has a curve
    """
    drawn = {method: [run for run in runs if run.rows] for method, runs in methods.items()}
    drawn = {method: runs for method, runs in drawn.items() if runs}
    if not drawn:
        return ""
    last = max(run.rows[-1].timesteps for runs in drawn.values() for run in runs)
    distance = tick_distance(last)
    x_max = -(-last // distance) * distance
    style = Style(list(drawn))
    places = label_places(drawn, x_max)
    parts = [
        f'<svg class="curves" viewBox="0 0 {WIDTH} {HEIGHT}" role="img" data-x-max="{x_max}" '
        f'aria-label="Success rate against environment steps on {escape(task)}">',
        *axes(x_max, distance),
    ]
    said = paper.success(task, "tbc-hrl")
    if said is not None:
        y = y_at(said.mean)
        parts.append(f'<line class="paper" x1="{LEFT}" x2="{RIGHT}" y1="{y:.1f}" y2="{y:.1f}"/>')
    parts += [method_curves(m, runs, x_max, style, places[m]) for m, runs in reversed(drawn.items())]
    return "\n".join([*parts, "</svg>"])


def tick_distance(last: int) -> int:
    """A round distance of ticks, so that an axis up to ``last`` has at most five ticks above zero."""
    power = int(10 ** max(len(str(last)) - 2, 0))
    return next(unit * power for unit in (1, 2, 5, 10, 25, 50, 100) if unit * power * 5 >= last)


def x_at(step: float, x_max: int) -> float:
    """Horizontal place of an environment step."""
    return LEFT + (RIGHT - LEFT) * step / x_max


def y_at(rate: float) -> float:
    """Vertical place of a success rate."""
    return BOTTOM - (BOTTOM - TOP) * rate


def axes(x_max: int, distance: int) -> list[str]:
    """Grid, numbers and names of the axes."""
    parts = ['<g class="axes">']
    for rate in (0.0, 0.25, 0.5, 0.75, 1.0):
        y = y_at(rate)
        parts.append(f'<line x1="{LEFT}" x2="{RIGHT}" y1="{y:.1f}" y2="{y:.1f}"/>')
        parts.append(f'<text x="{LEFT - 5}" y="{y + 4:.1f}" text-anchor="end">{rate:g}</text>')
    for step in range(0, x_max + 1, distance):
        parts.append(f'<text x="{x_at(step, x_max):.1f}" y="{BOTTOM + 15}" text-anchor="middle">{short(step)}</text>')
    middle = (LEFT + RIGHT) // 2
    parts.append(f'<text x="{middle}" y="{BOTTOM + 32}" text-anchor="middle">environment steps</text>')
    turned = f'transform="translate(10 {(TOP + BOTTOM) // 2}) rotate(-90)"'
    parts.append(f'<text {turned} text-anchor="middle">success rate</text>')
    return [*parts, "</g>"]


def short(steps: int) -> str:
    """A number of steps as short text: ``150 k``, ``2.5 M``."""
    if steps >= 1_000_000:
        return f"{steps / 1_000_000:g} M"
    return f"{steps / 1000:g} k" if steps >= 1000 else str(steps)


def method_curves(method: str, runs: Sequence[Run], x_max: int, style: Style, label_y: float) -> str:
    """Band, mean, raw points of every seed and the label of one method."""
    steps, values = on_union_of_steps([run.curve for run in runs])
    low, high = bootstrap_band(values, n_resamples=1000)
    mean = values.mean(axis=0)
    kind = "shipped" if is_shipped(method) else "variant"
    hidden = "" if is_shipped(method) else " hidden"
    name, colour = escape(method, quote=True), style.colour[method]
    parts = [f'<g class="method {kind}{hidden}" data-method="{name}" style="--c:{colour}">']
    if len(runs) > 1 and len(steps):
        edge = [*zip(steps, high, strict=True), *zip(steps[::-1], low[::-1], strict=True)]
        parts.append(f'<polygon class="band" points="{_points(edge, x_max)}"/>')
    for run in runs:
        pairs = list(zip(*run.curve, strict=True))
        dots = "".join(f'<circle cx="{x_at(x, x_max):.1f}" cy="{y_at(y):.1f}"/>' for x, y in pairs)
        parts.append(f'<g class="seed" data-seed="{run.seed}"><polyline points="{_points(pairs, x_max)}"/>{dots}</g>')
    dash = f' stroke-dasharray="{style.dash[method]}"' if style.dash[method] else ""
    ends = list(zip(steps, mean, strict=True))
    if ends:
        parts.append(f'<polyline class="mean"{dash} points="{_points(ends, x_max)}"/>')
        x, y = x_at(ends[-1][0], x_max), y_at(ends[-1][1])
        parts.append(f'<line class="leader" x1="{x:.1f}" y1="{y:.1f}" x2="{RIGHT + 8}" y2="{label_y:.1f}"/>')
    parts.append(f'<text class="label" x="{RIGHT + 10}" y="{label_y + 4:.1f}">{style.label[method]}</text></g>')
    return "".join(parts)


def _points(pairs: Sequence[tuple[float, float]], x_max: int) -> str:
    return " ".join(f"{x_at(x, x_max):.1f},{y_at(y):.1f}" for x, y in pairs)


def label_places(methods: Mapping[str, Sequence[Run]], x_max: int) -> dict[str, float]:
    """Places of the labels at the right border: near the ends of their curves, without overlap, shipped ones first."""
    free = list(np.arange(TOP, BOTTOM + LABEL / 2, LABEL))
    places = {}
    for method in shipped_first(methods):
        curves = [run.curve for run in methods[method]]
        steps, values = on_union_of_steps(curves)
        end = y_at(float(values[:, -1].mean()) if len(steps) else 0.0)
        place = min(free, key=lambda y, end=end: abs(y - end))  # type: ignore[misc]
        if len(free) > 1:
            free.remove(place)
        places[method] = float(place)
    return places
