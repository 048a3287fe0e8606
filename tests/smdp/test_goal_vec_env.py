"""Our vector of goal environments beside SB3's, which it must equal."""

import numpy as np
import pytest
from corridor import Corridor
from stable_baselines3.common.monitor import Monitor
from stable_baselines3.common.vec_env import DummyVecEnv

from sb3_tbc.smdp.goal_vec_env import GoalVecEnv


def stripped(infos):
    """Infos without the time an episode took."""
    return [{**info, "episode": {**info["episode"], "t": 0}} if "episode" in info else info for info in infos]


@pytest.mark.parametrize("n_envs", [1, 3])
def test_same_as_sb3s(n_envs):
    ours, theirs = (kind([lambda: Monitor(Corridor(9)) for _ in range(n_envs)]) for kind in (GoalVecEnv, DummyVecEnv))
    rng = np.random.default_rng(0)
    for venv in (ours, theirs):
        venv.seed(4)
    np.testing.assert_equal(ours.reset(), dict(theirs.reset()))
    ends = 0
    for _ in range(40):
        actions = rng.uniform(-1, 1, (n_envs, 1)).astype(np.float32)
        (seen, rewards, dones, infos), expected = ours.step(actions), theirs.step(actions)
        np.testing.assert_equal(seen, dict(expected[0]))
        np.testing.assert_array_equal(rewards, expected[1])
        np.testing.assert_array_equal(dones, expected[2])
        np.testing.assert_equal(stripped(infos), stripped(expected[3]))
        assert rewards.dtype == expected[1].dtype
        ends += dones.sum()
    assert ends


def test_what_it_returns_is_the_callers():
    venv = GoalVecEnv([Corridor])
    venv.seed(0)
    first = venv.reset()
    kept = {key: array.copy() for key, array in first.items()}
    seen, rewards, _, infos = venv.step(np.ones((1, 1), np.float32))
    before = rewards.copy()
    venv.step(-np.ones((1, 1), np.float32))
    np.testing.assert_equal(first, kept)
    np.testing.assert_array_equal(rewards, before)
    infos[0]["mine"] = True
    assert "mine" not in venv.step(np.ones((1, 1), np.float32))[3][0]
    assert set(seen) == {"observation", "achieved_goal", "desired_goal"}


class ChangesItsAction(Corridor):
    """A careless task."""

    def step(self, action):
        action *= 0.5
        return super().step(action)


def test_actions_are_kept_as_they_were_given():
    venv = GoalVecEnv([lambda: ChangesItsAction(goal=0.9)])
    venv.seed(0)
    venv.reset()
    for _ in range(3):
        seen = venv.step(np.ones((1, 1), np.float32))[0]
    np.testing.assert_equal(venv.relive([episode._replace() for episode in venv.running]), seen)
