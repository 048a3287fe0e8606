"""What SB3's agents let users do: each works here, or is refused in one line that says what to do instead."""

from __future__ import annotations

import copy
import pickle
from typing import Any

import cloudpickle
import numpy as np
import pytest
import torch as th
from corridor import Corridor
from stable_baselines3.common.env_util import make_vec_env
from stable_baselines3.common.vec_env import DummyVecEnv, SubprocVecEnv, VecNormalize

from sb3_tbc import TBCHRL, SubgoalSpace, TBCPolicy
from sb3_tbc.errors import ConfigError
from sb3_tbc.tbc_hrl.evaluation import evaluate_hierarchical
from sb3_tbc.tbc_hrl.option_env import OptionEnv

LEVEL: dict[str, Any] = {"batch_size": 16, "buffer_size": 2000, "policy_kwargs": {"net_arch": [8, 8]}}
OBSERVATION = Corridor().reset(seed=0)[0]


def make(env: Any = None, **kwargs: Any) -> TBCHRL:
    given = {"high": LEVEL, "low": LEVEL, "max_options": 5, "gradient_ratio": 0.2, "compile": False, "seed": 0}
    return TBCHRL("MultiInputPolicy", env or Corridor(30), **{**given, **kwargs})


def act(model: TBCHRL) -> np.ndarray:
    return model.predict(OBSERVATION, deterministic=True)[0]


@pytest.mark.parametrize("copied", [copy.deepcopy, lambda model: cloudpickle.loads(cloudpickle.dumps(model))])
def test_a_copy_is_the_same_and_independent(copied: Any) -> None:
    model = make().learn(100)
    other = copied(model)
    before = act(model)
    np.testing.assert_array_equal(act(other), before)
    other.learn(60, reset_num_timesteps=False)
    assert other.num_timesteps == 160
    np.testing.assert_array_equal(act(model), before)
    assert not np.array_equal(act(other), before)
    model.learn(60, reset_num_timesteps=False)
    np.testing.assert_array_equal(act(other), act(model))


def test_weights_loaded_into_the_policy_act_at_once() -> None:
    taught, fresh = make().learn(100), make(seed=3)
    assert not np.array_equal(act(taught), act(fresh))
    fresh.policy.load_state_dict(taught.policy.state_dict())
    np.testing.assert_array_equal(act(taught), act(fresh))


def evaluated(model: TBCHRL) -> Any:
    return evaluate_hierarchical(model, Corridor(30), 5, seed=0).mean_window


def stepped(model: TBCHRL) -> Any:
    env = OptionEnv(make_vec_env(lambda: Corridor(30), 1, seed=0), model)
    env.reset()
    return env.step(np.ones((1, 2)))[0]


def explored(model: TBCHRL) -> Any:
    model.learn(6, reset_num_timesteps=False)  # no episode ends, so there are no updates
    low = model.low
    return low.acting.act(np.ones((1, *low.observation_space.shape)), np.zeros((1, low.state_dim)), True, model.rng)[0]


@pytest.mark.parametrize("door", [evaluated, stepped, explored])
def test_weights_changed_in_place_act_wherever_the_agent_does(door: Any) -> None:
    model = make()
    before = door(model)
    with th.no_grad():
        for parameter in model.policy.parameters():
            parameter.mul_(-1.5)
    after = door(model)
    assert not np.array_equal(after, before)
    model.high.acting.refresh()
    model.low.acting.refresh()
    np.testing.assert_array_equal(door(model), after)


def test_a_policy_is_saved_with_its_agent(tmp_path: Any) -> None:
    with pytest.raises(TypeError, match=r"model.save"):
        make().policy.save(str(tmp_path / "p"))
    with pytest.raises(TypeError, match=r"TBCHRL.load"):
        TBCPolicy.load(str(tmp_path / "p"))


def test_seeds_set_after_loading_count(tmp_path: Any) -> None:
    make().save(tmp_path / "a.zip")
    runs = []
    for seed in (1, 2, 1):
        model = TBCHRL.load(tmp_path / "a.zip", env=Corridor(goal=0.9), trust=True)
        model.set_random_seed(seed)
        runs.append(model.learn(80, reset_num_timesteps=False).policy.state_dict())
    same = [all(th.equal(runs[0][key], run[key]) for key in runs[0]) for run in runs[1:]]
    assert same == [False, True]


@pytest.mark.parametrize("name", ["gamma", "tau", "batch_size", "learning_rate", "ent_coef"])
def test_settings_of_a_level_are_not_set_on_the_agent(name: str) -> None:
    with pytest.raises(AttributeError, match=rf"{name} belongs to a level.*load\("):
        setattr(make(), name, 0.5)


def test_replay_loads_into_an_agent_whose_buffer_was_dropped(tmp_path: Any) -> None:
    model = make().learn(100)
    rows = model.replay_buffer.low.size()
    model.save_replay_buffer(tmp_path / "r.npz")
    del model.replay_buffer
    model.load_replay_buffer(tmp_path / "r.npz")
    assert model.replay_buffer.low.size() == rows > 0
    model.learn(60, reset_num_timesteps=False)
    assert model.replay_buffer.low.size() > rows


