"""A run that was saved and resumed goes on bit for bit as one that was not interrupted."""

from __future__ import annotations

import logging

import numpy as np
import pytest
import torch as th
from corridor import Corridor
from stable_baselines3.common.callbacks import BaseCallback
from stable_baselines3.common.vec_env import DummyVecEnv

from sb3_tbc import TBCHRL
from sb3_tbc.smdp.goal_vec_env import GoalVecEnv
from sb3_tbc.zoo.callbacks import TimedCheckpointCallback
from sb3_tbc.zoo.environments import make_envs

ENGINES = {"Platforms": "Box2D", "Tennis2D": "Box2D"}
CIRCUIT = {"inter": 6, "command": 5, "motor": 3, "sensory_fanout": 3, "inter_fanout": 3,
           "recurrent_command_synapses": 4, "motor_fanin": 3, "sub_steps": 2,
           "adaptive_step": {"refresh_every": 7, "eta": 0.05}}  # fmt: skip


class SaveOnce(BaseCallback):
    """Saves the model and its replay at the first rollout after so many steps."""

    def __init__(self, folder, after):
        super().__init__()
        self.folder, self.after, self.saved_at = folder, after, 0

    def _on_step(self):
        return True

    def _on_rollout_start(self):
        if not self.saved_at and self.num_timesteps >= self.after:
            self.model.save(self.folder / "model.zip")
            self.model.save_replay_buffer(self.folder / "replay.npz")
            self.saved_at = self.num_timesteps


def make(task, env, **settings):
    level = {"batch_size": 16, "policy_kwargs": {"net_arch": [8, 8], "ndbc": CIRCUIT}}
    high = {"batch_size": 16, "policy_kwargs": {"net_arch": [8, 8]}, "learning_rate": "lin_1e-3"}
    return TBCHRL(
        "MultiInputPolicy", env, high=high, low=level, max_options=10, gradient_ratio=0.05, compile=False, seed=0,
        **settings,
    )  # fmt: skip


def contents(model):
    """All that must be the same."""
    found = {}
    for name in ("high", "low"):
        level = getattr(model, name)
        found |= {f"{name}.{key}": value.numpy() for key, value in level.policy.state_dict().items()}
        for i, optimizer in enumerate(level._update.optimizers()):
            moments = next(iter(optimizer.state.values()))
            found |= {f"{name}.{i}.{key}": value.detach().numpy() for key, value in moments.items()}
        if level.log_ent_coef is not None:
            found[f"{name}.log_ent_coef"] = level.log_ent_coef.detach().numpy()
        buffer = getattr(model.replay_buffer, name)
        found |= {f"{name}.replay.{key}": array[: buffer.size()] for key, array in buffer.data.items()}
    found["episodes"] = np.array([[info["r"], info["l"]] for info in model.ep_info_buffer])
    return found


def check(task, tmp_path, n_envs=1, after=700, until=1800, env_kwargs=None, **settings):
    env_id = f"sb3_tbc/{task}-v0"
    whole = make(task, make_envs(env_id, n_envs, 5, env_kwargs), **settings)
    save = SaveOnce(tmp_path, after)
    whole.learn(until, callback=save)
    assert after <= save.saved_at < until
    resumed = TBCHRL.load(tmp_path / "model.zip", env=make_envs(env_id, n_envs, 99, env_kwargs))
    resumed.load_replay_buffer(tmp_path / "replay.npz")
    assert resumed.num_timesteps == save.saved_at
    th.manual_seed(123)
    resumed.learn(until - save.saved_at, reset_num_timesteps=False)
    assert resumed.low._n_updates == whole.low._n_updates > 0
    expected, got = contents(whole), contents(resumed)
    assert expected.keys() == got.keys()
    for key, value in expected.items():
        np.testing.assert_array_equal(got[key], value, err_msg=key)
    return resumed


@pytest.mark.parametrize("task", ["Pendulum", "Drawbridge", "UR5Reacher", "AntFourRooms", "Platforms", "Tennis2D"])
def test_goes_on_bit_for_bit(task, tmp_path):
    if task in ENGINES:
        pytest.importorskip(ENGINES[task])
    check(task, tmp_path)


@pytest.mark.parametrize("n_envs", [1, 3])
@pytest.mark.parametrize("window_end", ["timed", "reached"])
def test_with_running_episodes_and_memory(n_envs, window_end, tmp_path):
    """With several environments the others are in the middle of their episodes when one ends."""
    settings = {"window_end": window_end, "memory": "episode", "testing_fraction": 0.5}
    check("UR5Reacher", tmp_path, n_envs, 2500, 5000, **settings)


def test_with_all_that_has_randomness_of_its_own(tmp_path):
    check("Pendulum", tmp_path, 2, 1500, 4000, duration_loss_coef=0.1, memory="window", sequence_length=3)


def test_of_a_perturbed_task(tmp_path):
    """Noise and physics come from a generator of the wrapper's own."""
    perturb = {"observation_noise": 0.05, "dynamics_scale": {"mass": [0.8, 1.2]}, "action_delay": 1}
    check("Pendulum", tmp_path, 2, 2500, 5000, {"perturb": perturb})


def test_states_of_another_moment_are_left_alone(tmp_path, caplog):
    model = make("Pendulum", make_envs("sb3_tbc/Pendulum-v0", 1, 0)).learn(1200)
    model.save_replay_buffer(tmp_path / "replay.npz")
    other = make("Pendulum", make_envs("sb3_tbc/Pendulum-v0", 1, 0)).learn(300)
    other.load_replay_buffer(tmp_path / "replay.npz")
    before = other.high.noise_rng.bit_generator.state
    with caplog.at_level(logging.WARNING):
        other.learn(1, reset_num_timesteps=False)
    assert f"saved after {model.num_timesteps} steps, the agent after" in caplog.text
    assert other.high.noise_rng.bit_generator.state == before
    assert other.replay_buffer.low.size() == model.replay_buffer.low.size()


@pytest.mark.parametrize("kind", [DummyVecEnv, GoalVecEnv])
def test_environments_that_cannot_be_brought_back_begin_anew(kind, tmp_path, caplog):
    """SB3's vector does not say how its episodes began; the corridor counts episodes, whatever the seed."""
    model = make("corridor", kind([Corridor]))
    save = SaveOnce(tmp_path, 200)
    model.learn(400, callback=save)
    resumed = TBCHRL.load(tmp_path / "model.zip", env=kind([Corridor]))
    resumed.load_replay_buffer(tmp_path / "replay.npz")
    with caplog.at_level(logging.WARNING):
        resumed.learn(200, reset_num_timesteps=False)
    assert "begin new episodes" in caplog.text
    assert resumed.num_timesteps >= save.saved_at + 200


def test_timed_checkpoints_are_taken_between_rollouts():
    taken = []
    callback = TimedCheckpointCallback(lambda: taken.append(model.num_timesteps), seconds=0.0)
    model = make("corridor", GoalVecEnv([Corridor]))
    model.learn(200, callback=callback)
    assert len(taken) > 2
