"""The agent as a user meets it: learn, predict, save, load, resume, and SB3's own tools on it."""

from __future__ import annotations

import json
import subprocess
import sys
import zipfile
from pathlib import Path
from typing import Any

import gymnasium as gym
import numpy as np
import pytest
import torch as th
from corridor import Corridor
from stable_baselines3 import SAC
from stable_baselines3.common.callbacks import CheckpointCallback, EvalCallback
from stable_baselines3.common.evaluation import evaluate_policy
from stable_baselines3.common.vec_env import DummyVecEnv, VecNormalize

import sb3_tbc
from sb3_tbc import TBCHRL, HiTS
from sb3_tbc.tbc_hrl.evaluation import evaluate_hierarchical

LEVEL: dict[str, Any] = {"batch_size": 16, "policy_kwargs": {"net_arch": [8, 8]}}


def make(algo: type[TBCHRL] = TBCHRL, env: Any = None, **kwargs: Any) -> TBCHRL:
    settings = {"high": LEVEL, "low": LEVEL, "max_options": 5, "gradient_ratio": 0.5, "compile": False, "seed": 0}
    return algo("MultiInputPolicy", env if env is not None else Corridor(), **{**settings, **kwargs})


def parameters(model: TBCHRL) -> dict[str, th.Tensor]:
    return {
        f"{level}.{name}": value.clone()
        for level in ("high", "low")
        for name, value in getattr(model, level).policy.state_dict().items()
    }


def same(first: dict[str, th.Tensor], second: dict[str, th.Tensor]) -> bool:
    return all(th.equal(first[name], second[name]) for name in first)


@pytest.mark.parametrize("algo", [TBCHRL, HiTS])
@pytest.mark.parametrize("n_envs", [1, 3])
@pytest.mark.parametrize("window_end", ["timed", "reached"])
def test_runs_and_updates_both_levels(algo: type[TBCHRL], n_envs: int, window_end: str) -> None:
    env = DummyVecEnv([Corridor for _ in range(n_envs)])
    model = make(algo, env, window_end=window_end)
    before = parameters(model)
    model.learn(300)
    after = parameters(model)
    assert model.num_timesteps >= 300
    for part in ("high.actor", "high.critic.", "low.actor", "low.critic."):
        names = [n for n in before if n.startswith(part) and before[n].is_floating_point()]
        assert any(not th.equal(before[n], after[n]) for n in names), part
    assert min(model.high._n_updates, model.low._n_updates) > 0


@pytest.mark.parametrize("memory", ["window", "episode", "none"])
def test_membrane_is_kept_as_long_as_memory_says(memory: str) -> None:
    model = make(memory=memory, window_end="timed", dt_max=4, max_options=100, env=Corridor(30, goal=5.0))
    model.learn(120, log_interval=1)
    data = model.replay_buffer.low.data
    rows = model.replay_buffer.low.size()
    states, position, step = data["states"][:rows], data["position"][:rows, 0], data["local"][:rows, 1]
    blank = (states == 0).all(axis=1)
    expected = {"window": position == 0, "episode": step == 0, "none": np.ones(rows, bool)}[memory]
    np.testing.assert_array_equal(blank, expected)


@pytest.mark.parametrize("deterministic", [True, False])
def test_tests_run_without_noise_if_asked(deterministic: bool) -> None:
    model = make(
        env=DummyVecEnv([Corridor, Corridor]), testing_fraction=1.0, deterministic_testing=deterministic,
        random_fraction=0.5, gradient_ratio=0.0,
    )  # fmt: skip
    model.learn(20)
    collector = model.collector
    assert collector is not None
    surely, _ = model.low.acting.act(collector.observation, collector.membrane, True, np.random.default_rng(0))
    assert np.array_equal(collector.act()[0], surely) == deterministic


@pytest.mark.parametrize("task", ["Pendulum", "Drawbridge", "UR5Reacher"])
def test_runs_on_tasks_by_id(task: str) -> None:
    model = make(env=f"sb3_tbc/{task}-v0", max_options=20, gradient_ratio=0.02)
    model.learn(250)
    assert model.num_timesteps >= 250


