"""The arguments of SB3's SAC, and the settings of a level that take their place."""

from __future__ import annotations

import logging
from pathlib import Path
from typing import Any

import pytest
from contract import every_algorithm, make, shows, two_levels
from stable_baselines3.common.logger import HParam

OF_A_LEVEL = {"learning_rate": 1e-4, "buffer_size": 300, "batch_size": 8, "tau": 0.1, "gamma": 0.9, "ent_coef": 0.1,
              "target_entropy": -2.0}  # fmt: skip


@shows("yes", "learning_rate", "buffer_size", "batch_size", "tau", "gamma", "ent_coef", "target_entropy")
@two_levels
@pytest.mark.parametrize("name", OF_A_LEVEL)
def test_belongs_to_a_level(algo: str, name: str) -> None:
    value = OF_A_LEVEL[name]
    model: Any = make(algo, low={name: value}, high={name: value})
    assert model.low_settings[name] == model.high_settings[name] == value
    with pytest.raises(ValueError, match=f"{name} belongs to a level"):
        make(algo, **{name: value})
    with pytest.raises(AttributeError, match=f"{name} belongs to a level"):
        setattr(model, name, value)
    if name != "learning_rate":  # SB3 itself keeps one at the top
        with pytest.raises(AttributeError, match=rf"read model.low_settings\['{name}'\]"):
            getattr(model, name)


@shows("yes", "learning_starts", "policy_kwargs", "stats_window_size", "verbose")
@two_levels
def test_is_taken_as_sb3_does(algo: str) -> None:
    shape = {"policy_kwargs": {"net_arch": [8], "n_critics": 1}, "batch_size": 8}
    model: Any = make(algo, learning_starts=40, stats_window_size=3, verbose=0, low=shape, high=shape).learn(120)
    assert model.ep_info_buffer.maxlen == 3
    assert model.low.policy.critic.n_critics == 1


@shows(
    "refused", "train_freq", "gradient_steps", "target_update_interval", "action_noise", "use_sde", "sde_sample_freq",
    "use_sde_at_warmup", "replay_buffer_class", "replay_buffer_kwargs", "optimize_memory_usage", "n_steps",
)  # fmt: skip
@every_algorithm
@pytest.mark.parametrize(
    ("name", "words"),
    [
        *[(name, "gradient_ratio") for name in ("train_freq", "gradient_steps")],
        ("target_update_interval", "by tau"),
        *[(name, "exploration") for name in ("action_noise", "use_sde", "sde_sample_freq", "use_sde_at_warmup")],
        *[(name, "goal_strategy") for name in ("replay_buffer_class", "replay_buffer_kwargs", "optimize_memory_usage")],
        ("n_steps", "one step"),
    ],
)
def test_has_no_counterpart(algo: str, name: str, words: str) -> None:
    with pytest.raises(ValueError, match=f"{name} is not taken: .*{words}"):
        make(algo, **{name: 2})


@shows("yes", "action_noise=None, use_sde=False, ...")
@every_algorithm
def test_defaults_of_sb3_that_ask_for_nothing_are_taken(algo: str) -> None:
    neutral = {"action_noise": None, "use_sde": False, "sde_sample_freq": -1, "use_sde_at_warmup": False, "n_steps": 1,
               "replay_buffer_class": None, "replay_buffer_kwargs": None, "optimize_memory_usage": False}  # fmt: skip
    assert make(algo, **neutral).learn(20).num_timesteps == 20


@shows("refused", "env=None")
@two_levels
def test_an_agent_is_built_for_an_environment(algo: str) -> None:
    with pytest.raises(ValueError, match="an agent is built for an environment"):
        type(make(algo))("MultiInputPolicy", None)  # type: ignore[arg-type]


@shows("refused", "policy_kwargs: features_extractor_class, optimizer_class")
@two_levels
@pytest.mark.parametrize("name", ["features_extractor_class", "optimizer_class"])
def test_networks_are_flat(algo: str, name: str) -> None:
    with pytest.raises(ValueError, match=name):
        make(algo, low={"policy_kwargs": {name: dict}})


@shows("refused", "policy: MlpPolicy, CnnPolicy")
@every_algorithm
@pytest.mark.parametrize("policy", ["MlpPolicy", "CnnPolicy"])
def test_the_policy_is_that_of_dictionaries(algo: str, policy: str) -> None:
    with pytest.raises(ValueError, match=f"policy must be 'MultiInputPolicy', got '{policy}'"):
        type(make(algo))(policy, make(algo).get_env())  # type: ignore[arg-type]


@shows("yes", "tensorboard_log", "HParam")
@every_algorithm
@pytest.mark.parametrize("as_text", [True, False])
def test_tensorboard(algo: str, as_text: bool, tmp_path: Path) -> None:
    pytest.importorskip("tensorboard")
    from tensorboard.backend.event_processing.event_accumulator import EventAccumulator

    names = {"tbc-hrl": "TBCHRL", "hits": "HiTS", "hac": "HAC", "sac": "SAC"}
    logging.getLogger("tensorboard").setLevel(logging.ERROR)
    model: Any = make(algo, tensorboard_log=str(tmp_path) if as_text else tmp_path)
    model.learn(40, log_interval=1)
    model.learn(40, log_interval=1, reset_num_timesteps=False)
    (folder,) = tmp_path.iterdir()
    assert folder.name == f"{names[algo]}_1"
    events = EventAccumulator(str(folder)).Reload()
    assert "rollout/ep_len_mean" in events.Tags()["scalars"]
    model.logger.record("hparams", HParam({"algorithm": algo}, {"rollout/ep_len_mean": 0}))
    model.logger.dump(100)
    model.learn(40)
    assert sorted(folder.name for folder in tmp_path.iterdir()) == [f"{names[algo]}_{k}" for k in (1, 2)]
