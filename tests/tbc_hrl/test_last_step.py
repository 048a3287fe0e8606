"""A run that a callback stops goes on with the step after: no transition, and no hindsight, across that step."""

from __future__ import annotations

from typing import Any

import gymnasium as gym
import numpy as np
import pytest
from checks import assert_same
from corridor import Corridor
from stable_baselines3.common.callbacks import BaseCallback, StopTrainingOnMaxEpisodes
from stable_baselines3.common.monitor import Monitor
from stable_baselines3.common.noise import OrnsteinUhlenbeckActionNoise

from sb3_tbc import NDBCSAC
from sb3_tbc.smdp.goal_vec_env import GoalVecEnv
from sb3_tbc.tbc_hrl.flat_sac import FlatSAC

LENGTH = 20
SMALL: dict[str, Any] = {"batch_size": 8, "buffer_size": 500, "seed": 0}


class StopAt(BaseCallback):
    def __init__(self, step: int) -> None:
        super().__init__()
        self.step = step

    def _on_step(self) -> bool:
        return self.num_timesteps < self.step


def flat(n_envs: int = 1) -> FlatSAC:
    env = GoalVecEnv([lambda: Monitor(Corridor(LENGTH, goal=5.0)) for _ in range(n_envs)])
    return FlatSAC("MultiInputPolicy", env, policy_kwargs={"net_arch": [8]}, gradient_ratio=0.1, **SMALL)


def recurrent(**given: Any) -> NDBCSAC:
    env = gym.wrappers.FlattenObservation(Corridor(LENGTH, goal=5.0))
    policy = {"net_arch": [8], "cell": "gru", "hidden_size": 4}
    return NDBCSAC("MlpPolicy", Monitor(env), policy_kwargs=policy, train_freq=10, **SMALL, **given)


def stored(model: Any) -> dict[str, Any]:
    buffer = model.replay_buffer
    parts = {"actions": buffer.actions, "dones": buffer.dones}
    for name in ("observations", "next_observations"):
        held = getattr(buffer, name)
        parts |= {f"{name}.{key}": part for key, part in held.items()} if isinstance(held, dict) else {name: held}
    rows = {name: part[: buffer.pos].copy() for name, part in parts.items()}
    return rows | {"episodes": np.array([model._episode_num, len(model.ep_info_buffer)])}


@pytest.mark.parametrize("n_envs", [1, 2])
@pytest.mark.parametrize("step", [LENGTH, 47])
def test_hindsight_stays_within_its_episode(step: int, n_envs: int) -> None:
    stopped = flat(n_envs).learn(500, callback=StopAt(n_envs * step))
    assert stopped.replay_buffer.pos == step  # type: ignore[union-attr]
    stopped.learn(n_envs * (150 - step), reset_num_timesteps=False)
    assert_same(stored(flat(n_envs).learn(n_envs * 150)), stored(stopped))
    assert set(stopped._her_buffer().ep_length[: 7 * LENGTH].ravel()) == {LENGTH}


@pytest.mark.parametrize("step", [LENGTH, 47])
def test_a_memory_does_not_skip_a_step(step: int) -> None:
    model = recurrent(learning_starts=1000).learn(500, callback=StopAt(step))
    model.learn(60, reset_num_timesteps=False)
    buffer: Any = model.replay_buffer
    assert buffer.pos == step + 60
    followed = ~buffer.dones[: buffer.pos - 1, 0].astype(bool)
    seen, then = buffer.observations[1 : buffer.pos, 0], buffer.next_observations[: buffer.pos - 1, 0]
    np.testing.assert_array_equal(seen[followed], then[followed])
    np.testing.assert_array_equal(buffer.starts[1 : buffer.pos, 0], ~followed)


def test_noise_begins_anew_with_the_episode() -> None:
    noise = OrnsteinUhlenbeckActionNoise(np.zeros(1), np.ones(1))
    recurrent(action_noise=noise).learn(500, callback=StopAt(LENGTH))
    assert not noise.noise_prev.any()


def test_so_many_episodes_are_counted() -> None:
    model = flat().learn(5000, callback=StopTrainingOnMaxEpisodes(5))
    assert model._episode_num == len(model.ep_info_buffer or ()) == 5
