"""HAC and flat SAC: what makes them what they are, and that they go through the same doors."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch as th
from corridor import Corridor
from stable_baselines3 import SAC

from sb3_tbc import HAC, TBCHRL
from sb3_tbc.errors import ConfigError
from sb3_tbc.tbc_hrl.evaluation import evaluate_agent
from sb3_tbc.tbc_hrl.flat_sac import FlatSAC
from sb3_tbc.zoo.algorithms import algorithm_of, load_model, read_zip

LEVEL: dict[str, Any] = {"batch_size": 16, "policy_kwargs": {"net_arch": [8, 8]}}


def make_hac(**kwargs: Any) -> HAC:
    settings = {"high": LEVEL, "low": LEVEL, "max_options": 5, "gradient_ratio": 0.1, "compile": False, "seed": 0}
    return HAC("MultiInputPolicy", Corridor(), **{**settings, **kwargs})


def make_flat(**kwargs: Any) -> FlatSAC:
    settings = {"gradient_ratio": 0.05, "batch_size": 16, "buffer_size": 500, "learning_starts": 50, "seed": 0}
    return FlatSAC("MultiInputPolicy", Corridor(), **{**settings, "policy_kwargs": {"net_arch": [8]}, **kwargs})


def test_hac_has_no_time() -> None:
    model = make_hac()
    assert isinstance(model, TBCHRL)
    assert model.high.action_space.shape == (1,)  # a subgoal, no time budget
    assert model.low.observation_space.shape == (4,)  # local state and subgoal, no remaining time
    assert model.low.state_dim == 0
    for level in (model.high, model.low):  # all rewards are -1 or 0
        assert level.policy.critic.negative
    gamma = model.high_settings["gamma"]  # per decision, however long it took
    assert model.high_reward.discounts(np.array([1, 7])).tolist() == [gamma, gamma]
    assert model.high_reward.duration_cost == 0


def test_hac_low_level_acts_until_its_subgoal_or_its_own_budget() -> None:
    model = make_hac(dt_max=6.5, gradient_ratio=0.0, max_options=20).learn(250)
    data, n = model.replay_buffer.low.data, model.replay_buffer.low.size()
    rows = {name: array[:n] for name, array in data.items()}
    assert rows["length"].max() == 7  # 6.5 actions are seven
    reached = np.abs(rows["achieved"] - rows["subgoal"]) < 0.05
    np.testing.assert_array_equal(rows["rewards"], reached - 1.0)
    np.testing.assert_array_equal(rows["dones"], reached)  # a used-up budget bootstraps
    last = rows["position"] == rows["length"] - 1
    assert (last | ~reached).all()  # a window ends where its subgoal is reached


def test_hac_learns_saves_and_loads(tmp_path: Path) -> None:
    model = make_hac().learn(150)
    assert min(model.high._n_updates, model.low._n_updates) > 0
    model.save(tmp_path / "model.zip")
    assert algorithm_of(tmp_path / "model.zip", read_zip(tmp_path / "model.zip")) == "hac"
    loaded = HAC.load(tmp_path / "model.zip", env=Corridor())
    ours, theirs = (evaluate_agent(m, Corridor(), 3, seed=1) for m in (model, loaded))
    np.testing.assert_array_equal(ours.lengths, theirs.lengths)


def test_hac_levels_may_take_hindsight_goals_from_different_places() -> None:
    model = make_hac(low={**LEVEL, "goal_strategy": "episode", "n_hindsight_goals": 4})
    assert model.replay_buffer.low.hindsight == "episode"
    assert model.replay_buffer.low.n_hindsight_goals == 4
    assert model.store.hindsight.goal_strategy == "future"


def test_flat_sac_learns_and_is_evaluated() -> None:
    model = make_flat().learn(300)
    assert model._n_updates == int(0.05 * (300 - 50))  # steps before learning_starts owe none
    result = evaluate_agent(model, Corridor(), 3, seed=1)
    assert result.lengths.max() <= 50
    assert np.isnan(result.subgoal_success).all()
    assert not result.budget_exhausted.any()
    np.testing.assert_array_equal(result.lengths, evaluate_agent(model, Corridor(), 3, seed=1).lengths)


def test_relabelled_transitions_that_meet_their_goal_are_terminal() -> None:
    model = make_flat(gradient_ratio=0.01, n_hindsight_goals=1000).learn(200)
    samples = model.replay_buffer.sample(200)
    reached = (samples.next_observations["achieved_goal"] - samples.observations["desired_goal"]).abs() <= 0.05
    assert 0 < reached.float().mean() < 1
    assert th.equal(samples.dones.bool(), reached)
    assert th.equal(samples.rewards, reached.float() - 1)


class Pit(Corridor):
    """Whoever comes below -0.2 falls, which ends the episode without success."""

    def step(self, action: Any) -> Any:
        observation, reward, terminated, *rest = super().step(action)
        return observation, reward, terminated or self.position < -0.2, *rest


def test_relabelled_falls_are_terminal() -> None:
    settings = {"buffer_size": 500, "learning_starts": 1000, "goal_strategy": "episode", "seed": 0}
    buffer = FlatSAC("MultiInputPolicy", Pit(20, goal=0.9), **settings).learn(400).replay_buffer
    rows = np.flatnonzero(buffer.ep_length[:, 0])  # of whole episodes
    fell = buffer.next_observations["achieved_goal"][rows, 0] < -0.2
    samples = buffer._get_virtual_samples(rows, np.zeros_like(rows))
    met = (samples.next_observations["achieved_goal"] - samples.observations["desired_goal"]).abs().numpy() <= 0.05
    assert 0 < (fell & ~met).sum() < met.sum() < len(rows)
    np.testing.assert_array_equal(samples.dones.bool().numpy(), met | fell)


def test_flat_replay_resumes_from_plain_arrays(tmp_path: Path) -> None:
    model = make_flat().learn(300)
    model.save(tmp_path / "model.zip")
    model.save_replay_buffer(tmp_path / "replay.pkl")
    loaded = FlatSAC.load(tmp_path / "model.zip", env=Corridor())
    loaded.load_replay_buffer(tmp_path / "replay.pkl")
    ours, theirs = model.replay_buffer, loaded.replay_buffer
    assert theirs.pos == ours.pos == 300
    assert ours.ep_length[:300].min() == 0
    for key in ours.observations:
        np.testing.assert_array_equal(theirs.observations[key], ours.observations[key])
    np.testing.assert_array_equal(theirs.ep_length, ours.ep_length)  # the unfinished episode goes on
    loaded.learn(100, reset_num_timesteps=False)
    assert loaded.num_timesteps == 400
    small = make_flat(buffer_size=100)
    with pytest.raises(ValueError, match="does not fit"):
        small.load_replay_buffer(tmp_path / "replay.pkl")


@pytest.mark.parametrize("decay", [0.0, 0.9])
def test_flat_agents_saved_in_python_are_known_for_what_they_are(decay: float, tmp_path: Path) -> None:
    model = make_flat(average_decay=decay)
    model.save(tmp_path / "flat.zip")
    loaded = load_model(tmp_path / "flat.zip")
    assert type(loaded) is FlatSAC
    observation = model.observation_space.sample()
    actions = [agent.predict(observation, deterministic=True)[0] for agent in (model, loaded)]
    np.testing.assert_array_equal(*actions)
    SAC("MultiInputPolicy", Corridor(), buffer_size=10).save(tmp_path / "sb3.zip")
    with pytest.raises(ConfigError, match="of another algorithm"):
        load_model(tmp_path / "sb3.zip")


def test_flat_mistakes() -> None:
    with pytest.raises(ValueError, match="gradient_ratio must be a number from 0 to"):
        make_flat(gradient_ratio=-1)