def test_same_seed_same_run() -> None:
    first, second = make().learn(250), make().learn(250)
    assert same(parameters(first), parameters(second))
    assert not same(parameters(first), parameters(make(seed=1).learn(250)))


def test_predict_carries_subgoal_time_and_membrane() -> None:
    model = make(dt_max=6.0)
    env = Corridor(goal=5.0)
    observation, _ = env.reset(seed=0)
    action, state = model.predict(observation, deterministic=True)
    assert action.shape == (1,)
    assert env.action_space.contains(action)
    for _ in range(20):
        previous = state
        observation = env.step(action)[0]
        action, state = model.predict(observation, state=state, deterministic=True)
        expired = previous.elapsed[0] >= previous.time_budget[0]
        assert state.used[0] == previous.used[0] + expired
        assert state.elapsed[0] == (1 if expired else previous.elapsed[0] + 1)
        if not expired:
            np.testing.assert_array_equal(state.subgoal, previous.subgoal)
    _, fresh = model.predict(observation, state=state, episode_start=np.array([True]), deterministic=True)
    assert fresh.used[0] == 1


def test_predict_leaves_the_callers_state_alone() -> None:
    model = make()
    observation, _ = Corridor().reset(seed=0)
    _, state = model.predict(observation, deterministic=True)
    copies = [part.copy() for part in state]
    model.predict(observation, state=state, episode_start=np.array([True]))
    for part, copy in zip(state, copies, strict=True):
        np.testing.assert_array_equal(part, copy)


def test_predict_refuses_what_numpy_would_spread_over_environments() -> None:
    """A narrow subgoal or one start for three environments was taken; others ended in NumPy's words."""
    model = make()
    space = model.observation_space
    batch = {key: np.stack([space[key].sample() for _ in range(3)]) for key in space}  # type: ignore[index]
    _, state = model.predict(batch)
    assert state is not None
    for start in (np.array([True]), np.array([True, False]), np.ones((3, 1), bool)):
        with pytest.raises(ValueError, match=r"episode_start has one entry for each of 3 environments, got shape"):
            model.predict(batch, state, start)
    model.predict(batch, state, np.bool_(True))
    for wrong in (state[:3], np.zeros((3, 4)), "state"):
        with pytest.raises(ValueError, match="state must be what predict returned"):
            model.predict(batch, wrong)  # type: ignore[arg-type]
    for name in ("subgoal", "membrane"):
        with pytest.raises(ValueError, match=rf"state\.{name} is of shape .* of another agent"):
            model.predict(batch, state._replace(**{name: getattr(state, name)[:1]}))  # type: ignore[attr-defined]
    with pytest.raises(ValueError, match=r"state\.used is of shape \(3,\) here, got \(1,\)"):
        model.predict(batch, state._replace(used=state[3][:1]))  # type: ignore[attr-defined]
    for key in batch:
        with pytest.raises(ValueError, match="parts of an observation must be of the same environments"):
            model.predict({**batch, key: batch[key][:2]})


def test_batched_predict_equals_single() -> None:
    model = make()
    seen = [Corridor().reset(seed=s)[0] for s in range(3)]
    batch = {key: np.stack([o[key] for o in seen]) for key in seen[0]}
    actions, _ = model.predict(batch, deterministic=True)
    single = [model.predict(o, deterministic=True)[0] for o in seen]
    np.testing.assert_allclose(actions, np.stack(single), atol=1e-6)


