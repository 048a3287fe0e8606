"""The methods of an agent, as SB3's users call them."""

from __future__ import annotations

import copy
import io
from pathlib import Path
from typing import Any

import cloudpickle
import gymnasium as gym
import numpy as np
import pytest
import torch as th
from contract import ALGORITHMS, corridor, every_algorithm, make, shows, two_levels
from stable_baselines3.common.env_util import make_vec_env
from stable_baselines3.common.evaluation import evaluate_policy
from stable_baselines3.common.logger import configure
from stable_baselines3.common.monitor import Monitor
from stable_baselines3.common.vec_env import DummyVecEnv, VecNormalize

from sb3_tbc.errors import ConfigError

OBSERVATION = corridor().reset(seed=0)[0]


def act(model: Any) -> np.ndarray:
    return model.predict(OBSERVATION, deterministic=True)[0]


def weights(model: Any) -> dict[str, th.Tensor]:
    return {name: tensor.clone() for name, tensor in model.policy.state_dict().items()}


def same(one: dict[str, th.Tensor], other: dict[str, th.Tensor]) -> bool:
    return one.keys() == other.keys() and all(th.equal(one[name], other[name]) for name in one)


@shows("yes", "learn", "train", "collect_rollouts", "dump_logs")
@every_algorithm
@pytest.mark.parametrize("n_envs", [1, 3])
def test_learns(algo: str, n_envs: int, capsys: Any) -> None:
    model = make(algo, make_vec_env(corridor, n_envs), verbose=1)
    before = weights(model)
    assert model.learn(210, log_interval=1) is model
    assert model.num_timesteps >= 210
    assert model._n_updates > 0
    assert not same(before, weights(model))
    assert "ep_rew_mean" in capsys.readouterr().out


@shows("yes", "learn(reset_num_timesteps=False)")
@every_algorithm
def test_several_calls_learn_what_one_does(algo: str) -> None:
    whole, parts = make(algo).learn(240), make(algo)
    for steps in (7, 100, 33, 100):
        parts.learn(steps, reset_num_timesteps=False)
    assert parts.num_timesteps == whole.num_timesteps == 240
    assert same(weights(whole), weights(parts))


@shows("yes", "seed")
@every_algorithm
def test_a_seed_decides_all(algo: str) -> None:
    runs = [weights(make(algo, seed=seed).learn(150)) for seed in (4, 4, 5)]
    assert same(runs[0], runs[1])
    assert not same(runs[0], runs[2])


@shows("yes", "predict")
@every_algorithm
@pytest.mark.parametrize("n_envs", [1, 3])
def test_predicts_for_one_and_for_many(algo: str, n_envs: int) -> None:
    model = make(algo)
    action, state = model.predict(OBSERVATION)
    assert action.shape == model.action_space.shape
    assert model.action_space.contains(action)
    np.testing.assert_array_equal(act(model), act(model))
    venv = make_vec_env(corridor, n_envs)
    seen: Any = venv.reset()
    for step in range(30):
        actions, state = model.predict(seen, state=state if step else None, episode_start=np.full(n_envs, step == 0))
        assert actions.shape == (n_envs, 1)
        seen, *_ = venv.step(actions)


@shows("refused", "predict(<tuple>)")
@two_levels
def test_gyms_reset_is_not_an_observation(algo: str) -> None:
    with pytest.raises(ValueError, match="mixing Gym API"):
        make(algo).predict(corridor().reset())  # type: ignore[arg-type]


