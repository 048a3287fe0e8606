"""The arm in the second engine: the same task, the same motion off the floor, no state left over."""

import gymnasium as gym
import numpy as np
import pytest
from gymnasium.utils.env_checker import check_env as gymnasium_check_env
from scripted_policies import episode_length, servo
from stable_baselines3.common.env_checker import check_env

import sb3_tbc  # noqa: F401  (registers the tasks)

pytest.importorskip("pybullet", reason="the extra `bullet` is not installed")
from sb3_tbc.tasks.mujoco_rendering import GLUnavailable
from sb3_tbc.tasks.ur5_reacher_bullet import solve3


@pytest.fixture
def bullet():
    env = gym.make("sb3_tbc/UR5ReacherBullet-v0", observation="compact")
    yield env
    env.close()


@pytest.fixture
def mujoco():
    return gym.make("sb3_tbc/UR5Reacher-v0", observation="compact")


def test_spaces_are_the_same(bullet, mujoco):
    assert bullet.observation_space == mujoco.observation_space
    assert bullet.action_space == mujoco.action_space
    one, other = bullet.unwrapped, mujoco.unwrapped
    for name in ("low", "high", "thresholds", "local_scale"):
        np.testing.assert_array_equal(getattr(one.subgoals, name), getattr(other.subgoals, name))
    assert gym.make("sb3_tbc/UR5ReacherBullet-v0").observation_space["observation"].shape == (48,)
    np.testing.assert_array_equal(bullet.reset(seed=4)[0]["desired_goal"], mujoco.reset(seed=4)[0]["desired_goal"])


def test_engines_agree_off_the_floor(bullet, mujoco):
    """Same inertias, servos and damping: a second of motion without contact differs by rounding only."""
    start = {"state": {"qpos": [0.3, -1.2, 0.3], "qvel": [0.2, -0.1, 0.3]}}
    one, other = bullet.reset(seed=1, options=start)[0], mujoco.reset(seed=1, options=start)[0]
    rng = np.random.default_rng(1)
    for _ in range(40):
        lift = other["observation"][1]
        action = rng.uniform(-1, 1, 3) * [3.15, 2.0, 2.0] - [0.0, 3.2 * np.cos(lift), 0.5]
        one, other = bullet.step(action)[0], mujoco.step(action)[0]
        assert mujoco.unwrapped.data.ncon == 0
        np.testing.assert_allclose(one["observation"], other["observation"], atol=1e-9)


def test_engines_stay_close_on_the_floor(bullet, mujoco):
    """100 random actions, mostly spent on the floor: joints differ by about a hundredth of a radian."""
    differences = []
    for seed in range(4):
        one, other = bullet.reset(seed=seed)[0], mujoco.reset(seed=seed)[0]
        rng = np.random.default_rng(seed)
        for _ in range(100):
            action = rng.uniform(bullet.action_space.low, bullet.action_space.high)
            one, other = bullet.step(action)[0], mujoco.step(action)[0]
        differences.append(np.abs(one["observation"] - other["observation"])[:3])
    assert np.median(np.max(differences, axis=1)) < 0.05


def test_nothing_leaks_over_reset(bullet):
    def run(env, seed, n):
        rng = np.random.default_rng(seed)
        seen = [env.reset(seed=seed)[0]["observation"]]
        seen += [env.step(rng.uniform(-3, 3, 3))[0]["observation"] for _ in range(n)]
        return np.stack(seen)

    fresh = gym.make("sb3_tbc/UR5ReacherBullet-v0", observation="compact")
    run(bullet, 5, 40)
    run(bullet, 6, 15)
    np.testing.assert_array_equal(run(bullet, 7, 40), run(fresh, 7, 40))
    fresh.close()


@pytest.mark.filterwarnings("ignore")
def test_checker_and_bad_actions(bullet):
    check_env(bullet.unwrapped, skip_render_check=True)
    gymnasium_check_env(gym.make("sb3_tbc/UR5ReacherBullet-v0").unwrapped, skip_render_check=True)
    bullet.reset(seed=0)
    with pytest.raises(ValueError, match="finite"):
        bullet.step(np.array([np.nan, 0, 0]))
    for _ in range(30):
        observation = bullet.step(np.array([1e9, -1e9, 1e9]))[0]
    assert np.isfinite(observation["observation"]).all()


def test_the_mujoco_script_solves_it(bullet):
    assert [episode_length(bullet, servo, seed=seed) is not None for seed in range(3)] == [True] * 3


def test_the_picture_is_the_other_engines_under_its_own_name():
    pictures = []
    for name in ("UR5Reacher", "UR5ReacherBullet"):
        env = gym.make(f"sb3_tbc/{name}-v0", render_mode="rgb_array")
        env.reset(seed=2)
        try:
            pictures.append(env.render().astype(int))
        except GLUnavailable as error:
            pytest.skip(str(error))
        env.close()
    differs = np.abs(pictures[0] - pictures[1]).max(axis=-1) > 40
    assert differs[:32].any()
    assert not differs[32:].any()


def test_solve3():
    rng = np.random.default_rng(0)
    root = rng.normal(size=(3, 3))
    matrix, right = root @ root.T, rng.normal(size=3)
    expected = np.linalg.solve(matrix + 0.02 * np.eye(3), right)
    np.testing.assert_allclose(solve3(matrix.tolist(), 0.02, right.tolist()), expected, rtol=1e-10)


def test_a_closed_arm_can_begin_again(bullet):
    first = bullet.reset(seed=3)[0]
    bullet.close()
    again = bullet.reset(seed=3)[0]
    np.testing.assert_array_equal(first["observation"], again["observation"])
    bullet.step(bullet.action_space.sample())
