"""The options of one training episode as bars, from the ``options.csv`` that ``train --trace`` writes."""

from __future__ import annotations

import csv
import io
from collections.abc import Sequence
from html import escape
from pathlib import Path

from sb3_tbc.aliases import Plain
from sb3_tbc.errors import ConfigError
from sb3_tbc.outside import number, one_line
from sb3_tbc.reading import read_text

TRACE = "options.csv"
MOST_BYTES = 2**30
"""Largest trace that is read; a million options have some 60 MB."""
MOST_STEPS = 1e9
MOST = 40
"""Largest number of options drawn; of a longer episode the first ones are shown."""


def last_episode(path: Path) -> list[Plain]:
    """The options of the last whole episode of the first environment in a trace, in order.

    :return: ``time_budget``, ``duration`` (environment steps), ``reached``, ``reason``; empty without a whole episode
    :raises ConfigError: if the file cannot be read or has other columns
    """
    episodes: list[list[Plain]] = []
    open_one: list[Plain] = []
    reader = csv.DictReader(io.StringIO(read_text(path, MOST_BYTES), newline=""))
    try:
        if not {"env", "time_budget", "duration", "reached", "reason", "episode_over"} <= set(reader.fieldnames or ()):
            raise ConfigError(f"{path} is not a trace of options: its columns are {one_line(reader.fieldnames)}")
        for row in reader:
            if row["env"] != "0":
                continue
            open_one.append({
                "time_budget": number(float(row["time_budget"]), "time_budget", 0.0, MOST_STEPS),
                "duration": int(number(int(row["duration"]), "duration", 0.0, MOST_STEPS)),
                "reached": row["reached"] == "1", "reason": row["reason"],
            })  # fmt: skip
            if row["episode_over"] == "1":
                episodes, open_one = [open_one], []
    except ConfigError:
        raise
    except (ValueError, TypeError, KeyError, AttributeError, OverflowError, csv.Error) as error:
        raise ConfigError(f"{path} holds a line that is not an option: {one_line(error)}") from error
    return episodes[-1] if episodes else []


def option_timeline(options: Sequence[Plain], title: str = "") -> str:
    """Options of one episode from top to bottom: the budget as a pale bar, the steps used as a dark one.

    Reached subgoals have a tick at the end of their bar, missed ones a cross, so that no colour is needed.

    :param options: result of :func:`last_episode`
    :param title: title for screen readers
    :return: SVG text
    """
    shown = list(options)[:MOST]
    starts = [sum(o["duration"] for o in shown[:i]) for i in range(len(shown))]
    total = max([s + max(o["duration"], o["time_budget"]) for s, o in zip(starts, shown, strict=True)] or [1])
    height = 14 * len(shown) + 44
    parts = [f'<svg class="timeline" viewBox="0 0 440 {height}" role="img" aria-label="{escape(title, quote=True)}">']
    for index, (start, option) in enumerate(zip(starts, shown, strict=True)):
        y, x, scale = 8 + 14 * index, 34 + 380 * start / total, 380 / total
        kind, sign = ("reached", "&#10003;") if option["reached"] else ("missed", "&#215;")
        said = f"option {index + 1}: {option['duration']} of {option['time_budget']:.4g} steps, "
        said += f"subgoal {'reached' if option['reached'] else 'missed'} ({option['reason']})"
        end = x + max(option["duration"], option["time_budget"]) * scale
        parts.append(
            f'<g class="option {kind}"><title>{escape(said)}</title>'
            f'<text x="28" y="{y + 9}" text-anchor="end">{index + 1}</text>'
            f'<rect class="budget" x="{x:.1f}" y="{y}" width="{option["time_budget"] * scale:.1f}" height="11"/>'
            f'<rect class="used" x="{x:.1f}" y="{y + 3}" width="{option["duration"] * scale:.1f}" height="5"/>'
            f'<text x="{end + 3:.1f}" y="{y + 9}">{sign}</text></g>'
        )
    foot = 8 + 14 * len(shown)
    for quarter in range(5):
        x = 34 + 95 * quarter
        parts.append(f'<text x="{x}" y="{foot + 14}" text-anchor="middle">{total * quarter / 4:.0f}</text>')
    parts.append(f'<text x="224" y="{foot + 30}" text-anchor="middle">environment step of the episode</text></svg>')
    return "\n".join(parts)