@shows("yes", "save", "load", "load(custom_objects=)", "load(print_system_info=)")
@every_algorithm
@pytest.mark.parametrize("to", ["path", "text", "file"])
def test_a_loaded_agent_acts_and_learns_on(algo: str, to: str, tmp_path: Path, capsys: Any) -> None:
    model = make(algo).learn(100)
    place: Any = {"path": tmp_path / "a.zip", "text": str(tmp_path / "b"), "file": io.BytesIO()}[to]
    model.save(place)
    given = {"custom_objects": {"seed": 7}, "print_system_info": True}
    loaded = ALGORITHMS[algo].load(place, env=corridor(), device="auto", **given)
    assert "Stable-Baselines3" in capsys.readouterr().out
    assert loaded.seed == 7
    assert loaded.device.type == "cpu"
    np.testing.assert_array_equal(act(loaded), act(model))
    assert same(weights(model), weights(loaded))
    loaded.learn(150, reset_num_timesteps=False)
    assert loaded.num_timesteps == 250
    assert not same(weights(model), weights(loaded))


@shows("yes", "save(exclude=, include=)")
@two_levels
def test_what_is_saved_can_be_chosen(algo: str, tmp_path: Path) -> None:
    model = make(algo, verbose=2)
    model.save(tmp_path / "a.zip", exclude=["verbose"])
    assert ALGORITHMS[algo].load(tmp_path / "a.zip").verbose != 2
    model.save(tmp_path / "b.zip", exclude=["verbose"], include=["verbose"])
    assert ALGORITHMS[algo].load(tmp_path / "b.zip").verbose == 2


@shows("yes", "load(<setting>=)")
@two_levels
def test_settings_change_while_loading(algo: str, tmp_path: Path) -> None:
    make(algo).save(tmp_path / "a.zip")
    loaded = ALGORITHMS[algo].load(tmp_path / "a.zip", env=corridor(), low={"learning_rate": 1e-4}, max_options=4)
    assert loaded.low_settings["learning_rate"] == 1e-4
    assert loaded.max_options == 4
    assert loaded.dt_max == 5.0


@shows("yes", "load without env")
@every_algorithm
def test_an_agent_acts_without_an_environment(algo: str, tmp_path: Path) -> None:
    model = make(algo)
    model.save(tmp_path / "a.zip")
    loaded = ALGORITHMS[algo].load(tmp_path / "a.zip")
    np.testing.assert_array_equal(act(loaded), act(model))
    with pytest.raises(ValueError, match="needs an environment"):
        loaded.learn(10)


@shows("yes", "model.gradient_ratio = ..., model.learning_starts = ...")
@two_levels
def test_some_settings_can_be_set(algo: str) -> None:
    model: Any = make(algo, gradient_ratio=0.0)
    model.gradient_ratio, model.learning_starts = 0.5, 100
    model.learn(200)
    assert 0 < model.low._n_updates <= 50
    assert model.settings["gradient_ratio"] == 0.5
    with pytest.raises(ValueError, match="gradient_ratio"):
        model.gradient_ratio = -1.0


@shows("refused", "model.<other setting> = ...")
@two_levels
@pytest.mark.parametrize("name", ["max_options", "train_freq", "action_noise", "n_hindsight_goals"])
def test_other_settings_are_not_taken_in_silence(algo: str, name: str) -> None:
    model: Any = make(algo)
    with pytest.raises(AttributeError, match=f"{name} is (fixed|nothing that can be set)"):
        setattr(model, name, 3)


@shows("refused", "replay_buffer.<attribute of SB3's buffer>")
@two_levels
@pytest.mark.parametrize("name", ["device", "pos", "size"])
def test_what_one_buffer_has_is_told_of_two(algo: str, name: str) -> None:
    with pytest.raises(AttributeError, match=r"there are two: replay_buffer\.high and"):
        getattr(make(algo).replay_buffer, name)


@shows("refused", "policy.actor.predict")
@two_levels
def test_both_levels_act_through_the_policy(algo: str) -> None:
    with pytest.raises(TypeError, match=r"use policy\.predict"):
        make(algo).policy.actor.predict({})


