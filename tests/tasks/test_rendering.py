"""Pictures of the tasks: shape, overlay, the canvas itself, and what is said where drawing is impossible."""

import importlib
import os
import subprocess
import sys
import types
from ctypes.util import find_library

import gymnasium as gym
import numpy as np
import pytest
from making import make
from sb3_tbc.tasks import mujoco_rendering
from sb3_tbc.tasks.rendering import BODY, GOAL, PAPER, SUBGOAL, Canvas
from sb3_tbc.tasks.window import Window

PLANAR = ["Pendulum", "Drawbridge", "Platforms", "Tennis2D"]
SPATIAL = ["UR5Reacher", "AntFourRooms"]


def render(task, *overlays):
    """One picture per overlay; drawing must not touch the state."""
    env = make(task, render_mode="rgb_array")
    env.reset(seed=0)
    for _ in range(3):
        env.step(np.zeros(env.action_space.shape))
    state, pictures = env.unwrapped.task_state(), []
    for overlay in overlays:
        env.unwrapped.set_overlay(**overlay)
        try:
            pictures.append(env.render())
        except mujoco_rendering.GLUnavailable as error:
            pytest.skip(str(error))
    assert all(np.array_equal(state[key], value, equal_nan=True) for key, value in env.unwrapped.task_state().items())
    env.close()
    return pictures


def count(picture, color, tolerance=12):
    return int((np.abs(picture.astype(int) - np.array(color)).max(axis=-1) <= tolerance).sum())


@pytest.mark.parametrize("task", PLANAR + SPATIAL)
def test_picture_shows_subgoal_and_time(task):
    space = make(task).unwrapped.subgoals
    subgoal = space.unscale(np.full(space.dim, 0.5))
    with_subgoal = [{"subgoal": subgoal, "time_left": left} for left in (1.0, 0.1)]
    bare, full, late = render(task, {}, *with_subgoal)
    assert bare.dtype == np.uint8
    assert bare.ndim == 3
    assert bare.shape[2] == 3
    assert bare.std() > 5
    assert count(bare, GOAL) > 100
    assert count(bare, SUBGOAL) == 0
    ring = slice(0, 64), slice(bare.shape[1] - 64, None)
    assert count(full[ring], SUBGOAL) > 3 * count(late[ring], SUBGOAL) > 0
    changed = (full.astype(int) - bare).any(axis=-1)
    assert changed[80:].any()  # the subgoal itself, below legend and ring


@pytest.mark.parametrize("where", [(0.0, 0.0), (2.0, 0.0), (0.0, -2.0), (-7.25, 0.0), (-9.0, 9.0), (9.0, -9.0)])
def test_no_wall_and_no_label_hides_the_ants_subgoal(where):
    bare, marked = render("AntFourRooms", {}, {"subgoal": [*where, 0.5, 0.0, 0.0]})
    legend = count(marked[50:72, 8:28], SUBGOAL)
    assert count(marked, SUBGOAL) - legend > 60
    assert count(bare, SUBGOAL) == 0


def test_goal_and_subgoal_differ_without_their_colours():
    """A subgoal in the very place of the goal changes the picture's brightness: it is another shape."""
    for task, subgoal in (("Pendulum", [0.1, 0.2]), ("Platforms", [-0.5, 0.45, 0.0, 0.0])):
        env = make(task, render_mode="rgb_array")
        env.reset(seed=0, options={"goal": subgoal[:2]})
        pictures = []
        for shown in (None, subgoal):
            env.unwrapped.set_overlay(subgoal=shown)
            pictures.append(env.render()[80:].astype(int).sum(axis=-1))
        assert (np.abs(pictures[0] - pictures[1]) > 60).sum() > 100


def test_the_ring_says_how_many_steps_are_left():
    full, one = render("Drawbridge", {"time_left": 0.5, "steps_left": 12}, {"time_left": 0.5, "steps_left": 1})
    words = slice(30, 54), slice(620, 736)
    assert (full[words] != one[words]).any()
    np.testing.assert_array_equal(full[:30], one[:30])
    np.testing.assert_array_equal(full[70:], one[70:])


def test_rendering_changes_nothing():
    """Episodes with and without pictures agree to the bit."""
    for task in [*PLANAR, "AntFourRooms"]:
        seen, unseen = make(task, render_mode="rgb_array"), make(task)
        seen.reset(seed=1)
        unseen.reset(seed=1)
        seen.action_space.seed(0)
        for _ in range(4):
            action = seen.action_space.sample()
            one, other = seen.step(action)[0], unseen.step(action)[0]
            assert np.array_equal(one["observation"], other["observation"])
            try:
                seen.render()
            except mujoco_rendering.GLUnavailable:
                break
        seen.close()


