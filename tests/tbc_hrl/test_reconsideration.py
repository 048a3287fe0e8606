"""Windows that the high level ends before their time: by which values, and that every way of acting agrees."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
import torch as th
from corridor import Corridor
from stable_baselines3.common.vec_env import DummyVecEnv

from sb3_tbc import TBCHRL
from sb3_tbc.errors import ConfigError
from sb3_tbc.export.policy import extract
from sb3_tbc.smdp.options import OptionClock, OptionRules, TerminationReason
from sb3_tbc.tbc_hrl.evaluation import evaluate_agent
from sb3_tbc.tbc_hrl.option_env import OptionEnv
from sb3_tbc.tbc_hrl.reconsideration import Reconsideration

SETTINGS: dict[str, Any] = {"max_options": 5, "compile": False, "seed": 0, "window_end": "reconsider"}


class KnownHigh:
    """A high level that would choose the middle of everything, worth as much as the test says."""

    def __init__(self, worth_new: list[float], worth_rest: list[float]) -> None:
        self.worth = np.array(worth_new + worth_rest)
        self.asked: list[Any] = []

    def means(self, observations: Any, average: bool) -> Any:
        assert average
        return np.zeros((len(observations), 2), dtype=np.float32)

    def values(self, observations: Any, unit_actions: Any) -> Any:
        self.asked.append(unit_actions)
        return self.worth


def clock_of(rules: OptionRules, n: int) -> OptionClock:
    clock = OptionClock(n, Corridor().subgoals, rules)
    clock.begin(np.arange(n), np.tile([0.5, 1.0], (n, 1)))
    for _ in range(4):
        clock.tick()
    return clock


def corridors(n: int) -> dict[str, Any]:
    return {
        "observation": np.zeros((n, 3)),
        "achieved_goal": np.zeros((n, 1)),
        "desired_goal": np.full((n, 1), 0.9),
    }


@pytest.fixture(scope="module")
def agent() -> TBCHRL:
    return TBCHRL("MultiInputPolicy", Corridor(), reconsider_margin=0.0, **SETTINGS).learn(600)


def test_a_window_ends_where_a_new_option_is_worth_more_by_the_margin(agent: TBCHRL) -> None:
    rules = OptionRules(dt_max=10.0, window_end="reconsider")
    high = KnownHigh([-3.0, -3.9, -5.0], [-4.1, -4.1, -4.1])
    decide = Reconsideration(high, agent.views, rules, margin=1.0)  # type: ignore[arg-type]
    assert decide(corridors(3), clock_of(rules, 3)).tolist() == [True, False, False]
    rest = high.asked[0][3:]
    assert rest[:, 0] == pytest.approx(0.5)  # the same subgoal ...
    assert rest[:, 1] == pytest.approx(rules.unit_budget(np.full(3, 6.0)))  # ... with the time that is left


def test_tests_last_windows_young_and_spent_ones_are_not_asked(agent: TBCHRL) -> None:
    rules = OptionRules(dt_max=10.0, dt_min=4.0, max_options=2, window_end="reconsider")
    clock = clock_of(rules, 5)
    clock.testing[0] = True
    clock.used[1] = 2
    clock.elapsed[2] = 3
    clock.elapsed[3] = 10
    high = KnownHigh([0.0], [-9.0])
    decide = Reconsideration(high, agent.views, rules, margin=1.0)  # type: ignore[arg-type]
    assert decide(corridors(5), clock).tolist() == [False, False, False, False, True]
    clock.testing[4] = True
    assert not decide(corridors(5), clock).any()
    assert len(high.asked) == 1


def test_an_option_that_was_given_up_is_cut_off_and_did_not_reach_its_subgoal() -> None:
    clock = clock_of(OptionRules(dt_max=10.0, window_end="reconsider"), 2)
    clock.give_up(np.array([True, False]))
    assert clock.ended(corridors(2)).tolist() == [True, False]
    option = clock.close(0, 4, reached=True, cut_off=False)
    assert (option.reason, option.reached, option.duration) == (TerminationReason.RECONSIDERED, False, 4)
    clock.begin(np.array([0]), np.array([[0.0, 1.0]]))
    assert not clock.ended(corridors(2)).any()


def test_values_are_the_lowest_of_the_critics(agent: TBCHRL) -> None:
    rng = np.random.default_rng(0)
    seen = rng.normal(size=(7, agent.high.policy.observation_space.shape[0])).astype(np.float32)  # type: ignore[index]
    actions = rng.uniform(-1, 1, (7, 2)).astype(np.float32)
    critics = [q.detach().numpy()[:, 0] for q in agent.high.policy.critic(th.as_tensor(seen), th.as_tensor(actions))]
    assert agent.high.acting.values(seen, actions) == pytest.approx(np.minimum(*critics), rel=1e-6)


def reasons(agent: TBCHRL, steps: int = 300) -> set[str]:
    assert agent.collector is not None
    found: set[str] = set()
    for _ in range(steps):
        step = agent.collector.step()
        found |= {info["option"]["reason"] for info in step.infos if "option" in info}
    return found


def test_windows_are_given_up_while_learning_and_a_high_margin_leaves_them_timed(agent: TBCHRL) -> None:
    assert "reconsidered" in reasons(agent)
    never = TBCHRL("MultiInputPolicy", Corridor(), **{**SETTINGS, "reconsider_margin": 1e6}).learn(300)
    timed = TBCHRL("MultiInputPolicy", Corridor(), **{**SETTINGS, "window_end": "timed"}).learn(300)
    for one, other in zip(never.policy.parameters(), timed.policy.parameters(), strict=True):
        assert np.array_equal(one.detach().numpy(), other.detach().numpy())


def test_predict_gives_up_the_windows_that_an_evaluation_does(agent: TBCHRL) -> None:
    evaluated = evaluate_agent(agent, Corridor(goal=0.99), 1, seed=5)
    env = Corridor(goal=0.99)
    observation, _ = env.reset(seed=5)
    state, used, over = None, 0, False
    start, steps = np.array([True]), 0
    while not over:
        batch = {key: value[None] for key, value in observation.items()}
        action, state = agent.predict(batch, state, start, deterministic=True)
        start = np.array([False])
        used = int(state[3][0])  # type: ignore[index]
        if used > agent.rules.max_options:
            used = agent.rules.max_options
            break
        observation, _, terminated, truncated, _ = env.step(action[0])
        over, steps = terminated or truncated, steps + 1
    assert (steps, used) == (evaluated.lengths[0], evaluated.decisions[0])


def test_saved_agents_go_on_reconsidering(agent: TBCHRL, tmp_path: Any) -> None:
    agent.save(tmp_path / "agent")
    loaded = TBCHRL.load(tmp_path / "agent")
    results = [evaluate_agent(one, Corridor(), 5, seed=1) for one in (agent, loaded)]
    assert results[0].lengths.tolist() == results[1].lengths.tolist()
    assert results[0].decisions.tolist() == results[1].decisions.tolist()


def test_what_cannot_reconsider_says_so(agent: TBCHRL) -> None:
    with pytest.raises(ConfigError, match="duration='joint'"):
        TBCHRL("MultiInputPolicy", Corridor(), **SETTINGS, duration="fixed")
    with pytest.raises(ConfigError, match="window_end='reconsider' cannot be exported"):
        extract(agent)
    with pytest.raises(ValueError, match="another algorithm cannot"):
        OptionEnv(DummyVecEnv([Corridor]), agent)