@shows("refused", "load(<unknown>=)")
@every_algorithm
def test_loading_takes_nothing_that_it_does_not_know(algo: str, tmp_path: Path) -> None:
    make(algo).save(tmp_path / "a.zip")
    with pytest.raises(ValueError, match="gradient_rate is nothing that loading can change; did you mean"):
        ALGORITHMS[algo].load(tmp_path / "a.zip", env=corridor(), gradient_rate=0.9)
    with pytest.raises(ValueError, match="belongs to a level" if algo != "sac" else "gamma must be a number"):
        ALGORITHMS[algo].load(tmp_path / "a.zip", env=corridor(), gamma=1.9)


@shows("yes", "agents with SubgoalSpace.from_slices")
@two_levels
def test_subgoals_that_are_data_are_loaded_with_their_agent(algo: str, tmp_path: Path) -> None:
    make(algo).learn(40).save(tmp_path / "a.zip")
    loaded = ALGORITHMS[algo].load(tmp_path / "a.zip", env=corridor())
    assert loaded.subgoals.is_data
    assert loaded.learn(60).num_timesteps == 60


@shows("yes", "num_timesteps")
@every_algorithm
def test_steps_that_were_not_done_owe_no_updates(algo: str) -> None:
    model = make(algo).learn(200)
    updates, model.num_timesteps = model._n_updates, 20_000
    model.learn(200, reset_num_timesteps=False)
    assert updates < model._n_updates <= updates + 60


@shows("yes", "device")
@pytest.mark.skipif(th.cuda.is_available(), reason="there is a GPU")
@every_algorithm
def test_an_agent_of_a_gpu_loads_without_one(algo: str, tmp_path: Path) -> None:
    make(algo).save(tmp_path / "a.zip")
    with pytest.warns(UserWarning, match="'cuda' is not there: the agent is loaded on the CPU"):
        loaded = ALGORITHMS[algo].load(tmp_path / "a.zip", env=corridor(), device="cuda")
    assert loaded.device.type == loaded.policy.device.type == "cpu"
    with pytest.raises(ValueError, match="needs a GPU" if algo == "sac" else "both levels act and learn on the CPU"):
        make(algo, device="cuda")


@two_levels
def test_auto_is_the_cpu_where_there_is_a_gpu(algo: str, monkeypatch: pytest.MonkeyPatch) -> None:
    def gpu(device: Any) -> th.device:
        return th.device("meta" if device == "auto" else device)

    monkeypatch.setattr("stable_baselines3.common.base_class.get_device", gpu)
    assert make(algo, device="auto").device.type == "cpu"


@shows("yes", "save_replay_buffer", "load_replay_buffer")
@every_algorithm
def test_replay_is_kept(algo: str, tmp_path: Path) -> None:
    expected = make(algo, make_vec_env(corridor, 2)).learn(300)
    model = make(algo, make_vec_env(corridor, 2)).learn(200)
    model.save(tmp_path / "a.zip")
    model.save_replay_buffer(tmp_path / "new" / "replay.npz")
    loaded = ALGORITHMS[algo].load(tmp_path / "a.zip", env=make_vec_env(corridor, 2))
    loaded.load_replay_buffer(tmp_path / "new" / "replay.npz")
    loaded.learn(100, reset_num_timesteps=False)
    assert loaded.num_timesteps == expected.num_timesteps
    assert loaded._n_updates > model._n_updates


def _flat(parameters: Any) -> Any:
    """Parameters as plain numbers, which can be compared."""
    if isinstance(parameters, dict):
        return {name: _flat(value) for name, value in parameters.items()}
    return parameters.tolist() if hasattr(parameters, "tolist") else parameters


@shows("yes", "get_parameters", "set_parameters")
@every_algorithm
def test_parameters_travel(algo: str) -> None:
    taught, fresh = make(algo).learn(100), make(algo, seed=3)
    parameters = copy.deepcopy(taught.get_parameters())
    fresh.set_parameters(taught.get_parameters())
    np.testing.assert_array_equal(act(fresh), act(taught))
    fresh.learn(200)
    assert fresh._n_updates
    assert _flat(taught.get_parameters()) == _flat(parameters)  # the optimizers' moments, too
    fresh.set_parameters(parameters)
    with pytest.raises(ValueError, match="nonsense"):
        fresh.set_parameters({**parameters, "nonsense": {}})
    with pytest.raises(ValueError, match="parameters"):
        fresh.set_parameters(dict(list(parameters.items())[:-1]), exact_match=True)


