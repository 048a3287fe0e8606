"""From an agent's settings and its task to decisions, bounds, norms and optimism of both levels."""

import logging
import math

import gymnasium as gym
import numpy as np
import pytest
from making import make

from sb3_tbc import TBCHRL
from sb3_tbc.settings import SettingError
from sb3_tbc.smdp.bounds import ValueBounds
from sb3_tbc.tbc_hrl.baselines import HAC
from sb3_tbc.tbc_hrl.config import TBCConfig

SMALL = {"policy_kwargs": {"net_arch": [8]}, "batch_size": 16}


def make_agent(env: gym.Env | None = None, high: dict | None = None, low: dict | None = None, kind=TBCHRL, **settings):
    levels = {"high": {**SMALL, **(high or {})}, "low": {**SMALL, **(low or {})}}
    env = make("Pendulum") if env is None else env
    return kind("MultiInputPolicy", env, seed=0, compile=False, **levels, **settings)


AUTO = {"target_bounds": "auto"}


def test_auto_bounds_are_the_episodes() -> None:
    agent = make_agent(high={**AUTO, "gamma": 0.9}, low=AUTO, max_options=10, target="decision", duration_cost=0.5)
    assert agent.high.bounds.low == pytest.approx(-10.0 * (1 - 0.9**10) / 0.1)
    assert agent.high.bounds.high == 0.0
    assert agent.low.bounds == pytest.approx(ValueBounds(0.0, 1.0, agent.low.bounds.later))


def test_without_tests_no_penalty_counts() -> None:
    agent = make_agent(
        high={**AUTO, "gamma": 1.0}, max_options=10, target="decision", duration_cost=0.5, testing_fraction=0.0
    )
    assert agent.high.bounds.low == pytest.approx(-15.0)


def test_hac_pays_for_each_step() -> None:
    agent = make_agent(kind=HAC, low={**AUTO, "gamma": 0.9}, max_options=100)
    steps = math.ceil(agent.rules.dt_max)
    assert agent.low.bounds.low == pytest.approx(-(1 - 0.9**steps) / 0.1)
    assert agent.low.bounds.high == 0.0


def test_by_default_and_when_given() -> None:
    assert make_agent().high.bounds is None
    assert make_agent(low={"target_bounds": [-3, 2.5]}).low.bounds == ValueBounds(-3.0, 2.5, 0.0)


@pytest.mark.parametrize("given", [[2, 1], [1, 1], [0], "tight", 3])
def test_impossible_bounds(given: object) -> None:
    with pytest.raises(ValueError, match=r"target_bounds"):
        make_agent(high={"target_bounds": given})


class Unsaid(gym.Wrapper):
    """A task that does not say what it pays."""

    reward_range = None


def test_an_unknown_reward_leaves_targets_free(caplog: pytest.LogCaptureFixture) -> None:
    with caplog.at_level(logging.WARNING):
        agent = make_agent(Unsaid(make("Pendulum")), high=AUTO, low=AUTO)
    assert agent.high.bounds is None
    assert agent.low.bounds is not None  # its rewards are our own
    assert "high.target_bounds" in caplog.text


def test_norms_and_optimism_reach_both_levels() -> None:
    agent = make_agent(high={"critic_norm": "layer", "actor_q": 0.25}, low={"critic_norm": "batch", "actor_q": "mean"})
    assert (agent.high.critic.norm, agent.low.critic.norm) == ("layer", "batch")
    assert (agent.high._update.optimism, agent.low._update.optimism) == (0.25, None)


@pytest.mark.parametrize("name", ["critic_norm", "actor_q"])
def test_unknown_values(name: str) -> None:
    with pytest.raises(ValueError, match=name):
        make_agent(low={name: "median"})


