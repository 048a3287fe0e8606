"""What an exported NumPy module does; :mod:`sb3_tbc.export.numpy_module` puts settings and weights in front of it."""

from __future__ import annotations

import base64
import io
from typing import Any

import numpy as np
from numpy.typing import NDArray

SETTINGS: dict[str, Any] = {}
WEIGHTS = ""

# --- runtime ---
Array = NDArray[Any]
State = dict[str, Any]
ARRAYS: dict[str, Array] = dict(np.load(io.BytesIO(base64.b64decode(WEIGHTS)))) if WEIGHTS else {}
for _name in ARRAYS:
    if _name.startswith(("high.", "low.")):
        ARRAYS[_name] = ARRAYS[_name].astype(np.float64)  # as the agent itself acts
CLOSED_FORM = False
"""Set to True to take a conductance circuit's closed form instead of its sub-steps."""


def initial_state() -> State:
    """State before an episode: subgoal, time budget and elapsed time of the live option, membrane potentials."""
    return {
        "subgoal": np.zeros(len(ARRAYS["subgoal_low"])),
        "time_budget": 0.0,
        "elapsed": -1,  # no option yet
        "membrane": np.zeros(len(ARRAYS.get("low.readout", ())), dtype=np.float32),
    }


def step(observation: Array, achieved_goal: Array, desired_goal: Array, state: State) -> tuple[Array, State]:
    """One control step: the action in the environment's units, and the next state.

    Where an input is NaN, so is the action: go on from the former state then.
    """
    observation, achieved_goal, desired_goal = (
        np.asarray(part, np.float32).astype(np.float64) for part in (observation, achieved_goal, desired_goal)
    )
    entries = np.concatenate([observation, achieved_goal])
    state = dict(state)
    started = state["elapsed"] < 0
    here = _achieved(entries)
    over = started or state["elapsed"] >= state["time_budget"]
    if SETTINGS["event"] is not None and state["elapsed"] > 0:
        over = over or observation[SETTINGS["event"]] > 0.5
    if SETTINGS["window_end"] == "reached" and not over and state["elapsed"] >= SETTINGS["dt_min"]:
        over = _reached(here - state["subgoal"])
    if (over and SETTINGS["memory"] == "window") or started or SETTINGS["memory"] == "none":
        state["membrane"] = np.zeros_like(state["membrane"])
    if over:
        _begin(observation, achieved_goal, desired_goal, state)
    asked = state["subgoal"] - here if SETTINGS["relative_subgoals"] else state["subgoal"]
    remaining = np.clip((state["time_budget"] - state["elapsed"]) / SETTINGS["dt_max"], 0.0, 1.0)
    parts = [entries[list(SETTINGS["local"])], asked] + ([[remaining]] if SETTINGS["remaining_time"] else [])
    seen = np.concatenate(parts).astype(np.float32)
    if SETTINGS["low.kind"] == "MLP":
        mean = _mlp("low", seen)
    else:
        advance = _dissipate if SETTINGS["low.kind"] == "Dissipative" else _relax if CLOSED_FORM else _integrate
        potentials = advance(seen.astype(np.float64), state["membrane"].astype(np.float64))
        mean = (potentials @ ARRAYS["low.readout"] + ARRAYS["low.readout_bias"]).astype(np.float32)
        state["membrane"] = potentials.astype(np.float32)
    state["elapsed"] += 1
    low, high = ARRAYS["action_low"].astype(np.float32), ARRAYS["action_high"].astype(np.float32)
    action = low + np.float32(0.5) * (_squash(mean, 1) + np.float32(1.0)) * (high - low)
    return np.minimum(action, high), state  # rounded, the sum may lie above the bound