@pytest.mark.parametrize("window_end", ["timed", "reached"])
@pytest.mark.parametrize("memory", ["window", "episode", "none"])
def test_sb3_evaluation_agrees_with_ours(window_end: str, memory: str) -> None:
    model = make(window_end=window_end, memory=memory, max_options=50, dt_max=6.0).learn(200)
    env = DummyVecEnv([Corridor for _ in range(2)])
    ours = evaluate_hierarchical(model, env, 10, seed=3)
    env.seed(3)
    rewards, lengths = evaluate_policy(model, env, 10, return_episode_rewards=True, warn=False)
    # SB3 reports episodes as they end, ours by environment: compare them as sets
    assert not ours.budget_exhausted.any()
    assert sorted(zip(rewards, lengths, strict=True)) == sorted(zip(ours.rewards, ours.lengths, strict=True))


def test_evaluation_counts_a_used_up_budget_as_failure() -> None:
    model = make(env=Corridor(goal=5.0), dt_max=3.0, max_options=2)
    result = evaluate_hierarchical(model, Corridor(goal=5.0), 4, seed=0)
    assert result.budget_exhausted.all()
    assert not result.successes.any()
    assert (result.decisions == 2).all()
    assert result.mean_length_success is None
    with pytest.raises(ValueError, match="at least 1"):
        evaluate_hierarchical(model, Corridor(), 0)


def test_save_and_load_in_a_new_process_evaluates_the_same(tmp_path: Path) -> None:
    model = make(env="sb3_tbc/Drawbridge-v0").learn(1200)
    model.save(tmp_path / "model")
    code = (
        "import sys, gymnasium as gym, sb3_tbc\n"
        "from sb3_tbc import TBCHRL\n"
        "from sb3_tbc.tbc_hrl.evaluation import evaluate_hierarchical\n"
        f"model = TBCHRL.load({str(tmp_path / 'model')!r})\n"
        "result = evaluate_hierarchical(model, gym.make('sb3_tbc/Drawbridge-v0'), 2, seed=5)\n"
        "print(result.lengths.tolist(), result.rewards.tolist(), result.mean_window.tolist())\n"
    )
    out = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True).stdout
    here = evaluate_hierarchical(model, gym.make("sb3_tbc/Drawbridge-v0"), 2, seed=5)
    expected = f"{here.lengths.tolist()} {here.rewards.tolist()} {here.mean_window.tolist()}"
    assert out.strip().splitlines()[-1] == expected


def test_parameters_round_trip(tmp_path: Path) -> None:
    model = make().learn(200)
    model.save(tmp_path / "model.zip")
    loaded = TBCHRL.load(tmp_path / "model.zip", env=Corridor())
    assert same(parameters(model), parameters(loaded))
    other = make(seed=7)
    other.set_parameters(model.get_parameters())
    assert same(parameters(model), parameters(other))
    observation, _ = Corridor().reset(seed=1)
    for reader in (loaded, other):
        np.testing.assert_array_equal(
            model.predict(observation, deterministic=True)[0], reader.predict(observation, deterministic=True)[0]
        )
    loaded.learn(100, reset_num_timesteps=False)
    assert loaded.num_timesteps >= 300


def test_zip_holds_no_pickled_functions(tmp_path: Path) -> None:
    import json
    import zipfile

    make(env="sb3_tbc/UR5Reacher-v0").save(tmp_path / "model.zip")
    data = json.loads(zipfile.ZipFile(tmp_path / "model.zip").read("data"))
    pickled = {key for key, value in data.items() if isinstance(value, dict) and ":serialized:" in value}
    # what SB3 pickles in every zip, plus the subgoal space (data and module-level functions by name)
    assert pickled <= {
        "policy_class", "observation_space", "action_space", "subgoals", "lr_schedule", "ep_info_buffer",
        "ep_success_buffer", "_last_episode_starts", "_last_obs", "_last_original_obs",
    }  # fmt: skip


def test_replay_buffers_resume(tmp_path: Path) -> None:
    model = make().learn(200)
    model.save(tmp_path / "model.zip")
    model.save_replay_buffer(tmp_path / "buffer.pkl")
    loaded = TBCHRL.load(tmp_path / "model.zip", env=Corridor())
    loaded.load_replay_buffer(tmp_path / "buffer.pkl")
    assert loaded.replay_buffer.low.size() == model.replay_buffer.low.size() > 100
    loaded.learn(100, reset_num_timesteps=False)
    assert loaded.high._n_updates > 0
    other = make(env="sb3_tbc/Pendulum-v0")
    with pytest.raises(ValueError, match="does not fit"):
        other.load_replay_buffer(tmp_path / "buffer.pkl")
    assert not list(tmp_path.glob("*.partial"))


