"""The live page: one self-contained HTML file in which the agent's circuit runs."""

from __future__ import annotations

import base64
import html
import json
from collections.abc import Mapping, Sequence
from importlib import resources
from typing import Any

import numpy as np

from sb3_tbc.aliases import Plain, PlainMapping
from sb3_tbc.arrays import FloatArray
from sb3_tbc.export.policy import MLP, ExportedPolicy, extract
from sb3_tbc.interpret.episodes import HeldOutEpisodes, Trace
from sb3_tbc.interpret.features import SPACES, TaskSpace, places_of
from sb3_tbc.interpret.findings import Findings
from sb3_tbc.interpret.names import action_names, input_names
from sb3_tbc.interpret.recording import recorded_starts
from sb3_tbc.interpret.text import figure_rows
from sb3_tbc.tbc_hrl import TBCHRL

SCRIPTS = ("circuit", "policy", "pendulum", "drawbridge", "recorded", "pen", "diagram", "app")
SIMULATED: dict[str, tuple[Plain, ...]] = {
    "Pendulum": ({}, {"observation": "compact"}, {"observation": "paper"}),
    "Drawbridge": ({"observation": "compact"},),
}
"""Tasks that the page can simulate, each with the arguments of the variants that it simulates."""
MOST_BYTES = 2_900_000
"""Most bytes of a page; episodes get what the rest leaves."""
STEPS_PER_SECOND = {"Pendulum": 50, "Drawbridge": 100, "AntFourRooms": 10, "UR5Reacher": 33}
N_STARTS = 5


def live_page(
    model: TBCHRL, found: Findings, space: TaskSpace, episodes: HeldOutEpisodes, info: PlainMapping, picture: bytes
) -> str:
    """The page.

    :param model: the agent
    :param found: what was measured
    :param space: of the task
    :param episodes: the held-out ones, for starts and recordings
    :param info: what the agent is
    :param picture: activation in space, PNG
    :raises ConfigError: if the agent cannot be put into numbers, saying why
    """
    data = page_data(model, found, space, info)
    circuit = found.kind == "circuit"
    parts = {
        "title": html.escape(f"Inside a {info['algo']} agent: {found.task}"),
        "subtitle": html.escape(
            f"{len(found.units.names)} {'neurons' if circuit else 'hidden units'} steer; "
            f"success {found.success:.2f} on {len(found.traces)} held-out episodes"
        ),
        "diagram": "The circuit" if circuit else "The network (an MLP: its hidden units)",
        "caption": "Each panel is a neuron: its potential along trajectories of held-out episodes, blue low, red high.",
        "how": html.escape(_how(found, bool(data["live"]))),
        "measures": measures(found),
        "picture": base64.b64encode(picture).decode(),
        "style": _asset("style.css"),
        "script": "\n".join(_asset(f"{name}.js") for name in SCRIPTS),
    }
    page = _asset("page.html")
    for name, text in parts.items():
        page = page.replace(f"@@{name}@@", text)
    room = MOST_BYTES - len(page.encode()) - len(_json(data))
    starts = _starts(model, found, space, episodes, bool(data["live"]), room)
    return page.replace("@@data@@", _json(data | {"starts": starts}))


def _json(data: Plain) -> str:
    return json.dumps(data, separators=(",", ":")).replace("<", "\\u003c")


def _starts(
    model: TBCHRL, found: Findings, space: TaskSpace, episodes: HeldOutEpisodes, live: bool, room: int
) -> list[Plain]:
    if live:
        return live_starts(episodes, found.traces)
    return recorded_starts(model, found.units, episodes, found.traces, space, _order(found), _means(found), room)


def _order(found: Findings) -> list[int]:
    """Units, the most active first."""
    order: list[int] = np.argsort(-found.activity).tolist()
    return order


def _means(found: Findings) -> FloatArray:
    """Mean activation of each unit, ``(N,)``."""
    means: FloatArray = np.concatenate([t.activations for t in found.traces]).mean(axis=0).astype(np.float64)
    return means


def page_data(model: TBCHRL, found: Findings, space: TaskSpace, info: PlainMapping) -> Plain:
    """All numbers of the page but those of its episodes."""
    policy, units = extract(model, found.task), found.units
    simulated = space == SPACES.get(found.task) and dict(info["env_kwargs"]) in SIMULATED.get(found.task, ())
    live = found.task if simulated else None
    alone = [r for r in found.lesions if r.what == "alone"]
    return {
        "live": live,
        "policy": plain_policy(policy),
        "max_options": model.rules.max_options,
        "names": list(units.names),
        "layers": [{"name": name, "start": part.start, "stop": part.stop} for name, part in units.layers.items()],
        "inputs": list(input_names(found.task, model.views)),
        "input_scale": model.views.low_scale().tolist(),
        "actions": list(action_names(found.task, len(policy.action_low))),
        "readout": _plain(_readout(policy, len(units.names))),
        "subgoal_names": list(model.views.subgoals.names),
        "rest": _plain(units.rest),
        "mean": _plain(_means(found)),
        "recorded_form": "mean",
        "most_active": _order(found)[0],
        "n_episodes": len(found.traces),
        "alone": [{"unit": r.units[0], "clamped_to": r.clamped_to, "success_rate": r.success_rate} for r in alone],
        "steps_per_second": STEPS_PER_SECOND.get(found.task, 60),
        "space_labels": list(space.labels),
        "space_bounds": _bounds(found.traces, space, model),
    }