@shows("yes", "policy.state_dict, policy.load_state_dict")
@every_algorithm
def test_weights_loaded_into_the_policy_act(algo: str) -> None:
    taught, fresh = make(algo).learn(100), make(algo, seed=3)
    fresh.policy.load_state_dict(taught.policy.state_dict())
    np.testing.assert_array_equal(act(fresh), act(taught))


@shows("refused", "policy.save, policy.load")
@two_levels
def test_policies_are_saved_with_their_agent(algo: str, tmp_path: Path) -> None:
    policy: Any = make(algo).policy
    with pytest.raises(TypeError, match=r"model\.save"):
        policy.save(tmp_path / "p")
    with pytest.raises(TypeError, match=r"TBCHRL\.load"):
        type(policy).load(tmp_path / "p")


@shows(
    "yes",
    "policy.predict",
    "policy.obs_to_tensor, policy.is_vectorized_observation",
    "policy.scale_action, policy.unscale_action",
    "policy.parameters_to_vector, policy.load_from_vector",
    "policy.set_training_mode, policy.device, policy.squash_output",
)
@two_levels
def test_the_policy_does_what_sb3s_does(algo: str) -> None:
    model = make(algo)
    policy: Any = model.policy
    np.testing.assert_array_equal(policy.predict(OBSERVATION, deterministic=True)[0], act(model))
    batch = {key: part[None] for key, part in OBSERVATION.items()}
    assert policy.is_vectorized_observation(batch)
    tensors, vectorised = policy.obs_to_tensor(OBSERVATION)
    assert not vectorised
    assert tensors["observation"].shape == (1, 3)
    np.testing.assert_allclose(policy.unscale_action(policy.scale_action(np.array([0.3]))), [0.3], atol=1e-6)
    policy.set_training_mode(False)
    assert policy.squash_output
    assert policy.device.type == "cpu"
    assert policy(batch, deterministic=True).shape == (1, 1)
    vector, before = policy.parameters_to_vector(), act(model)
    policy.load_from_vector(np.zeros_like(vector))
    assert not np.array_equal(policy.parameters_to_vector(), vector)
    assert not np.array_equal(act(model), before)
    policy.load_from_vector(vector)
    np.testing.assert_array_equal(act(model), before)


@shows("yes", "policy.parameters changed in place")
@two_levels
@pytest.mark.parametrize("how", ["no_grad", "data"])
@pytest.mark.parametrize("factor", [1.5, -1.0])
def test_weights_changed_by_hand_act(algo: str, how: str, factor: float) -> None:
    model = make(algo)
    before = act(model)
    for parameter in model.policy.parameters():
        with th.no_grad():
            (parameter.data if how == "data" else parameter).mul_(factor)
    assert not np.array_equal(act(model), before)
    model.learn(60)


@shows("not applicable", "policy.extract_features, policy.make_features_extractor")
@two_levels
def test_levels_have_no_extractors(algo: str) -> None:
    assert make(algo).policy.features_extractor is None


@shows("yes", "set_env", "get_env")
@every_algorithm
def test_another_environment(algo: str) -> None:
    model = make(algo).learn(50)
    other = DummyVecEnv([lambda: Monitor(corridor(0.3))])
    model.set_env(other)
    assert model._last_obs is None
    assert model.get_env() is other
    model.learn(50)
    model.set_env(model.get_env(), force_reset=False)  # type: ignore[arg-type]
    assert model._last_obs is not None
    model.learn(50, reset_num_timesteps=False)
    assert model.num_timesteps == 100
    with pytest.raises(AssertionError, match="number of environments"):
        model.set_env(make_vec_env(corridor, 2))


