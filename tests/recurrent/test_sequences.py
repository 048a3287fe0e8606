"""What enters the replay of sequences, and the memories, is finite."""

from __future__ import annotations

from typing import Any

import gymnasium as gym
import numpy as np
import pytest
from gymnasium import spaces
from stable_baselines3.common.vec_env import DummyVecEnv

from sb3_tbc import NDBCSAC
from sb3_tbc.errors import NonFiniteError


class Sensor(gym.Env[Any, Any]):
    """Episodes of four steps; at one step, counted over all of them, one value is what the test says."""

    observation_space = spaces.Box(-1.0, 1.0, (2,), np.float32)
    action_space = spaces.Box(-1.0, 1.0, (1,), np.float32)

    def __init__(self, bad_step: int | None = None, observed: float = 0.0, reward: float = 0.0) -> None:
        self.bad_step, self.observed, self.reward = bad_step, observed, reward
        self.steps = 0

    def reset(self, *, seed: int | None = None, options: Any = None) -> Any:
        super().reset(seed=seed)
        return np.array([0.0, self.observed if self.bad_step == 0 else 0.0], np.float32), {}

    def step(self, action: Any) -> Any:
        self.steps += 1
        bad = self.steps == self.bad_step
        seen = np.array([0.5, self.observed if bad else 0.0], np.float32)
        return seen, self.reward if bad else 0.0, self.steps % 4 == 0, False, {}


def agent(*envs: Sensor) -> NDBCSAC:
    policy: dict[str, Any] = {"net_arch": [8], "cell": "gru", "hidden_size": 4}
    sequences = {"sequence_length": 4, "burn_in": 2}
    venv = DummyVecEnv([lambda env=env: env for env in envs])  # type: ignore[misc]
    return NDBCSAC(
        "MlpPolicy", venv, batch_size=4, learning_starts=2, buffer_size=100, seed=0, policy_kwargs=policy,
        replay_buffer_kwargs=sequences,
    )  # fmt: skip


@pytest.mark.parametrize(
    ("bad", "message"),
    [
        (Sensor(0, observed=np.nan), r"environment 1: its observation is not finite: \[0.0, nan\]"),
        (Sensor(6, observed=np.inf), r"environment 1: its observation is not finite: \[0.5, inf\]"),
        (
            Sensor(8, observed=np.nan),
            r"environment 1: its observation is not finite: \[0.5, nan\]",
        ),
        (Sensor(7, reward=np.nan), r"environment 1: its reward is not finite: \[nan\]"),
    ],
)
def test_what_is_not_finite_is_named_and_not_learnt_from(bad: Sensor, message: str) -> None:
    model = agent(Sensor(), bad)
    with pytest.raises(NonFiniteError, match=message):
        model.learn(40)
    buffer: Any = model.replay_buffer
    stored = slice(0, buffer.size())
    for rows in (buffer.observations, buffer.next_observations, buffer.rewards):
        assert np.isfinite(rows[stored]).all()
    assert all(bool(part.isfinite().all()) for part in model.policy.state_dict().values())


@pytest.mark.parametrize("value", [np.nan, np.inf])
def test_predict_names_an_observation_that_is_not_finite(value: float) -> None:
    model = agent(Sensor())
    seen = np.array([[0.0, 0.0], [value, 0.0]], np.float32)
    with pytest.raises(NonFiniteError, match=rf"environment 1: its observation is not finite: \[{value}, 0.0\]"):
        model.predict(seen)
    model.predict(seen[:1])