def live_starts(episodes: HeldOutEpisodes, traces: Sequence[Trace]) -> list[Plain]:
    """Where the first held-out episodes start, and how Python saw them end."""
    env, starts = episodes.make_env(), []
    for k, trace in enumerate(traces[:N_STARTS]):
        observation, _ = env.reset(seed=episodes.seed + k)
        task: Any = env.unwrapped
        state = {name: value.tolist() for name, value in task.task_state().items()}
        starts.append({
            "label": f"held-out {k}", "state": state, "goal": observation["desired_goal"].tolist(),
            "success": trace.episode.success, "length": trace.episode.length,
        })  # fmt: skip
    env.close()
    return starts


def plain_policy(policy: ExportedPolicy) -> Plain:
    """An exported policy as JSON's own types; infinite bounds become null."""
    plain = {name: _plain(value) for name, value in policy.plain().items()}
    plain["achieved"] = [_plain(c._asdict()) for c in policy.achieved]
    plain["low"].pop("order", None)
    return plain


def measures(found: Findings) -> str:
    """Tables of the figures and of the lesions of single units."""
    rows = [f"<div class=scroll>{_table(figure_rows(found))}</div>"]
    single: dict[str, dict[str, str]] = {}
    for r in found.lesions:
        if r.what in ("alone", "unread"):
            key = r.what if r.what == "unread" else r.clamped_to
            single.setdefault(r.units[0], {})[key] = f"{r.success_rate:.2f}"
    head = ("one lesion at a time: success", "clamped to rest", "clamped to its mean", "not read, still passing on")
    cells = [(name, *(row.get(k, "-") for k in ("rest", "mean", "unread"))) for name, row in single.items()]
    rows.append(
        f"<details><summary>Every neuron alone</summary><div class=scroll>{_table([head, *cells])}</div></details>"
    )
    rows.append(
        "<p class=small>Controls: random lesions of the same size; activations shifted in a circle against their "
        "episode (correlation) or window (information). Holm-corrected "
        f"{found.correlation.significant:.0%} of {found.correlation.r.size} correlations are significant.</p>"
    )
    return "\n".join(rows)


def _table(rows: Sequence[Sequence[str]]) -> str:
    def line(row: Sequence[str], tag: str) -> str:
        return "<tr>" + "".join(f"<{tag}>{html.escape(cell)}</{tag}>" for cell in row) + "</tr>"

    return "<table>" + line(rows[0], "th") + "".join(line(row, "td") for row in rows[1:]) + "</table>"


def _how(found: Findings, live: bool) -> str:
    memory = f"Memory: {found.memory}." if found.kind == "circuit" else "An MLP has no memory."
    if live:
        return f"{memory} Task and circuit are computed in this page, step for step as in Python; it needs no network."
    return f"{memory} The circuit is computed in this page, from the inputs that it had in the recorded episodes."


def _readout(policy: ExportedPolicy, n_units: int) -> FloatArray:
    if not isinstance(policy.low, MLP):
        return policy.low.readout
    readout = np.zeros((n_units, policy.low.weights[-1].shape[1]))
    readout[n_units - len(policy.low.weights[-1]) :] = policy.low.weights[-1]
    return readout


def _bounds(traces: Sequence[Trace], space: TaskSpace, model: TBCHRL) -> list[float]:
    """The part of the task's space that episodes pass through, with a margin: left, bottom, right, top."""
    places = np.concatenate([places_of(t, space, model.views.subgoals) for t in traces])
    low, high = places.min(axis=0), places.max(axis=0)
    margin = 0.1 * np.maximum(high - low, 1e-3)
    return [float(x) for x in (*(low - margin), *(high + margin))]


def _plain(value: object) -> Any:
    if isinstance(value, Mapping):
        return {name: _plain(part) for name, part in value.items()}
    if isinstance(value, np.ndarray):
        return _plain(value.tolist())
    if isinstance(value, list | tuple):
        return [_plain(part) for part in value]
    if isinstance(value, float):
        return float(f"{value:.9g}") if np.isfinite(value) else None  # single precision has no more digits
    return value


def _asset(name: str) -> str:
    return resources.files("sb3_tbc.interpret").joinpath("assets", name).read_text(encoding="utf-8")