def test_learns_saves_and_loads(tmp_path) -> None:
    settings = {**AUTO, "critic_norm": "batch", "actor_q": 0.5}
    agent = make_agent(high=settings, low=settings, max_options=20, gradient_ratio=0.05)
    agent.learn(1200)
    logged = agent.low.logger.name_to_value
    assert 0.0 <= logged["low/target_min"] <= logged["low/target_max"]
    agent.save(tmp_path / "agent.zip")
    loaded = TBCHRL.load(tmp_path / "agent.zip")
    assert loaded.high.bounds == agent.high.bounds
    observation, _ = make("Pendulum").reset(seed=1)
    ours, theirs = (a.predict(observation, deterministic=True)[0] for a in (agent, loaded))
    assert np.array_equal(ours, theirs)


@pytest.mark.parametrize(("steps", "options"), [(50, 5), (300, 10), (1000, 10), (7, 1), (100, 10)])
def test_decisions_follow_the_time_limit(steps: int, options: int) -> None:
    config = TBCConfig(max_options="auto")
    assert config.for_episodes_of(steps).max_options == options
    assert TBCConfig(max_options=3).for_episodes_of(steps).max_options == 3
    with pytest.raises(SettingError, match="max_options of 'auto' needs an environment with a time limit"):
        config.for_episodes_of(None)


def test_windows_do_not_use_up_decisions_that_follow_the_time_limit() -> None:
    def shortest(**settings: object) -> float:
        return TBCConfig(max_options="auto", **settings).for_episodes_of(300).dt_min  # type: ignore[arg-type]

    assert shortest() == 15.0
    assert shortest(dt_min=20.0) == 20.0
    assert shortest(dt_max=40.0) == 0.0
    assert shortest(window_end="reached") == 0.0
    assert TBCConfig(max_options=10).for_episodes_of(300).dt_min == 0.0


def test_an_agent_takes_its_decisions_from_the_task(tmp_path) -> None:
    agent = make_agent(make("Pendulum"), max_options="auto")
    assert agent.max_options == agent.rules.max_options == 10
    assert agent.rules.dt_max == pytest.approx(agent.episode_length / 10)
    agent.gradient_ratio = 0.5
    agent.low_settings["learning_rate"] = 1e-4
    assert (agent.max_options, agent.config.dt_min) == (10, agent.rules.dt_min)
    assert agent.settings["max_options"] == "auto"  # as it was given
    agent.save(tmp_path / "agent.zip")
    assert TBCHRL.load(tmp_path / "agent.zip").max_options == 10


@pytest.mark.parametrize(
    ("networks", "said"),
    [
        ({"gru": 8}, r"gru of 8 needs ndbc: null"),
        ({"ndbc": None, "critic_memory": True}, r"critic_memory needs an actor with a memory"),
        ({"critic_memory": True}, r"critic_memory shows the critics .* memory='none' keeps none"),
    ],
)
def test_memories_that_cannot_be_meant(networks: dict, said: str) -> None:
    with pytest.raises(SettingError, match=said):
        make_agent(low={"policy_kwargs": networks})


@pytest.mark.parametrize("networks", [{"ndbc": None, "gru": 5}, {}], ids=["gru", "circuit"])
def test_agents_with_a_memory_learn_act_and_are_saved(networks: dict, tmp_path) -> None:
    low = {"policy_kwargs": {"net_arch": [8], "critic_memory": True, **networks}}
    agent = make_agent(low=low, memory="window", sequence_length=3, max_options=20)
    assert agent.low.policy.critic.q_networks[0][0].in_features == (
        agent.low.observation_space.shape[0] + agent.low.state_dim + agent.low.action_space.shape[0]
    )
    agent.learn(200)
    observation = agent.get_env().reset()
    agent.save(tmp_path / "agent")
    same = TBCHRL.load(tmp_path / "agent")
    state = again = None
    for _ in range(5):
        action, state = agent.predict(observation, state, deterministic=True)
        copy, again = same.predict(observation, again, deterministic=True)
        np.testing.assert_array_equal(action, copy)
    assert np.abs(state.membrane if hasattr(state, "membrane") else state[-1]).max() > 0