def test_environments_that_do_not_fit_are_refused() -> None:
    model = make()
    with pytest.raises(ValueError, match="VecNormalize"):
        model.set_env(VecNormalize(DummyVecEnv([Corridor])))
    with pytest.raises(ValueError, match="pass env"):
        TBCHRL("MultiInputPolicy", Corridor(), subgoals=Corridor().subgoals).__class__.learn(_without_env(model), 10)


def _without_env(model: TBCHRL) -> TBCHRL:
    model.env = None
    return model


class OnlyReward(Corridor):
    """What SB3's hindsight replay asks for, and nothing more."""

    compute_terminated: Any = property(lambda self: (_ for _ in ()).throw(AttributeError("compute_terminated")))

    def step(self, action: Any) -> Any:
        self.position = float(np.clip(self.position + 0.1 * float(action[0]), -1, 1))
        self.steps += 1
        seen = self._observation()
        reward = float(self.compute_reward(seen["achieved_goal"], seen["desired_goal"], {}))
        return seen, reward, reward == 0.0, self.steps >= self.max_episode_steps, {}


def test_compute_reward_alone_suffices() -> None:
    model = make(OnlyReward(20)).learn(150)
    assert model.low._n_updates > 0
    result = evaluate_hierarchical(model, OnlyReward(20, goal=0.02), 4, seed=0)
    assert result.success_rate == 1.0  # nothing says is_success: the reward does


@pytest.mark.parametrize(
    ("answer", "words"),
    [
        (lambda a, d: 0.0, "one value for each of 3 goals"),
        (lambda a, d: -1.0 if abs(a - d) > 0.05 else 0.0, "fails on a batch"),
        (lambda a, d: np.full(len(a), np.nan), "compute_reward gives nan"),
    ],
)
def test_goal_tests_that_training_could_not_use_are_refused_at_once(answer: Any, words: str) -> None:
    class Odd(Corridor):
        def compute_reward(self, achieved_goal: Any, desired_goal: Any, info: Any) -> Any:
            return answer(achieved_goal, desired_goal)

    with pytest.raises((ConfigError, FloatingPointError), match=words):
        make(Odd())


def data_only(goal: float | None = None) -> Any:
    env = Corridor(30, goal)
    env.subgoals = SubgoalSpace.from_slices([-1.0], [1.0], [0.05], local_scale=[1.0, 50.0, 100.0], names=["position"])
    return env


@pytest.mark.parametrize("make_env", [Corridor, data_only])
def test_trains_in_other_processes(make_env: Any) -> None:
    venv = SubprocVecEnv([make_env, make_env], start_method="fork")
    model = make(venv, window_end="reached").learn(80)
    venv.close()
    assert model.num_timesteps == 80


def test_what_is_not_finite_is_refused_where_it_enters() -> None:
    for key in ("observation", "achieved_goal", "desired_goal", "reward"):

        class Bad(Corridor):
            key = ""

            def step(self, action: Any) -> Any:
                seen, reward, *rest = super().step(action)
                if self.steps == 3:
                    reward = np.nan if self.key == "reward" else reward
                    seen = {k: part * (np.nan if k == self.key else 1.0) for k, part in seen.items()}
                return seen, reward, *rest

        venv = DummyVecEnv([lambda: Corridor(30, 5.0), lambda: Bad(30, 5.0)])
        venv.envs[1].key = key
        model = make(venv)
        with pytest.raises(FloatingPointError, match=f"environment 1, step 3 of its episode: .*{key}"):
            model.learn(100)
        assert model.replay_buffer.low.size() == 0


def test_a_policy_travels_without_what_it_learns_from(tmp_path: Any) -> None:
    """Neither replay buffers nor open log files: it can be copied and sent to another process."""
    pytest.importorskip("tensorboard")
    model = TBCHRL(
        "MultiInputPolicy", Corridor(), max_options=5, compile=False, seed=0, tensorboard_log=str(tmp_path)
    ).learn(200)
    sent = pickle.dumps(model.policy)
    assert len(sent) < 5_000_000  # weights, and the moments of their optimizers
    seen = Corridor().reset(seed=0)[0]
    wanted, _ = model.policy.predict(seen, deterministic=True)
    for policy in (pickle.loads(sent), copy.deepcopy(model.policy)):
        np.testing.assert_array_equal(policy.predict(seen, deterministic=True)[0], wanted)
        assert policy.low_policy is policy.actor.low.policy is not model.low.policy
        with th.no_grad():
            for parameter in policy.low_policy.average_actor.parameters():
                parameter.zero_()
        assert not np.array_equal(policy.predict(seen, deterministic=True)[0], wanted)
    np.testing.assert_array_equal(model.policy.predict(seen, deterministic=True)[0], wanted)
