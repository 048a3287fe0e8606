"""Videos of an agent's episodes, with the live subgoal and the remaining time drawn in. Needs the ``video`` extra."""

from __future__ import annotations

import math
import traceback
from collections.abc import Iterable, Iterator
from contextlib import closing
from pathlib import Path
from types import ModuleType
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from sb3_tbc.aliases import Env, PlainMapping
from sb3_tbc.errors import ConfigError, WriteError
from sb3_tbc.extras import require
from sb3_tbc.files import replacing
from sb3_tbc.outside import one_line
from sb3_tbc.smdp.goal_spaces import said_success
from sb3_tbc.tasks.rendering import Overlay, with_caption
from sb3_tbc.tbc_hrl import TBCHRL
from sb3_tbc.tbc_hrl.evaluation import Agent
from sb3_tbc.tbc_hrl.policy import TwoLevelState

Frame = NDArray[np.uint8]
MUJOCO_DRAWING = ("mujoco.", "glfw.", "OpenGL.", "gymnasium.envs.mujoco.mujoco_rendering.")
"""Modules that draw for MuJoCo's environments."""
OUTCOME_SECONDS = 1.5
"""How long the last picture of an episode stays, so that its outcome can be read."""


class _Writer(Protocol):
    """The part of imageio's writer that is used here."""

    def append_data(self, frame: Frame) -> None:
        """Add a frame."""

    def close(self) -> None:
        """Let the encoder end, and wait for it."""


def film(model: Agent, env: Env, seed: int | None = None, deterministic: bool = True) -> Iterator[Frame]:
    """The frames of :func:`episode_frames`, the last one held for :data:`OUTCOME_SECONDS`."""
    frame = None
    for frame in episode_frames(model, env, seed, deterministic):
        yield frame
    if frame is not None:
        for _ in range(round(OUTCOME_SECONDS * frames_per_second(env)) - 1):
            yield frame


def frames_per_second(env: Env) -> float:
    """How many steps of the task make up one second of video; 30 where it does not say.

    :raises ConfigError: for a ``render_fps`` that no film can have
    """
    rate = env.metadata.get("render_fps")
    if rate is None:  # some environments say so
        return 30.0
    if isinstance(rate, bool) or not isinstance(rate, int | float | np.number) or not 0 < rate < math.inf:
        raise ConfigError(f"the environment's metadata['render_fps'] must be a number above 0, got {one_line(rate)}")
    return float(rate)


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
        cure = "; without a display, set MUJOCO_GL=egl or MUJOCO_GL=osmesa" if _lacks_display(error) else ""
        raise ConfigError(f"the environment cannot be drawn: {one_line(error, 1000)}{cure}") from error
    picture = _picture(rendered)
    if not draws_itself:
        picture = with_caption(picture, shown, np.asarray(observation["desired_goal"], dtype=np.float64))
    height, width = picture.shape[:2]
    frame: Frame = picture[: height - height % 2, : width - width % 2]  # the codec needs even sizes
    return frame


def _lacks_display(error: Exception) -> bool:
    """Whether an error comes out of MuJoCo's drawing, which needs another backend, and does not say so itself."""
    modules = (frame.f_globals.get("__name__", "") for frame, _ in traceback.walk_tb(error.__traceback__))
    return "MUJOCO_GL" not in str(error) and any(f"{name}.".startswith(MUJOCO_DRAWING) for name in modules)


def _picture(rendered: object) -> Frame:
    """What an environment rendered, if a film can be made of it.

    :raises ConfigError: otherwise
    """
    if not isinstance(rendered, np.ndarray):
        said = one_line(rendered)
        raise ConfigError(f"the environment cannot be drawn: render() gave {said}, not an array; see render_mode")
    colours = rendered.ndim == 3 and rendered.shape[2] == 3 and min(rendered.shape[:2]) > 1
    if not (colours and np.issubdtype(rendered.dtype, np.integer)):
        raise ConfigError(
            "the environment cannot be drawn: a picture has the shape (height, width, 3) and whole numbers from 0 to "
            f"255, render() gave shape {rendered.shape}, {rendered.dtype}; convert it there, or in a wrapper"
        )
    return rendered.astype(np.uint8, copy=False)


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
    frames = (frame for i in range(n_episodes) for frame in film(model, env, seed + i, deterministic))
    with replacing(path) as temporary:
        temporary.touch()  # what the disk refuses is said here in one line, by the encoder in forty
        try:
            _encode(frames, temporary, frames_per_second(env))
        except _EncoderError as error:
            cure = "see the encoder's lines above; is the disk full?"
            raise WriteError(f"cannot write {path}: the film is not whole; {cure}") from error


class _EncoderError(Exception):
    """The encoder ended before it had written everything."""


def _encode(frames: Iterable[Frame], path: Path, fps: float) -> None:
    """Write a film.

    :raises ConfigError: for pictures of different sizes
    :raises _EncoderError: if the file cannot be read afterwards, or the encoder ended early
    """
    imageio, ffmpeg = _encoder()
    writer: _Writer
    size: tuple[int, ...] | None = None
    # imageio's own context leaves the encoder at work after an error: it would write the file again
    with closing(imageio.get_writer(path, fps=fps, macro_block_size=2)) as writer:
        for frame in frames:
            if size not in (None, frame.shape):
                raise ConfigError(f"the pictures of a film must have one size, got {size} and {frame.shape}")
            size = frame.shape
            try:
                writer.append_data(frame)
            except OSError as error:
                raise _EncoderError from error
    try:  # imageio does not look at how the encoder ended
        ffmpeg.count_frames_and_secs(str(path))
    except RuntimeError as error:
        raise _EncoderError from error


def _encoder() -> tuple[ModuleType, ModuleType]:
    """imageio, and its plugin that brings the encoder.

    :raises ConfigError: if one of them, or the encoder's program, is missing
    """
    imageio, ffmpeg = (require(name, extra="video", what="a film") for name in ("imageio.v2", "imageio_ffmpeg"))
    try:
        ffmpeg.get_ffmpeg_exe()
    except RuntimeError as error:
        raise ConfigError(f"a film needs the program ffmpeg: {one_line(error)}") from error
    return imageio, ffmpeg


def require_film(path: Path) -> None:
    """Refuse, before anything is played, a name that no film can have and a machine that can make none.

    :raises ConfigError: unless the name ends in ``.mp4`` and the encoder is installed
    """
    if path.suffix != ".mp4":
        raise ConfigError(f"a video's name must end in .mp4, got {path}")
    _encoder()
