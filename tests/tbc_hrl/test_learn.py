"""Learning in one call or in many, with all callbacks, stopped at any time."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
import pytest
import torch as th
from checks import assert_same
from corridor import Corridor
from hypothesis import given, settings
from hypothesis import strategies as st
from stable_baselines3.common import callbacks as sb3
from stable_baselines3.common.monitor import Monitor

from sb3_tbc import HAC, TBCHRL, HiTS
from sb3_tbc.smdp.goal_vec_env import GoalVecEnv

LEVEL: dict[str, Any] = {"batch_size": 16, "policy_kwargs": {"net_arch": [8, 8]}}


def make(algo: type[TBCHRL] = TBCHRL, n_envs: int = 1, **kwargs: Any) -> TBCHRL:
    env = GoalVecEnv([lambda: Monitor(Corridor(30)) for _ in range(n_envs)])
    given_ = {"high": LEVEL, "low": LEVEL, "max_options": 5, "dt_max": 5.0, "gradient_ratio": 0.3, "compile": False}
    return algo("MultiInputPolicy", env, **{**given_, "seed": 0, **kwargs})


def contents(model: TBCHRL) -> dict[str, Any]:
    """Weights, moments, replay, random streams and counters."""
    found: dict[str, Any] = {"steps": model.num_timesteps, "episodes": model._episode_num}
    for name in ("high", "low"):
        level, buffer = getattr(model, name), getattr(model.replay_buffer, name)
        found |= {f"{name}.{key}": value.numpy().copy() for key, value in level.policy.state_dict().items()}
        found |= {f"{name}.replay.{key}": array[: buffer.size()].copy() for key, array in buffer.data.items()}
        found |= {f"{name}.updates": level._n_updates, f"{name}.rng": str(level.noise_rng.bit_generator.state)}
    return {**found, "rng": str(model.rng.bit_generator.state), "returns": [i["r"] for i in model.ep_info_buffer]}


def in_chunks(model: TBCHRL, chunks: list[int]) -> TBCHRL:
    for steps in chunks:
        model.learn(steps, reset_num_timesteps=False)
    return model


@pytest.fixture(scope="module")
def whole() -> Callable[[int], dict[str, Any]]:
    return lambda n_envs: contents(make(n_envs=n_envs).learn(240))


@settings(max_examples=6, deadline=None)
@given(cuts=st.sets(st.integers(1, 79), max_size=8), n_envs=st.sampled_from([1, 3]))
def test_chunks_learn_what_one_call_learns(whole: Any, cuts: set[int], n_envs: int) -> None:
    ends = [3 * cut for cut in sorted(cuts)] + [240]
    chunks = np.diff([0, *ends]).tolist()
    assert_same(whole(n_envs), contents(in_chunks(make(n_envs=n_envs), chunks)))


def test_tiny_chunks_store_and_update() -> None:
    model = in_chunks(make(), [7] * 40)
    assert model.replay_buffer.low.size() > 200
    assert model.low._n_updates > 50


@pytest.mark.parametrize("algo", [TBCHRL, HiTS, HAC])
@pytest.mark.parametrize("n_envs", [1, 2])
def test_saved_and_loaded_half_way(algo: type[TBCHRL], n_envs: int, tmp_path: Any) -> None:
    """``tests/tbc_hrl/test_resume.py`` does so within rollouts, on all tasks; here it is at the end of a call."""
    task = "sb3_tbc/Pendulum-v0"
    from sb3_tbc.zoo.environments import make_envs

    def agent() -> TBCHRL:
        return algo("MultiInputPolicy", make_envs(task, n_envs, 0), high=LEVEL, low=LEVEL, gradient_ratio=0.05,
                    compile=False, seed=0)  # fmt: skip

    expected = contents(agent().learn(1400))
    half = agent().learn(700)
    half.save(tmp_path / "model.zip")
    half.save_replay_buffer(tmp_path / "replay.npz")
    assert_same(expected, contents(half.learn(700, reset_num_timesteps=False)))
    loaded = algo.load(tmp_path / "model.zip", env=make_envs(task, n_envs, 77))
    loaded.load_replay_buffer(tmp_path / "replay.npz")
    th.manual_seed(5)
    assert_same(expected, contents(loaded.learn(700, reset_num_timesteps=False)))


def test_an_agent_made_from_an_id_can_be_resumed_too(tmp_path: Any) -> None:
    def agent() -> TBCHRL:
        return TBCHRL("MultiInputPolicy", "sb3_tbc/Drawbridge-v0", high=LEVEL, low=LEVEL, gradient_ratio=0.05,
                      compile=False, seed=0)  # fmt: skip

    expected = contents(agent().learn(900))
    half = agent().learn(500)
    half.save(tmp_path / "model.zip")
    half.save_replay_buffer(tmp_path / "replay.npz")
    import gymnasium as gym

    loaded = TBCHRL.load(tmp_path / "model.zip", env=gym.make("sb3_tbc/Drawbridge-v0"))
    loaded.load_replay_buffer(tmp_path / "replay.npz")
    assert_same(expected, contents(loaded.learn(400, reset_num_timesteps=False)))


class StopAt(sb3.BaseCallback):
    """Asks to stop when so many steps are done, and says where learning was."""

    def __init__(self, steps: int) -> None:
        super().__init__()
        self.steps = steps

    def _on_step(self) -> bool:
        if self.num_timesteps == self.steps:
            self.model.stop_requested = True
        return True


@pytest.mark.parametrize("at", [1, 13, 25, 99])
def test_a_stop_takes_nothing_away(at: int) -> None:
    expected = contents(make().learn(200))
    model = make().learn(200, callback=StopAt(at))
    assert at == model.num_timesteps
    model.learn(50, reset_num_timesteps=False)
    assert at == model.num_timesteps  # it stays set
    model.stop_requested = False
    assert_same(expected, contents(model.learn(200 - at, reset_num_timesteps=False)))


@pytest.mark.parametrize("at", [3, 40, 121])
def test_a_callback_that_stops_takes_nothing_away(at: int) -> None:
    class Stop(sb3.BaseCallback):
        def _on_step(self) -> bool:
            return bool(self.num_timesteps != at)

    expected = contents(make().learn(200))
    model = make().learn(200, callback=Stop())
    assert at == model.num_timesteps
    assert_same(expected, contents(model.learn(200 - at, reset_num_timesteps=False)))


@pytest.mark.parametrize("ratio", [0.01, 0.3, 1.7])
def test_no_update_is_rounded_away(ratio: float) -> None:
    model = make(gradient_ratio=ratio, low={**LEVEL, "gradient_ratio": 0.5 * ratio})
    model.learn(600)
    last = model._updated_at
    assert 540 < last <= 600
    assert abs(model.high._n_updates - ratio * last) <= 1
    assert abs(model.low._n_updates - 0.5 * ratio * last) <= 1


def test_steps_before_learning_starts_owe_no_updates() -> None:
    model = make(gradient_ratio=1.0, learning_starts=100).learn(300)
    assert model.low._n_updates == model._updated_at - 100


@pytest.mark.parametrize("n_envs", [1, 4, 8])
def test_environments_that_end_together_skip_no_log(n_envs: int, monkeypatch: pytest.MonkeyPatch) -> None:
    env = GoalVecEnv([lambda: Corridor(3, goal=5.0) for _ in range(n_envs)])
    model = TBCHRL("MultiInputPolicy", env, max_options=3, gradient_ratio=0.0, compile=False)
    logged: list[int] = []
    monkeypatch.setattr(model, "dump_logs", lambda: logged.append(model._episode_num))
    model.learn(3 * 80, log_interval=10)
    assert logged == [-(-n // n_envs) * n_envs for n in range(10, 81, 10)]


def test_learning_resets_the_environments_once() -> None:
    resets = [0]

    class Counting(Corridor):
        def reset(self, **kwargs: Any) -> Any:
            resets[0] += 1
            return super().reset(**kwargs)

    model = TBCHRL("MultiInputPolicy", Counting(goal=5.0), high=LEVEL, low=LEVEL, max_options=5, compile=False, seed=0)
    model.learn(10)
    assert resets == [1]
    model.learn(10, reset_num_timesteps=False)
    assert resets == [1]


def test_callbacks_see_the_task_as_sb3_shows_it() -> None:
    seen: list[dict[str, Any]] = []

    def look(given: dict[str, Any], _: Any) -> bool:
        seen.append({**given})
        return True

    model = make(n_envs=2)
    model.learn(200, callback=look)
    lengths = np.zeros(2, int)
    for step in seen:
        assert step["replay_buffer"] is model.replay_buffer
        assert step["env"] is model.env
        assert step["actions"].shape == (2, 1)
        assert step["rewards"].shape == step["dones"].shape == (2,)
        lengths += 1
        for index, done in enumerate(step["dones"]):
            assert done == ("episode" in step["infos"][index]) == (index in step["episodes"])
            if done:
                assert step["infos"][index]["episode"]["l"] == lengths[index]
                lengths[index] = 0
            assert step["new_obs"]["observation"][index, 1] == lengths[index]  # the corridor counts its steps


def test_each_of_sb3s_callbacks_runs(tmp_path: Any) -> None:
    env = Monitor(Corridor(30))
    stop = sb3.StopTrainingOnMaxEpisodes(6)
    model = make(n_envs=1)
    model.learn(5000, callback=stop)
    assert model._episode_num == 6
    counted: list[int] = []
    every = [
        sb3.CheckpointCallback(50, str(tmp_path / "checkpoints"), save_replay_buffer=True),
        sb3.EvalCallback(
            env,
            callback_on_new_best=sb3.StopTrainingOnRewardThreshold(1e9),
            callback_after_eval=sb3.StopTrainingOnNoModelImprovement(1000),
            eval_freq=60,
            n_eval_episodes=1,
            log_path=str(tmp_path),
            best_model_save_path=str(tmp_path),
            verbose=0,
        ),
        sb3.EveryNTimesteps(40, sb3.ConvertCallback(lambda given, _: counted.append(len(given["infos"])) or True)),
        sb3.LogEveryNTimesteps(50),
    ]
    model = make()
    model.learn(200, callback=every)
    assert counted == [1] * 5
    assert len(list((tmp_path / "checkpoints").glob("*steps.zip"))) == 4
    assert (tmp_path / "best_model.zip").is_file()
    assert np.load(tmp_path / "evaluations.npz")["timesteps"].tolist() == [60, 120, 180]


def test_a_state_saved_within_a_rollout_goes_on_exactly(tmp_path: Any) -> None:
    """SB3's own checkpoints are taken at any step, the last of an episode too."""
    expected = None
    for at in (37, 60, 111):
        model = make(TBCHRL)
        callback = sb3.CheckpointCallback(at, str(tmp_path / str(at)), save_replay_buffer=True)
        result = contents(model.learn(200, callback=callback))
        expected = expected or result
        assert_same(expected, result)


