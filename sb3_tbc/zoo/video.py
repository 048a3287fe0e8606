"""Videos of an agent's episodes, with the live subgoal and the remaining time drawn in. Needs the ``video`` extra."""

from __future__ import annotations

import math
from collections.abc import Iterator
from pathlib import Path
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from sb3_tbc.aliases import Env, PlainMapping
from sb3_tbc.errors import ConfigError
from sb3_tbc.extras import require
from sb3_tbc.files import replacing
from sb3_tbc.smdp.goal_spaces import said_success
from sb3_tbc.tasks.rendering import Overlay, with_caption
from sb3_tbc.tbc_hrl import TBCHRL
from sb3_tbc.tbc_hrl.evaluation import Agent
from sb3_tbc.tbc_hrl.policy import TwoLevelState

Frame = NDArray[np.uint8]
OUTCOME_SECONDS = 1.5
"""How long the last picture of an episode stays, so that its outcome can be read."""


class _Writer(Protocol):
    """The part of imageio's writer that is used here."""

    def append_data(self, frame: Frame) -> None:
        """Add a frame."""


def film(model: Agent, env: Env, seed: int | None = None, deterministic: bool = True) -> Iterator[Frame]:
    """The frames of :func:`episode_frames`, the last one held for :data:`OUTCOME_SECONDS`."""
    frame = None
    for frame in episode_frames(model, env, seed, deterministic):
        yield frame
    if frame is not None:
        for _ in range(round(OUTCOME_SECONDS * frames_per_second(env)) - 1):
            yield frame


def frames_per_second(env: Env) -> float:
    """How many steps of the task make up one second of video."""
    return float(env.metadata.get("render_fps", 30))


def episode_frames(model: Agent, env: Env, seed: int | None = None, deterministic: bool = True) -> Iterator[Frame]:
    """Frames of one episode, one per step and one at the end, each ``(height, width, 3)``.

    The episode ends as in an evaluation: success, time limit, or the high level's action budget used up. Our own tasks
    draw subgoal and remaining time into the scene; pictures of other environments get them in a strip below.

    :param model: a trained agent
    :param env: a task with ``render_mode="rgb_array"``
    :param seed: seed of the reset
    :param deterministic: act with the means, as evaluations do by default
    """
    observation, _ = env.reset(seed=seed)
    state, start, over, result = None, np.array([True]), False, "time limit"
    while not over:
        action, carried = model.predict(observation, state, start, deterministic=deterministic)
        shown = Overlay()
        if isinstance(model, TBCHRL) and carried is not None:
            live = TwoLevelState(*carried)
            if live.used[0] > model.config.max_options:
                result = "action budget used up"
                break
            shown = _pursuit(model, live)
        yield _frame(env, shown, observation)
        observation, _, terminated, truncated, info = env.step(action)
        state, start = carried, np.array([False])
        over = terminated or truncated
        if said_success(info):
            result = "success"
    yield _frame(env, Overlay(text=result), observation)


def _pursuit(model: TBCHRL, live: TwoLevelState) -> Overlay:
    """Subgoal and remaining time of the coming step."""
    left = live.time_budget - live.elapsed + 1
    text = f"option {live.used[0]} of {model.config.max_options}"
    return Overlay(live.subgoal[0], float(model.rules.remaining(left)[0]), text, max(math.ceil(left[0]), 0))


def _frame(env: Env, shown: Overlay, observation: PlainMapping) -> Frame:
    draws_itself = hasattr(env.unwrapped, "set_overlay")
    if draws_itself:
        env.unwrapped.set_overlay(*shown)  # type: ignore[attr-defined]
    try:
        rendered = env.render()
    except Exception as error:  # An environment's own code may fail in any way.
        cure = "" if "MUJOCO_GL" in str(error) else "; without a display, set MUJOCO_GL=egl or MUJOCO_GL=osmesa"
        raise ConfigError(f"the environment cannot be drawn: {error}{cure}") from error
    if not isinstance(rendered, np.ndarray):
        raise ConfigError(f"the environment cannot be drawn: render() gave {rendered!r}, not an array; see render_mode")
    picture = rendered
    if not draws_itself:
        picture = with_caption(picture, shown, np.asarray(observation["desired_goal"], dtype=np.float64))
    height, width = picture.shape[:2]
    frame: Frame = picture[: height - height % 2, : width - width % 2]  # the codec needs even sizes
    return frame


def record_video(
    model: Agent, env: Env, path: Path, n_episodes: int = 3, seed: int = 0, deterministic: bool = True
) -> None:
    """Record episodes to an mp4 file, which appears only when it is complete.

    :param model: a trained agent
    :param env: a task with ``render_mode="rgb_array"``
    :param path: the file, ending in ``.mp4``
    :param n_episodes: number of episodes
    :param seed: episode ``i`` starts from ``seed + i``
    :param deterministic: act with the means, as evaluations do by default
    :raises ConfigError: if the file's name, the installation or the task do not allow it
    :raises WriteError: if the file cannot be written
    """
    require_film(path)
    imageio = require("imageio.v2", extra="video", what="a film")
    fps = frames_per_second(env)
    with replacing(path) as temporary:
        temporary.touch()  # what the disk refuses is said here in one line, by the encoder in forty
        writer: _Writer
        with imageio.get_writer(temporary, fps=fps, macro_block_size=2) as writer:
            for episode in range(n_episodes):
                for frame in film(model, env, seed + episode, deterministic):
                    writer.append_data(frame)


def require_film(path: Path) -> None:
    """Refuse a name that no film can have.

    :raises ConfigError: unless it ends in ``.mp4``
    """
    if path.suffix != ".mp4":
        raise ConfigError(f"a video's name must end in .mp4, got {path}")