def _begin(observation: Array, achieved_goal: Array, desired_goal: Array, state: State) -> None:
    """Ask the high level for the next subgoal and time budget."""
    parts = [desired_goal, observation] + ([] if SETTINGS["achieved_in_observation"] else [achieved_goal])
    unit = _squash(_mlp("high", np.concatenate(parts).astype(np.float32)), 0).astype(np.float64)
    low, high = ARRAYS["subgoal_low"], ARRAYS["subgoal_high"]
    state["subgoal"] = low + 0.5 * (unit[: len(low)] + 1.0) * (high - low)
    state["time_budget"] = SETTINGS["fixed_budget"]
    if state["time_budget"] is None:
        steps = SETTINGS["dt_min"] + 0.5 * (unit[-1] + 1.0) * (SETTINGS["dt_max"] - SETTINGS["dt_min"])
        state["time_budget"] = max(np.rint(steps), 1.0) if SETTINGS["whole_budgets"] else steps
    state["elapsed"] = 0


def _achieved(entries: Array) -> Array:
    point = []
    for kind, first, second, low, high in SETTINGS["achieved"]:
        if kind == "angle":
            point.append(np.arctan2(entries[first], entries[second]))
        elif kind == "wrap":
            point.append(np.fmod(entries[first], high))
        else:
            point.append(np.clip(entries[first], low, high))
    return np.array(point)


def _reached(difference: Array) -> bool:
    distances = [np.sqrt(sum(difference[i] ** 2 for i in group)) for group in SETTINGS["groups"]]
    return bool(np.all(np.array(distances) < ARRAYS["thresholds"]))


def _squash(mean: Array, level: int) -> Array:
    bound = SETTINGS["mean_bounds"][level]
    return np.asarray(np.tanh(np.clip(mean, -bound, bound), dtype=np.float64).astype(np.float32))


def _mlp(level: str, x: Array) -> Array:
    x = x.astype(np.float64)
    count = SETTINGS[level + ".weights.count"]
    for i in range(count):
        x = x @ ARRAYS[f"{level}.weights.{i}"] + ARRAYS[f"{level}.biases.{i}"]
        if i < count - 1:
            x = np.maximum(x, 0.0) if SETTINGS[level + ".activation"] == "relu" else np.tanh(x)
    return x.astype(np.float32)


def _logistic(x: Array) -> Array:
    return np.asarray(0.5 + 0.5 * np.tanh(0.5 * x))


def _drive(seen: Array) -> Array:
    a = ARRAYS
    scaled = seen * a["low.input_gain"]
    sensed = _logistic(scaled * a["low.sensory_gain"] - a["low.sensory_threshold"])
    current = np.tanh(scaled @ a["low.current_weight"] + a["low.current_bias"])
    return np.asarray(np.concatenate([sensed, current]) @ a["low.from_inputs"] + a["low.rest"])


def _integrate(seen: Array, membrane: Array) -> Array:
    """K semi-implicit sub-steps."""
    a, n, p = ARRAYS, len(membrane), len(ARRAYS["low.gain"])
    pace = a["low.capacitance"] * SETTINGS["low.sub_steps"]
    drive = _drive(seen)
    for _ in range(SETTINGS["low.sub_steps"]):
        total = drive + _logistic(membrane[:p] * a["low.gain"] - a["low.threshold"]) @ a["low.recurrent"]
        membrane = (membrane * pace + total[:n]) / (total[n:] + pace)
    return membrane


def _dissipate(seen: Array, state: Array) -> Array:
    """Sub-steps of the dissipative dynamics."""
    a = ARRAYS
    drive = seen @ a["low.input_weight"] + a["low.bias"]
    for _ in range(SETTINGS["low.sub_steps"]):
        force = np.tanh(drive + state @ a["low.recurrent"])
        state = (state + SETTINGS["low.eta"] * force) * a["low.shrink"]
    return state


def _relax(seen: Array, membrane: Array) -> Array:
    """The closed form, group after group."""
    a, n, p = ARRAYS, len(membrane), len(ARRAYS["low.gain"])
    drive, membrane = _drive(seen), membrane.copy()
    for group in SETTINGS["low.order"]:
        at = list(group)
        total = drive + _logistic(membrane[:p] * a["low.gain"] - a["low.threshold"]) @ a["low.recurrent"]
        weighted, conductance = total[:n][at], total[n:][at]
        share = -np.expm1(-conductance / a["low.capacitance"][at])
        membrane[at] += (weighted / conductance - membrane[at]) * share
    return membrane