def test_stock_callbacks_work(tmp_path: Path) -> None:
    model = make()
    callbacks = [
        CheckpointCallback(100, str(tmp_path), save_replay_buffer=True),
        EvalCallback(
            DummyVecEnv([Corridor]), eval_freq=100, n_eval_episodes=2, best_model_save_path=str(tmp_path), verbose=0
        ),
    ]
    model.learn(250, callback=callbacks)
    assert (tmp_path / "best_model.zip").exists()
    assert (tmp_path / "rl_model_200_steps.zip").exists()
    assert list(tmp_path.glob("*replay_buffer*"))
    TBCHRL.load(tmp_path / "rl_model_200_steps.zip")


def test_logs_explain_both_levels(tmp_path: Path) -> None:
    from stable_baselines3.common.logger import configure

    model = make()
    model.set_logger(configure(str(tmp_path), ["csv"]))
    model.learn(400, log_interval=1)
    header = (tmp_path / "progress.csv").read_text().splitlines()[0]
    for key in (
        "rollout/success_rate", "option/subgoal_success", "option/time_budget", "option/duration",
        "option/relabelled_share", "high/q_mean", "low/q_mean", "high/entropy", "low/entropy",
    ):  # fmt: skip
        assert key in header


def test_user_mistakes_are_named() -> None:
    with pytest.raises(ValueError, match="goal environment"):
        make(env=gym.make("MountainCarContinuous-v0"))
    with pytest.raises(ValueError, match="learning_rate"):
        make(low={"learning_rat": 1.0})
    with pytest.raises(ValueError, match=r"low.average_decay must be .* got 1.0"):
        make(low={"average_decay": 1.0})
    with pytest.raises(ValueError, match="memory"):
        make(memory="forever")
    with pytest.raises(ValueError, match="random_fraction"):
        make(random_fraction=2.0)
    with pytest.raises(ValueError, match="VecNormalize"):
        make(env=VecNormalize(DummyVecEnv([Corridor])))
    model = make()
    with pytest.raises(ValueError, match="goal observation"):
        model.predict(np.zeros(3))


def test_set_env_continues_learning() -> None:
    model = make().learn(100)
    model.set_env(DummyVecEnv([lambda: Corridor(20)]))
    model.learn(100, reset_num_timesteps=False)
    assert model.num_timesteps >= 200


def test_both_levels_are_sb3_sac() -> None:
    model = make()
    assert isinstance(model.high, SAC)
    assert isinstance(model.low, SAC)
    assert sb3_tbc.TBCHRL is TBCHRL


@pytest.mark.slow
def test_learns_the_corridor() -> None:
    level = {"batch_size": 64, "learning_rate": 3e-3, "policy_kwargs": {"net_arch": [32, 32]}}
    model = make(high=level, low=level, gradient_ratio=1.0, max_options=5)
    model.learn(4000)
    assert evaluate_hierarchical(model, Corridor(), 40, seed=1).success_rate >= 0.9


def as_version_0_1_0(path: Path, **others: Any) -> Path:
    """A saved agent as the first version wrote it: settings among its other attributes, and not all of today's."""
    with zipfile.ZipFile(path) as archive:
        members = {name: archive.read(name) for name in archive.namelist()}
    data = json.loads(members["data"])
    settings, _ = data.pop("settings"), data.pop("episode_length")
    for name in ("high", "low"):
        level = settings.pop(name)
        for added in ("average_decay", "gradient_ratio", "actor_learning_rate"):
            del level[added]
        data[f"{name}_settings"] = level
    data |= {**settings, "dt_max": 10.0, **others}
    former = path.with_name("former.zip")
    with zipfile.ZipFile(former, "w") as archive:
        for name, content in {**members, "data": json.dumps(data).encode()}.items():
            archive.writestr(name, content)
    return former


