"""The tasks against recordings of the original implementations; see tests/data/golden/README.md."""

from pathlib import Path

import numpy as np
import pytest
from making import make

GOLDEN = Path(__file__).parents[1] / "data" / "golden"


def load(task):
    """Episodes of a task: name -> array name -> array."""
    episodes = {}
    with np.load(GOLDEN / f"{task}.npz") as arrays:
        for key in arrays.files:
            episode, name = key.split("/")
            episodes.setdefault(episode, {})[name] = arrays[key]
    return episodes


def start_of(episode):
    state = {}
    for key, name in (("qpos", "init_qpos_sampled"), ("qvel", "init_qvel_sampled"), ("ball_shot", "ball_shot")):
        if name in episode:
            state[key] = episode[name]
    return {"goal": episode["goal"], "state": state}


def compact_view(env, observation):
    """The public observation vector, whichever layout the environment has."""
    if "Tennis2D" in env.unwrapped.spec.id:
        return observation["observation"][:14]
    return env.unwrapped.subgoals.local(observation)


def replay(env, episode):
    """Largest error per step of observation and achieved goal; rewards and ends have to agree."""
    observation, _ = env.reset(options=start_of(episode))
    errors = [np.abs(compact_view(env, observation) - episode["observation"][0]).max()]
    for t, action in enumerate(episode["action"]):
        observation, reward, terminated, truncated, info = env.step(action)
        error = np.abs(compact_view(env, observation) - episode["observation"][t + 1]).max()
        goal_error = np.abs(observation["achieved_goal"] - episode["achieved_goal"][t + 1]).max()
        errors.append(max(error, goal_error))
        assert reward == episode["reward"][t]
        assert (terminated or truncated) == episode["done"][t]
        assert info["is_success"] == (reward == 0)
    return np.array(errors)


@pytest.mark.parametrize("layout", ["paper", "compact"])
@pytest.mark.parametrize("task", ["Drawbridge", "Platforms", "Tennis2D"])
def test_two_dimensional_tasks_are_exact(task, layout):
    kwargs = {"legacy_quirks": True, **({"max_episode_steps": 501} if task == "Tennis2D" else {})}
    env = make(task, layout, **kwargs)
    for name, episode in load(task).items():
        if name != "consecutive_ep1":  # the one that goes on where another ended
            env = make(task, layout, **kwargs)
        assert replay(env, episode).max() == 0.0, name


def test_drawbridge_is_exact_by_default():
    for episode in load("Drawbridge").values():
        assert replay(make("Drawbridge"), episode).max() == 0.0


@pytest.mark.parametrize("legacy_quirks", [False, True])
def test_pendulum_is_exact(legacy_quirks):
    """Ten seconds of balancing amplify rounding beyond all bounds; only the achieved angle is computed otherwise."""
    for name, episode in load("Pendulum").items():
        assert replay(make("Pendulum", legacy_quirks=legacy_quirks), episode).max() < 1e-14, name


def test_pendulum_step_by_step():
    """From every recorded state, one control step agrees to 1e-12."""
    env = make("Pendulum")
    for episode in load("Pendulum").values():
        for t, action in enumerate(episode["action"]):
            cos, sin, speed = episode["observation"][t]
            # One sub-step without torque belongs to a reset; it is undone here.
            before = np.array([np.arctan2(sin, cos) - 0.002 * speed])
            velocity = (speed * 0.2512 - 0.002 * 4.905 * np.sin(before)) / 0.251
            observation, _ = env.reset(options={"goal": episode["goal"], "state": {"qpos": before, "qvel": velocity}})
            np.testing.assert_allclose(observation["observation"], episode["observation"][t], atol=1e-13)
            observation = env.step(action)[0]
            np.testing.assert_allclose(observation["observation"], episode["observation"][t + 1], atol=1e-12)


@pytest.mark.parametrize("layout", ["paper", "compact"])
def test_ant_four_rooms_replays_exactly(layout):
    env = make("AntFourRooms", layout)
    for name, episode in load("AntFourRooms").items():
        assert replay(env, episode).max() < 1e-12, name


def test_ur5_off_the_floor():
    episodes = load("UR5Reacher")
    for name in ("ep1", "ep3"):
        assert replay(make("UR5Reacher"), episodes[name]).max() < 1e-6, name


def test_ur5_on_the_floor_stays_close():
    """A sphere and a capsule stand for the meshes: 0.016 and 0.005 rad at most in 200 actions on the floor."""
    for name, limit in (("ep0", 0.02), ("ep2", 0.006)):
        episode = load("UR5Reacher")[name]
        env = make("UR5Reacher", "compact")
        observation, _ = env.reset(options=start_of(episode))
        for t, action in enumerate(episode["action"][:200]):
            observation = env.step(action)[0]
            error = np.abs(observation["observation"][:3] - episode["observation"][t + 1][:3])
            assert error.max() < limit, (name, t)


def test_ur5_folds_only_as_far_as_its_shoulder():
    """The forearm bumps into the shoulder and does not pass through it."""
    env = make("UR5Reacher", "compact")
    env.reset(options={"state": {"qpos": [0.0, -1.0, 0.0], "qvel": [0.0, 0.0, 0.0]}})
    for _ in range(300):
        env.step(np.array([0.0, -1.9, -3.15]))
    assert -2.95 < env.unwrapped.task_state()["qpos"][2] < -2.5


def test_default_differs_from_legacy_only_where_documented():
    """Without the public quirks the platforms stand at their start, not at the origin."""
    episode = load("Platforms")["ep1"]
    env = make("Platforms", "compact")
    observation, _ = env.reset(options=start_of(episode))
    platform0 = observation["observation"][1:5]
    np.testing.assert_allclose(
        platform0, [0.75, -0.4 - 0.25 * np.sin(0.8 * np.pi), 0.0, 0.75 * np.cos(0.8 * np.pi)], atol=1e-6
    )
    np.testing.assert_array_equal(observation["observation"][9:13], episode["observation"][0][9:13])
