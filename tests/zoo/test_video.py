"""Videos: frames carry the overlay, the file appears whole."""

from __future__ import annotations

import sys
from pathlib import Path
from types import FunctionType
from typing import Any

import gymnasium as gym
import numpy as np
import pytest
from sb3_tbc.tasks.rendering import SUBGOAL

from sb3_tbc import TBCHRL, evaluate
from sb3_tbc.errors import ConfigError, WriteError
from sb3_tbc.extras import MissingExtraError
from sb3_tbc.zoo.video import episode_frames, film, frames_per_second, record_video, require_film

ENV_ID = "sb3_tbc/Drawbridge-v0"


@pytest.fixture(scope="module")
def model() -> TBCHRL:
    return TBCHRL("MultiInputPolicy", gym.make(ENV_ID), seed=0, max_options=2, dt_max=12, compile=False)


def test_frames_follow_the_live_option(model: TBCHRL, monkeypatch: pytest.MonkeyPatch) -> None:
    env = gym.make(ENV_ID, render_mode="rgb_array")
    seen = []
    original = env.unwrapped.set_overlay
    monkeypatch.setattr(
        env.unwrapped,
        "set_overlay",
        lambda *shown: (seen.append(shown), original(*shown)),
    )
    frames = list(episode_frames(model, env, seed=0))
    assert len(frames) == len(seen)
    assert all(frame.dtype == np.uint8 and frame.ndim == 3 for frame in frames)
    assert all(side % 2 == 0 for side in frames[0].shape[:2])
    times = [time for _, time, _, _ in seen[:-1]]
    steps = [left for _, _, _, left in seen[:-1]]
    assert all(round(time * model.rules.dt_max) in (left, left - 1) for time, left in zip(times, steps, strict=True))
    assert all(0.0 <= time <= 1.0 for time in times)
    changes = [i for i in range(1, len(times)) if times[i] > times[i - 1]]
    assert len(changes) <= 1  # two options: time runs down, jumps once, runs down
    assert seen[-1][2].endswith("action budget used up")