def test_what_cannot_be_meant_is_refused() -> None:
    model = make()
    for steps, error, words in (
        ("1000", TypeError, "got '1000'"),
        (-5, ValueError, "must not be negative, got -5"),
        (1.5, TypeError, "whole number"),
        (None, TypeError, "got None"),
    ):
        with pytest.raises(error, match=words):
            model.learn(steps)  # type: ignore[arg-type]
    assert model.learn(40.0).num_timesteps == 40  # type: ignore[arg-type]


CIRCUIT = {"ndbc": {"inter": 4, "command": 3, "motor": 1, "sensory_fanout": 2, "inter_fanout": 2, "motor_fanin": 2}}


@pytest.mark.parametrize("memory", ["none", "window"])
def test_the_state_after_a_step_is_what_the_next_step_begins_with(memory: str) -> None:
    """Else the critics' target would use actions of a policy that never acts."""
    low = {**LEVEL, "policy_kwargs": {"net_arch": [8, 8], **CIRCUIT}}
    data = make(low=low, memory=memory).learn(60).replay_buffer.low.data
    assert bool(np.abs(data["next_states"][:30]).max()) == (memory == "window")
    goes_on = ~data["dones"][:29].astype(bool).ravel() & data["states"][1:30].any(axis=-1).ravel()
    np.testing.assert_array_equal(data["next_states"][:29][goes_on], data["states"][1:30][goes_on])