@shows("refused", "set_env(<unfit>)")
@every_algorithm
def test_an_environment_is_looked_at_when_it_is_set(algo: str) -> None:
    class NoReward(gym.Wrapper):  # type: ignore[type-arg]
        compute_reward = None

    model = make(algo)
    with pytest.raises(ConfigError, match="compute_reward"):
        model.set_env(NoReward(corridor()))
    for other in (corridor, [corridor()], None):
        with pytest.raises(TypeError, match="must be an environment, the id of one, or a vector"):
            model.set_env(other)  # type: ignore[arg-type]


@shows("yes", "evaluate_policy(model, model.get_env())")
@every_algorithm
@pytest.mark.parametrize("n_envs", [1, 2])
def test_evaluating_where_it_learns(algo: str, n_envs: int, caplog: Any) -> None:
    """Two calls of learn with an evaluation between them: no stored episode is made of two."""
    model: Any = make(algo, make_vec_env(lambda: corridor(0.9), n_envs), gradient_ratio=0.0)
    for steps in (10, 20, 20, 33):  # within and at the end of an episode
        model.learn(steps * n_envs, reset_num_timesteps=False)
        evaluate_policy(model, model.get_env(), 2)
    model.learn(60 * n_envs, reset_num_timesteps=False)
    assert "reset by someone else" in caplog.text
    if algo == "sac":
        buffer, rows = model.replay_buffer, slice(model.replay_buffer.pos)
        seen, then = (part["achieved_goal"][rows] for part in (buffer.observations, buffer.next_observations))
        stored = buffer.ep_length[rows] > 0
        moved = (then - seen)[stored]
    else:
        low = model.replay_buffer.low
        data = low.data
        moved = (data["next_local"] - data["local"])[: low.size(), :1]
    assert len(moved)
    assert np.abs(moved).max() < 0.11


@shows("refused", "get_vec_normalize_env")
@every_algorithm
def test_there_is_no_vec_normalize(algo: str) -> None:
    model = make(algo)
    assert model.get_vec_normalize_env() is None
    with pytest.raises(ValueError, match="VecNormalize"):
        model.set_env(VecNormalize(DummyVecEnv([corridor])))


@shows("yes", "set_random_seed")
@two_levels
def test_a_seed_set_later_counts(algo: str) -> None:
    runs = []
    for seed in (1, 1, 2):
        model = make(algo).learn(40)
        model.set_random_seed(seed)
        runs.append(weights(model.learn(80, reset_num_timesteps=False)))
    assert same(runs[0], runs[1])
    assert not same(runs[0], runs[2])


@shows("yes", "set_logger", "logger")
@every_algorithm
def test_a_logger_of_ones_own(algo: str, tmp_path: Path) -> None:
    model = make(algo)
    logger = configure(str(tmp_path), ["csv", "json", "log"])
    model.set_logger(logger)
    model.learn(120, log_interval=1)
    assert model.logger is logger
    assert "rollout/ep_len_mean" in (tmp_path / "progress.csv").read_text()
    assert (tmp_path / "progress.json").read_text()


@shows("yes", "copy.deepcopy, cloudpickle")
@every_algorithm
def test_copies_are_independent(algo: str) -> None:
    model = make(algo).learn(80)
    before = act(model)
    for other in (copy.deepcopy(model), cloudpickle.loads(cloudpickle.dumps(model))):
        np.testing.assert_array_equal(act(other), before)
        other.learn(60, reset_num_timesteps=False)
        np.testing.assert_array_equal(act(model), before)


@shows("yes", "evaluate_policy")
@every_algorithm
def test_sb3s_evaluation(algo: str) -> None:
    model = make(algo)
    rewards, lengths = evaluate_policy(model, Monitor(corridor(5.0)), n_eval_episodes=4, return_episode_rewards=True)
    assert lengths == [20] * 4
    assert rewards == [-20.0] * 4
    evaluate_policy(model.policy, make_vec_env(corridor, 3), n_eval_episodes=4)