@pytest.mark.parametrize("deterministic", [True, False])
def test_films_act_as_the_evaluation_does(
    model: TBCHRL, deterministic: bool, monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    """``evaluate --stochastic --video`` filmed the means, whatever was counted."""
    pytest.importorskip("imageio_ffmpeg")
    asked, original = set(), TBCHRL.predict

    def predict(*args: Any, **named: Any) -> Any:
        asked.add(named["deterministic"])
        return original(*args, **named)

    monkeypatch.setattr(TBCHRL, "predict", predict)
    path = tmp_path / "agent.zip"
    model.save(path)
    given = [str(path), "--env", "Drawbridge", "--n-episodes", "1", "--video", str(tmp_path / "a.mp4")]
    assert evaluate.main([*given, "--video-episodes", "1", *([] if deterministic else ["--stochastic"])]) == 0
    assert asked == {deterministic}


def test_the_outcome_stays_for_a_second_and_a_half(model: TBCHRL) -> None:
    env = gym.make(ENV_ID, render_mode="rgb_array")
    once, held = list(episode_frames(model, env, seed=0)), list(film(model, env, seed=0))
    assert len(held) == len(once) + 1.5 * 60 - 1
    assert all(np.array_equal(frame, once[-1]) for frame in held[len(once) :])


class Painter(gym.Env[Any, Any]):
    """A foreign environment that draws a plain picture and knows nothing of overlays."""

    metadata = {"render_modes": ["rgb_array"], "render_fps": 10}  # noqa: RUF012

    def __init__(self, width: int) -> None:
        self.width, self.inner = width, gym.make(ENV_ID)
        self.observation_space, self.action_space = self.inner.observation_space, self.inner.action_space

    def reset(self, **kwargs: Any) -> Any:
        return self.inner.reset(**kwargs)

    def step(self, action: Any) -> Any:
        *rest, _ = self.inner.step(action)
        return *rest, {"success": True}

    def render(self) -> Any:
        return np.zeros((100, self.width, 3), np.uint8)


@pytest.mark.parametrize("width", [80, 300, 640])
def test_foreign_pictures_get_a_strip_with_bar_and_numbers(model: TBCHRL, width: int) -> None:
    frames = list(episode_frames(model, Painter(width), seed=0))
    assert frames[0].shape[0] > 130
    assert frames[0].shape[1:] == (width, 3)
    assert not frames[0][:100].any()
    orange = [int((frame == np.array(SUBGOAL)).all(axis=-1).sum()) for frame in frames]
    assert orange[0] > 0
    if width > 200:
        assert orange[0] > orange[10]  # the bar shrinks
    assert any((frames[-1][100:] != frames[-2][100:]).any(axis=(1, 2)))


def test_the_file_is_written_whole(model: TBCHRL, tmp_path: Path) -> None:
    pytest.importorskip("imageio_ffmpeg")
    path = tmp_path / "videos" / "a.mp4"
    env = gym.make(ENV_ID, render_mode="rgb_array")
    record_video(model, env, path, n_episodes=1)
    assert path.stat().st_size > 1000
    assert [p.name for p in path.parent.iterdir()] == ["a.mp4"]
    with pytest.raises(ConfigError, match=r"must end in \.mp4"):
        record_video(model, env, tmp_path / "a.gif")
    with pytest.raises(WriteError, match=r"cannot write .*a\.mp4/b\.mp4"):
        record_video(model, env, path / "b.mp4")


def test_a_film_that_cannot_be_written_costs_one_line(model: TBCHRL, tmp_path: Path) -> None:
    pytest.importorskip("imageio_ffmpeg")
    env = gym.make(ENV_ID, render_mode="rgb_array")
    (tmp_path / "folder.mp4").mkdir()
    (tmp_path / "file").touch()
    for name in ("folder.mp4", "file/a.mp4"):
        with pytest.raises(WriteError, match=f"cannot write .*{name}: "):
            record_video(model, env, tmp_path / name, n_episodes=1)
    assert sorted(p.name for p in tmp_path.iterdir()) == ["file", "folder.mp4"]


def test_what_cannot_be_drawn_costs_one_line(model: TBCHRL, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    pytest.importorskip("imageio_ffmpeg")
    env = gym.make(ENV_ID, render_mode="rgb_array")
    failing: Any = lambda: 1 / 0  # noqa: E731
    of_mujoco = FunctionType(failing.__code__, {"__name__": "mujoco.egl"})
    cases = (lambda: None, "render_mode"), (failing, "division by zero$"), (of_mujoco, "zero; .* MUJOCO_GL=osmesa")
    for picture, message in cases:
        monkeypatch.setattr(env.unwrapped, "render", picture)
        with pytest.raises(ConfigError, match=f"cannot be drawn: .*{message}"):
            record_video(model, env, tmp_path / "a.mp4")
    assert not list(tmp_path.iterdir())


def test_rates_of_pictures(model: TBCHRL, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Thirty a second where the environment does not say; one that no film can have costs one line."""
    pytest.importorskip("imageio_ffmpeg")
    env = Painter(64)
    for rate in ({}, {"render_fps": None}):
        monkeypatch.setattr(Painter, "metadata", rate)
        assert frames_per_second(env) == 30.0
    for wrong in (0, -5, "fast", float("nan"), float("inf")):
        monkeypatch.setattr(Painter, "metadata", {"render_fps": wrong})
        with pytest.raises(ConfigError, match=rf"'render_fps'\] must be a number above 0, got {wrong}"):
            record_video(model, env, tmp_path / "a.mp4")
    assert not list(tmp_path.iterdir())


@pytest.mark.parametrize(
    ("picture", "message"),
    [
        (np.zeros((64, 64), np.uint8), r"\(64, 64\), uint8"),
        (np.zeros((64, 64, 4), np.uint8), r"\(64, 64, 4\)"),
        (np.zeros((1, 1, 3), np.uint8), r"\(1, 1, 3\)"),
        (np.zeros((64, 64, 3)), "float64"),
    ],
)
def test_pictures_that_make_no_film_cost_one_line(
    model: TBCHRL, picture: Any, message: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    env = Painter(100)
    monkeypatch.setattr(env, "render", lambda: picture)
    with pytest.raises(ConfigError, match=f"whole numbers from 0 to 255, render.. gave shape .*{message}"):
        next(episode_frames(model, env, seed=0))


def test_a_film_that_ends_in_an_error_leaves_nothing_behind(
    model: TBCHRL, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    pytest.importorskip("imageio_ffmpeg")
    env = Painter(100)
    for late, kind in ((1 / 3, ConfigError), (KeyboardInterrupt(), KeyboardInterrupt)):
        drawn: list[int] = []

        def render(late: Any = late, drawn: list[int] = drawn) -> Any:
            drawn.append(0)
            if len(drawn) < 6:
                return np.zeros((100, 100, 3), np.uint8)
            if isinstance(late, BaseException):
                raise late
            return np.zeros((80, 100, 3), np.uint8)

        monkeypatch.setattr(env, "render", render)
        with pytest.raises(kind):
            record_video(model, env, tmp_path / "a.mp4")
        assert not list(tmp_path.iterdir())


def test_a_film_that_the_disk_does_not_hold_is_none(
    model: TBCHRL, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    ffmpeg = pytest.importorskip("imageio_ffmpeg")
    path, program = tmp_path / "a.mp4", tmp_path / "ffmpeg"
    path.write_bytes(b"an earlier film")
    # an encoder whose output is cut off after a kilobyte, as on a full disk
    program.write_text(f'#!/bin/sh\nfor last; do :; done\n{ffmpeg.get_ffmpeg_exe()} "$@" && truncate -s 1K "$last"\n')
    program.chmod(0o755)
    monkeypatch.setattr(ffmpeg._io, "get_ffmpeg_exe", lambda: str(program))
    with pytest.raises(WriteError, match=r"cannot write .*a\.mp4: the film is not whole"):
        record_video(model, gym.make(ENV_ID, render_mode="rgb_array"), path, n_episodes=1)
    assert path.read_bytes() == b"an earlier film"


def test_without_an_encoder_nothing_is_counted(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    ffmpeg = pytest.importorskip("imageio_ffmpeg")

    def none_found() -> str:
        raise RuntimeError("No ffmpeg exe could be found.")

    with monkeypatch.context() as patch:
        patch.setattr(ffmpeg, "get_ffmpeg_exe", none_found)
        with pytest.raises(ConfigError, match="needs the program ffmpeg: No ffmpeg exe"):
            require_film(tmp_path / "a.mp4")
    monkeypatch.setitem(sys.modules, "imageio_ffmpeg", None)
    with pytest.raises(MissingExtraError, match=r"needs the package imageio_ffmpeg.*sb3_tbc\[video\]"):
        require_film(tmp_path / "a.mp4")
