"""Episodes for the page of a task that the browser cannot simulate: inputs, path and film, whole and lesioned."""

from __future__ import annotations

import base64
import io
import sys
from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np

from sb3_tbc.aliases import Env, Plain
from sb3_tbc.arrays import FloatArray
from sb3_tbc.extras import require
from sb3_tbc.interpret.episodes import HeldOutEpisodes, Trace
from sb3_tbc.interpret.features import TaskSpace, places_of
from sb3_tbc.interpret.units import Units, clamp
from sb3_tbc.tbc_hrl import TBCHRL


class FilmSize(NamedTuple):
    """How large a film is."""

    frames: int
    width: int
    quality: int  # of JPEG, up to 95


WHOLE, LESIONED = FilmSize(60, 320, 70), FilmSize(24, 200, 50)


def recorded_starts(
    model: TBCHRL, units: Units, episodes: HeldOutEpisodes, traces: Sequence[Trace], space: TaskSpace,
    order: Sequence[int], means: FloatArray, room: int,
) -> list[Plain]:  # fmt: skip
    """The page's episodes: the first with lesions, as many as there is room for, and the second whole.

    :param order: units, those that are to be lesioned first at the beginning
    :param means: what a lesioned unit is clamped to, ``(N,)``
    :param room: most bytes of all episodes together
    """
    env = episodes.make_env()
    whole = [_episode(model, env, traces[k], space, episodes.seed + k, WHOLE) for k in range(min(2, len(traces)))]
    starts = [_start(k, trace, space, model, one) for k, (trace, one) in enumerate(zip(traces, whole, strict=False))]
    room -= sum(_size(one) for one in whole)
    for unit in order:
        (trace,) = episodes.record_one(units, clamp(units, [unit], means))
        one = _episode(model, env, trace, space, episodes.seed, LESIONED)
        room -= _size(one)
        if room < 0:
            break
        starts[0]["lesioned"][str(unit)] = one
    env.close()
    return starts


def _start(k: int, trace: Trace, space: TaskSpace, model: TBCHRL, whole: Plain) -> Plain:
    return {
        "label": f"held-out {k}" + (" (with lesions)" if k == 0 else ""),
        "goal": trace.episode.desired_goal[0].tolist(),
        "goal_place": _goal_place(trace, space, model),
        "whole": whole,
        "lesioned": {},
    }


def _goal_place(trace: Trace, space: TaskSpace, model: TBCHRL) -> list[float] | None:
    """Where the desired goal lies; None unless a goal has the first coordinates of a subgoal, as on most tasks."""
    goal, subgoals = trace.episode.desired_goal[0], model.views.subgoals
    if len(goal) < 2 or subgoals.names[0] not in ("pan", "x", "angle"):
        return None
    point = np.concatenate([goal, np.zeros(max(0, subgoals.dim - len(goal)))])[None, : subgoals.dim]
    return [float(x) for x in space.place(point, trace.episode.observation[:1])[0]]


def _episode(model: TBCHRL, env: Env, trace: Trace, space: TaskSpace, seed: int, size: FilmSize) -> Plain:
    episode, subgoals = trace.episode, model.views.subgoals
    options = [
        {
            "start": o.start, "duration": o.duration, "subgoal": np.round(o.subgoal, 4).tolist(),
            "time_budget": o.time_budget, "reached": o.reached,
            "place": [float(x) for x in space.place(o.subgoal[None], episode.observation[:1])[0]],
        }
        for o in episode.options
    ]  # fmt: skip
    exhausted = len(episode.options) >= model.rules.max_options and not episode.terminated
    return {
        "n_inputs": trace.inputs.shape[1],
        "inputs": _floats(trace.inputs),
        "places": _floats(places_of(trace, space, subgoals)),
        "options": options,
        "success": episode.success,
        "ended": "goal reached" if episode.success else "its action budget is used up" if exhausted else "time is up",
        "film": film(model, env, trace, seed, size),
    }


def film(model: TBCHRL, env: Env, trace: Trace, seed: int, size: FilmSize) -> Plain | None:
    """Take the episode's actions again and keep pictures as JPEG.

    :return: None if the task cannot be drawn
    """
    require("PIL", extra="plots", what="the film in the page")
    from PIL import Image

    env.reset(seed=seed)
    every = -(-trace.episode.length // size.frames)
    frames, shape = [], [4, 3]
    for step, unit in enumerate(trace.episode.actions):
        if step % every == 0:
            _overlay(env, trace, step, model)
            picture = _picture(env)
            if picture is None:
                return None
            small = Image.fromarray(np.asarray(picture))
            small = small.resize((size.width, round(size.width * small.height / small.width)))
            shape = [small.width, small.height]
            buffer = io.BytesIO()
            small.save(buffer, format="JPEG", quality=size.quality, optimize=True)
            frames.append(base64.b64encode(buffer.getvalue()).decode())
        env.step(model.policy.unit.unscale(unit))
    return {"every": every, "frames": frames, "shape": shape}


def _picture(env: Env) -> Any:
    """The task's picture; None, with a notice, if it cannot be drawn: the page then has no film."""
    try:
        return env.render()
    except Exception as error:  # An environment's own code, or a missing OpenGL, may fail in any way.
        print(f"film left out: {type(error).__name__}: {error}", file=sys.stderr)
        return None


def _overlay(env: Env, trace: Trace, step: int, model: TBCHRL) -> None:
    if hasattr(env.unwrapped, "set_overlay"):
        left = float(trace.steps_left[step]) / model.rules.dt_max
        env.unwrapped.set_overlay(trace.subgoal[step], min(max(left, 0.0), 1.0))


def _floats(values: FloatArray) -> str:
    return base64.b64encode(np.ascontiguousarray(values, dtype="<f4").tobytes()).decode()


def _size(episode: Plain) -> int:
    frames = (episode["film"] or {"frames": []})["frames"]
    return len(episode["inputs"]) + len(episode["places"]) + sum(len(frame) for frame in frames)
