"""The flat baseline: as many updates as asked for, resumed to the bit, learnt in chunks, stopped at any time."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
import torch as th
from checks import assert_same
from corridor import Corridor
from stable_baselines3.common.callbacks import BaseCallback, StopTrainingOnMaxEpisodes
from stable_baselines3.common.monitor import Monitor
from stable_baselines3.common.vec_env import DummyVecEnv

from sb3_tbc.smdp.goal_vec_env import GoalVecEnv
from sb3_tbc.tbc_hrl.flat_sac import FlatSAC


def make(n_envs: int = 1, env: Any = None, **kwargs: Any) -> FlatSAC:
    env = env or GoalVecEnv([lambda: Monitor(Corridor(30)) for _ in range(n_envs)])
    given = {
        "batch_size": 16,
        "gradient_ratio": 0.15,
        "policy_kwargs": {"net_arch": [8, 8]},
        "seed": 0,
        "buffer_size": 2000,
    }
    return FlatSAC("MultiInputPolicy", env, **{**given, **kwargs})


def contents(model: FlatSAC) -> dict[str, Any]:
    buffer: Any = model.replay_buffer
    found = {key: value.numpy().copy() for key, value in model.policy.state_dict().items()}
    for name in ("actor", "critic"):
        moments = getattr(model.policy, name).optimizer.state_dict()["state"]
        found |= {f"{name}.{i}.{key}": part.numpy().copy() for i, m in moments.items() for key, part in m.items()}
    rows = buffer.pos
    found |= {f"replay.{key}": part[:rows].copy() for key, part in buffer.observations.items()}
    found |= {"actions": buffer.actions[:rows].copy(), "ends": buffer.dones[:rows].copy()}
    return {**found, "updates": model._n_updates, "steps": model.num_timesteps, "episodes": model._episode_num}


@pytest.mark.parametrize("n_envs", [1, 8])
def test_does_the_updates_asked_for(n_envs: int) -> None:
    model = make(n_envs, gradient_ratio=0.25, learning_starts=0).learn(800)
    assert abs(model._n_updates - 200) <= 27  # a burst's steps at most are still to come
    assert model._n_updates == model._updated_at // 4
    idle = make(n_envs, gradient_ratio=0.0).learn(200)
    assert idle._n_updates == 0


def test_an_averaged_actor_is_what_is_evaluated(tmp_path: Any) -> None:
    plain, model = (make(gradient_ratio=0.1, average_decay=decay).learn(300) for decay in (0.0, 0.9))
    for name, value in plain.policy.state_dict().items():  # learning itself is the same
        np.testing.assert_array_equal(model.policy.state_dict()[name].numpy(), value.numpy(), err_msg=name)
    observation = Corridor().reset(seed=0)[0]
    acts = [m.predict(observation, deterministic=True)[0] for m in (plain, model)]
    assert not np.array_equal(*acts)
    model.save(tmp_path / "model.zip")
    loaded = FlatSAC.load(tmp_path / "model.zip", env=GoalVecEnv([Corridor]))
    np.testing.assert_array_equal(loaded.predict(observation, deterministic=True)[0], acts[1])
    average = [p.detach().numpy().copy() for p in model.policy.average_actor.parameters()]
    model.train(1, 16)
    keep = min(0.9, (1 + model._n_updates) / (10 + model._n_updates))
    parameters = zip(average, model.policy.average_actor.parameters(), model.actor.parameters(), strict=True)
    for before, after, now in parameters:
        np.testing.assert_allclose(after.numpy(), keep * before + (1 - keep) * now.detach().numpy(), atol=1e-6)


@pytest.mark.parametrize("decay", [0.0, 0.99])
@pytest.mark.parametrize("n_envs", [1, 2])
def test_chunks_learn_what_one_call_learns(n_envs: int, decay: float) -> None:
    expected = contents(make(n_envs, gradient_ratio=0.05, average_decay=decay).learn(480))
    for chunks in ([240, 240], [100, 2, 6, 212, 160], [20] * 24):
        model = make(n_envs, gradient_ratio=0.05, average_decay=decay)
        for steps in chunks:
            model.learn(steps, reset_num_timesteps=False)
        assert_same(expected, contents(model))


@pytest.mark.parametrize("n_envs", [1, 3])
@pytest.mark.parametrize("half_way", [240])
def test_goes_on_bit_for_bit(n_envs: int, half_way: int, tmp_path: Any) -> None:
    from sb3_tbc.zoo.environments import make_envs

    def agent() -> FlatSAC:
        given: dict[str, Any] = {
            "batch_size": 16,
            "buffer_size": 2000,
            "gradient_ratio": 0.05,
            "policy_kwargs": {"net_arch": [8, 8]},
        }
        return FlatSAC("MultiInputPolicy", make_envs("sb3_tbc/UR5Reacher-v0", n_envs, 0), seed=0, **given)

    expected = contents(agent().learn(2 * half_way))
    half = agent().learn(half_way)
    half.save(tmp_path / "model.zip")
    half.save_replay_buffer(tmp_path / "replay.npz")
    loaded = FlatSAC.load(tmp_path / "model.zip", env=make_envs("sb3_tbc/UR5Reacher-v0", n_envs, 9))
    loaded.load_replay_buffer(tmp_path / "replay.npz")
    th.manual_seed(1)
    np.random.seed(1)  # noqa: NPY002
    assert_same(expected, contents(loaded.learn(half_way, reset_num_timesteps=False)))


def test_other_vectors_begin_new_episodes_and_say_so(tmp_path: Any, caplog: Any) -> None:
    model = FlatSAC(
        "MultiInputPolicy", DummyVecEnv([Corridor]), batch_size=16, buffer_size=2000, gradient_ratio=0.1, seed=0
    ).learn(130)
    model.save(tmp_path / "model.zip")
    model.save_replay_buffer(tmp_path / "replay.npz")
    loaded = FlatSAC.load(tmp_path / "model.zip", env=DummyVecEnv([Corridor]))
    del loaded.replay_buffer
    loaded.load_replay_buffer(tmp_path / "replay.npz")
    loaded.learn(100, reset_num_timesteps=False)
    assert "begin new episodes" in caplog.text
    assert loaded.num_timesteps == 230
    assert loaded.replay_buffer is not None


def assert_episodes_are_whole(buffer: Any) -> None:
    """Every row that is sampled lies within its episode, all of whose rows are of the same one of the corridor."""
    for row, env in zip(*np.nonzero(buffer.ep_length), strict=True):
        start, length = buffer.ep_start[row, env], buffer.ep_length[row, env]
        assert (row - start) % buffer.buffer_size < length
        rows = (start + np.arange(length)) % buffer.buffer_size
        lived = buffer.observations["observation"][rows, env, 2]
        assert len(set(lived)) == 1, f"one episode of {length} steps is of several: {lived}"


@pytest.mark.parametrize("n_envs", [1, 2])
@pytest.mark.parametrize("steps", [40, 230])
@pytest.mark.parametrize("size", [40, 80, 300])
def test_replay_loads_into_a_larger_buffer(n_envs: int, steps: int, size: int, tmp_path: Any) -> None:
    model = make(n_envs, buffer_size=80 * n_envs, gradient_ratio=0.0).learn(steps * n_envs)
    model.save(tmp_path / "model.zip")
    model.save_replay_buffer(tmp_path / "replay.npz")
    env = GoalVecEnv([lambda: Corridor(30)] * n_envs)
    loaded = FlatSAC.load(tmp_path / "model.zip", env=env, buffer_size=size * n_envs, gradient_ratio=0.02)
    if size < min(steps, 80):
        with pytest.raises(ValueError, match="does not fit"):
            loaded.load_replay_buffer(tmp_path / "replay.npz")
        return
    buffer: Any = loaded.replay_buffer
    buffer.ep_length[:] = 7  # of what was in it before
    loaded.load_replay_buffer(tmp_path / "replay.npz", truncate_last_traj=False)
    assert buffer.size() == model.replay_buffer.size()
    assert (buffer.steps() == model.replay_buffer.steps()).all()
    assert (buffer.ep_length > 0).sum() == (model.replay_buffer.ep_length > 0).sum() > 0
    assert_episodes_are_whole(buffer)
    loaded.learn(200, reset_num_timesteps=False)
    assert_episodes_are_whole(buffer)


@pytest.mark.parametrize("how", ["learn again", "other environments", "loaded, learn anew", "loaded, not to be closed"])
def test_no_episode_runs_across_a_reset(how: str, tmp_path: Any) -> None:
    def env(episode: int = 0) -> Any:
        corridor = Corridor(50, goal=2.0)
        corridor.episode = episode
        return corridor

    kind = DummyVecEnv if how.endswith("closed") else GoalVecEnv
    model = make(env=kind([env]), gradient_ratio=0.0).learn(30)
    model.save(tmp_path / "model.zip")
    model.save_replay_buffer(tmp_path / "replay.npz")
    if how.startswith("loaded"):
        model = FlatSAC.load(tmp_path / "model.zip", env=kind([lambda: env(9)]))
        model.load_replay_buffer(tmp_path / "replay.npz", truncate_last_traj=how.endswith("anew"))
    elif how == "other environments":
        model.set_env(env(9))
    model.learn(70, reset_num_timesteps=how in ("learn again", "loaded, learn anew"))
    buffer: Any = model.replay_buffer
    assert_episodes_are_whole(buffer)
    assert [int(buffer.ep_length[row, 0]) for row in (0, 30, 80)] == [30, 50, 0]
    assert buffer.timeouts[29, 0]


def test_other_environments_have_their_own_goal_test(tmp_path: Any) -> None:
    class Wide(Corridor):
        """Every goal is met everywhere."""

        def compute_reward(self, achieved_goal: Any, desired_goal: Any, info: Any) -> Any:
            return np.full(np.shape(achieved_goal)[:-1], 7.0)

    model = make(gradient_ratio=0.0, n_hindsight_goals=3).learn(120)
    model.save(tmp_path / "model.zip")
    model.set_env(Wide(30))
    loaded = FlatSAC.load(tmp_path / "model.zip")
    with pytest.raises(ValueError, match="call set_env first"):
        loaded.learn(10)
    loaded.set_env(Wide(30))
    loaded.learn(120, reset_num_timesteps=False)
    for agent in (model, loaded):
        buffer: Any = agent.replay_buffer
        assert buffer.env is agent.env
        assert (buffer.sample(16).rewards[4:] == 7.0).all()  # three of four are relabelled


def test_environments_without_the_event_of_the_goals_are_refused() -> None:
    model = make()
    model.settings["goal_strategy"] = "event"
    with pytest.raises(ValueError, match="names none"):
        model.set_env(Corridor(30))


@pytest.mark.parametrize("name", ["actor_learning_rate", "ent_coef_learning_rate", "subgoals", "train_freq", "high"])
def test_loading_refuses_what_is_never_used(name: str, tmp_path: Any) -> None:
    make().save(tmp_path / "model.zip")
    assert FlatSAC.load(tmp_path / "model.zip", use_sde=False, action_noise=None).use_sde is False
    with pytest.raises(ValueError, match=f"{name} is n"):
        FlatSAC.load(tmp_path / "model.zip", **{name: 0.5})


def test_settings_that_loading_changes_are_applied(tmp_path: Any) -> None:
    def loaded(**changes: Any) -> FlatSAC:
        model = FlatSAC.load(tmp_path / "model.zip", env=GoalVecEnv([Corridor]), **changes)
        assert changes.items() <= model.settings.items()
        return model

    taught = make(gradient_ratio=0.1).learn(300)
    taught.save(tmp_path / "model.zip")
    assert loaded(n_hindsight_goals=0).replay_buffer.her_ratio == 0.0
    episode: Any = loaded(goal_strategy="episode").replay_buffer
    assert (episode.goal_selection_strategy.name, episode.her_ratio) == ("EPISODE", 0.75)
    assert loaded(learning_rate="lin_1e-3").lr_schedule(0.5) == pytest.approx(5e-4)
    assert (loaded(gamma=0.5).gamma, loaded(gradient_ratio=2.0).gradient_ratio) == (0.5, 2.0)
    assert FlatSAC.load(tmp_path / "model.zip", target_entropy="auto").target_entropy == -1.0

    averaged = loaded(average_decay=0.9)
    for average, parameter in zip(averaged.policy.average_actor.parameters(), taught.actor.parameters(), strict=True):
        np.testing.assert_array_equal(average.numpy(), parameter.detach().numpy())
    averaged.learn(200, reset_num_timesteps=False)
    assert averaged._n_updates > taught._n_updates
    averaged.save(tmp_path / "averaged.zip")
    FlatSAC.load(tmp_path / "averaged.zip", average_decay=0.0)

    fixed = loaded(ent_coef=0.1)
    assert (fixed.ent_coef_optimizer, fixed.log_ent_coef) == (None, None)
    fixed.learn(200, reset_num_timesteps=False).save(tmp_path / "fixed.zip")
    assert FlatSAC.load(tmp_path / "fixed.zip").ent_coef_tensor.item() == pytest.approx(0.1)
    assert FlatSAC.load(tmp_path / "fixed.zip", ent_coef=0.3).ent_coef_tensor.item() == pytest.approx(0.3)
    assert FlatSAC.load(tmp_path / "fixed.zip", ent_coef="auto_0.3").log_ent_coef.exp().item() == pytest.approx(0.3)

    assert loaded(policy_kwargs={"net_arch": [8, 8], "n_critics": 2}).policy_kwargs["n_critics"] == 2
    for changes, said in (
        ({"policy_kwargs": {"net_arch": [16]}}, "policy_kwargs cannot be changed when an agent is loaded"),
        ({"policy_kwargs": 3}, "policy_kwargs must be"),
        ({"goal_strategy": "event"}, "names none"),
        ({"tau": 2.0}, "tau must be"),
    ):
        with pytest.raises(ValueError, match=said):
            loaded(**changes)


class StopAt(BaseCallback):
    def _on_step(self) -> bool:
        self.model.stop_requested |= self.num_timesteps >= 130
        return True


def test_stops_when_asked_and_goes_on_exactly() -> None:
    expected = contents(make().learn(400))
    model = make().learn(400, callback=StopAt())
    assert 130 <= model.num_timesteps < 400
    model.stop_requested = False
    assert_same(expected, contents(model.learn(400 - model.num_timesteps, reset_num_timesteps=False)))


def test_sb3s_callbacks_and_clear_refusals() -> None:
    model = make().learn(5000, callback=StopTrainingOnMaxEpisodes(5))
    assert model._episode_num == 5
    with pytest.raises(TypeError, match="got '1000'"):
        model.learn("1000")  # type: ignore[arg-type]
    with pytest.raises(ValueError, match="got -5"):
        model.learn(-5)


@pytest.mark.parametrize("size", [20, 21])
def test_episodes_that_just_fill_the_buffer_are_learned_from(size: int) -> None:
    model = FlatSAC("MultiInputPolicy", Corridor(20, goal=5.0), seed=0, buffer_size=size, batch_size=8)
    model.learn(200)
    assert model._n_updates == 100  # it begins after a hundred steps
    assert set(model._her_buffer().ep_length.ravel()) <= {0, 20}