def test_agents_saved_by_the_first_version_load(tmp_path: Path) -> None:
    model = make(memory="window", max_options=5)
    model.save(tmp_path / "old")
    loaded = TBCHRL.load(as_version_0_1_0(tmp_path / "old.zip", hindsight_goals="all"))
    assert loaded.low_settings["average_decay"] == loaded.low.average_decay == 0.999
    assert loaded.high_settings["gradient_ratio"] is None
    assert (loaded.config.memory, loaded.rules.max_options, loaded.rules.dt_max) == ("window", 5, 10.0)
    assert same(parameters(model), parameters(loaded))


def test_retired_settings_of_saved_agents_are_told_once(tmp_path: Path) -> None:
    make().save(tmp_path / "old")
    with pytest.warns(UserWarning, match="hindsight_goals='asked', a setting that no longer exists") as told:
        TBCHRL.load(as_version_0_1_0(tmp_path / "old.zip", hindsight_goals="asked"))
    assert len(told) == 1


def test_load_changes_settings_or_refuses(tmp_path: Path) -> None:
    make(max_options=5).save(tmp_path / "model")
    loaded = TBCHRL.load(tmp_path / "model", max_options=10, low={"learning_rate": 1e-5}, high={"gamma": 0.5})
    assert loaded.rules.dt_max == 5.0  # of an episode of 50 steps
    assert loaded.low.lr_schedule(1.0) == 1e-5
    assert (loaded.high.gamma, loaded.low.gamma) == (0.5, 0.99)
    assert loaded.config.low.batch_size == LEVEL["batch_size"]
    for change in ({"learning_rate": 0.5}, {"gamma": 0.5}, {"custom_objects": {"learning_rate": 0.5}}):
        with pytest.raises(ValueError, match="use low="):
            TBCHRL.load(tmp_path / "model", **change)
    loaded.low_settings["learning_rate"] = 1e-3
    assert (loaded.low.lr_schedule(1.0), loaded.config.low.learning_rate) == (1e-3, 1e-3)
    assert loaded.settings["low"]["learning_rate"] == 1e-3
    with pytest.raises(ValueError, match=r"low\.gamma is fixed when the agent is made or loaded"):
        loaded.low_settings["gamma"] = 0.5
    with pytest.raises(ValueError, match=r"low\.tau must be a number above 0"):
        loaded.low_settings["tau"] = 2


def test_a_level_may_have_a_gradient_ratio_of_its_own() -> None:
    model = make(gradient_ratio=0.5, high={"gradient_ratio": 0.1, "batch_size": 4}, low={"batch_size": 16})
    model.learn(1000)
    steps = model.num_timesteps
    assert 0.3 * steps < model.low._n_updates <= 0.5 * steps
    assert 0.04 * steps < model.high._n_updates <= 0.1 * steps
    with pytest.raises(ValueError, match=r"high.gradient_ratio must be a number from 0 to 1,000 or null, got -1"):
        make(high={"gradient_ratio": -1})


def test_learning_rate_may_fall_linearly_and_is_saved_as_text(tmp_path: Path) -> None:
    model = make(low={**LEVEL, "learning_rate": "lin_1e-3"})
    model.learn(200)
    rate = model.low.policy.actor.optimizer.param_groups[0]["lr"]
    assert 0 <= rate < 5e-4
    model.save(tmp_path / "model.zip")
    assert TBCHRL.load(tmp_path / "model.zip").low_settings["learning_rate"] == "lin_1e-3"
    with pytest.raises(ValueError, match="lin_"):
        make(low={**LEVEL, "learning_rate": "cos_1e-3"})


def test_short_runs_do_not_wait_for_a_compiler() -> None:
    model = make(compile="auto", gradient_ratio=1.0)
    model.learn(150)
    assert not model.low.compiled
    assert model.low._n_updates > 0