def test_canvas_draws_where_it_should():
    canvas = Canvas(100, 80, -1.0, 0.0, 50.0)
    canvas.box((0.0, 0.8), (0.2, 0.1), BODY)
    assert count(canvas.pixels, BODY, 0) == 20 * 10
    assert tuple(canvas.pixels[40, 50]) == BODY
    canvas.circle((0.5, 1.3), 0.2, GOAL)
    assert abs(count(canvas.pixels, GOAL, 0) - np.pi * 100) < 40
    assert tuple(canvas.pixels[15, 75]) == GOAL
    canvas.polygon([(-0.9, 0.1), (-0.5, 0.1), (-0.5, 0.5)], SUBGOAL)
    assert tuple(canvas.pixels[72, 22]) == SUBGOAL
    assert tuple(canvas.pixels[60, 7]) == PAPER
    canvas.line((-5.0, -5.0), (5.0, -4.0), BODY)  # outside: nothing happens
    canvas.text(90, 70, "cut off at the border")
    canvas.box((10.0, 10.0), (1.0, 1.0), BODY)
    assert canvas.pixels.shape == (80, 100, 3)


def test_box_turned_by_nothing_equals_polygon():
    snapped, smooth = Canvas(60, 60, 0, 0, 1.0), Canvas(60, 60, 0, 0, 1.0)
    snapped.box((30, 30), (10, 5), BODY)
    smooth.polygon([(20, 25), (40, 25), (40, 35), (20, 35)], BODY)
    assert np.abs(snapped.pixels.astype(int) - smooth.pixels).max() <= 1


def test_render_without_mode_warns_and_returns_nothing():
    env = make("Pendulum")
    env.reset(seed=0)
    with pytest.warns(UserWarning, match="render_mode"):
        assert env.render() is None


def test_closing_one_picture_leaves_the_other():
    """OpenGL frees objects by number in whichever context is current."""
    envs = [make("UR5Reacher", render_mode="rgb_array") for _ in range(2)]
    try:
        pictures = [(env.reset(seed=0), env.render())[1] for env in envs]
    except mujoco_rendering.GLUnavailable as error:
        pytest.skip(str(error))
    envs[0].close()
    np.testing.assert_array_equal(envs[1].render(), pictures[1])
    envs[1].close()


@pytest.mark.slow
def test_osmesa_follows_a_failed_egl():
    """The first backend that PyOpenGL meets leaves its name in the environment, and others refuse to follow it."""
    code = """
import os, sys
import gymnasium as gym
from sb3_tbc.tasks import mujoco_rendering, register_tasks

def without_egl(name):
    if name == "mujoco.egl":
        os.environ["PYOPENGL_PLATFORM"] = "egl"
        raise ImportError("no EGL")
    return __import__(name, fromlist=["GLContext"])

mujoco_rendering.import_module = without_egl
register_tasks()
env = gym.make("sb3_tbc/UR5Reacher-v0", render_mode="rgb_array")
env.reset(seed=0)
try:
    env.render()
except mujoco_rendering.GLUnavailable as error:
    print(error)
else:
    print(type(env.unwrapped._scene._gl).__module__)
"""
    environ = {name: value for name, value in os.environ.items() if name not in ("MUJOCO_GL", "PYOPENGL_PLATFORM")}
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True, env=environ)
    if find_library("OSMesa") is None:
        pytest.skip("OSMesa is not installed")
    assert (done.stdout, done.stderr) == ("mujoco.osmesa\n", "")


def test_missing_opengl_says_what_to_install(monkeypatch):
    monkeypatch.setattr(
        mujoco_rendering, "import_module", lambda name: (_ for _ in ()).throw(ImportError(f"no {name}"))
    )
    env = make("UR5Reacher", render_mode="rgb_array")
    env.reset(seed=0)
    with pytest.raises(mujoco_rendering.GLUnavailable, match=r"apt-get install libegl1.*no mujoco\.egl"):
        env.render()


def test_human_mode_without_display_says_what_to_do(monkeypatch):
    tk = types.ModuleType("tkinter")

    def no_display():
        raise OSError("no display name")

    tk.Tk = no_display
    monkeypatch.setitem(sys.modules, "tkinter", tk)
    env = make("Drawbridge", render_mode="human")
    with pytest.raises(RuntimeError, match="rgb_array"):
        env.reset()


def test_human_mode_shows_each_step(monkeypatch):
    shown = []

    class FakeTk:
        def __init__(self, *_, **__):
            pass

        def __getattr__(self, name):
            return lambda *_, **__: None

    def photo(data, format):
        shown.append(data[:16])
        return object()

    tk = types.ModuleType("tkinter")
    tk.Tk = tk.Label = FakeTk
    tk.PhotoImage = photo
    monkeypatch.setitem(sys.modules, "tkinter", tk)
    importlib.import_module("sb3_tbc.tasks.window")
    env = make("Drawbridge", render_mode="human")
    env.reset()
    env.step(np.zeros(1))
    assert len(shown) == 2
    assert shown[0].startswith(b"P6 800 360 255\n")
    assert env.render() is None
    env.close()
    assert isinstance(Window, type)


def test_gymnasium_collects_the_pictures_of_an_episode():
    env = gym.make("sb3_tbc/Pendulum-v0", render_mode="rgb_array_list")
    env.reset(seed=0)
    for _ in range(3):
        env.step(env.action_space.sample())
    assert np.shape(env.render()) == (4, 480, 640, 3)
