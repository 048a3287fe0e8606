"""Ablations leave out what they name, and nothing else: their number of parameters is the full model's."""

from __future__ import annotations

import numpy as np
import pytest

from sb3_tbc.errors import ConfigError
from sb3_tbc.zoo.ablations import match_parameters, mlp_parameters, parameter_count
from sb3_tbc.zoo.algorithms import build_model
from sb3_tbc.zoo.config import ABLATIONS, PARTS, ablations_of, config_file, load_config, read_file
from sb3_tbc.zoo.environments import make_envs, task_names

TASKS = sorted(set(read_file(config_file("tbc-hrl"))) - {"default", "other"})


def test_mlp_parameters() -> None:
    assert mlp_parameters([3, 4, 2]) == 3 * 4 + 4 + 4 * 2 + 2
    assert mlp_parameters([3]) == 0


@pytest.mark.parametrize("ablation", ["no-ndbc", "no-ts"])
@pytest.mark.parametrize("task", TASKS)
def test_parameters_match_within_half_a_percent(task: str, ablation: str) -> None:
    env_id = task_names()[task]
    full = load_config("tbc-hrl", task)
    matched = match_parameters(load_config("tbc-hrl", task, ablation=ablation), full, env_id)
    print(f"{task} {ablation}: {matched}")
    env = make_envs(env_id, 1, 0, full.env_kwargs)
    model = build_model(matched.run, env, seed=0)
    env.close()
    assert matched.ablated == parameter_count(model)
    assert abs(matched.ablated / matched.full - 1) <= 0.005
    assert matched.run.n_timesteps == full.n_timesteps
    for key in ("batch_size", "gamma", "tau", "ent_coef", *(["learning_rate"] if ablation == "no-ts" else [])):
        assert matched.run.model["low"][key] == full.model["low"][key]
    if ablation == "no-ndbc":
        assert model.low.state_dim == 0
        assert model.layout.remaining_time
    else:
        assert model.low.state_dim > 0
        assert not model.layout.remaining_time
        assert not model.layout.timed_actions
        durations = np.array([1, 20])
        assert len(set(model.high_reward.discounts(durations))) == 1  # no gamma ** tau


def test_ablations_are_of_the_full_method() -> None:
    with pytest.raises(ConfigError, match="did you mean 'no-ndbc'"):
        load_config("tbc-hrl", "Pendulum", ablation="no-ndcb")
    with pytest.raises(ConfigError, match="only tbc-hrl has ablations"):
        load_config("hits", "Pendulum", ablation="no-ts")


@pytest.mark.parametrize("config", ["paper", "tuned"])
@pytest.mark.parametrize("task", ["Pendulum", "UR5Reacher"])
def test_every_part_of_the_paper_is_one_ablation(task: str, config: str) -> None:
    """Each part is either in the configuration, then it can be left out, or it is not, then it can be put in."""
    found = ablations_of(task, config)
    assert {"no-ts", "no-ndbc"} <= set(found)
    for part in PARTS:
        (name,) = {f"with-{part}", f"no-{part}"} & set(found)
        full = load_config("tbc-hrl", task, config)
        matched = match_parameters(load_config("tbc-hrl", task, config, ablation=name), full, task_names()[task])
        assert abs(matched.ablated / matched.full - 1) <= 0.005
    assert set(found) < set(ABLATIONS)
