"""Bounds of returns against closed forms and against episodes drawn at random."""

import math

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from sb3_tbc.smdp.bounds import RewardRange, ValueBounds, geometric, high_level_bounds, low_level_bounds
from sb3_tbc.smdp.options import OptionRules
from sb3_tbc.smdp.rewards import HighLevelReward, LowLevelReward
from sb3_tbc.smdp.spaces import SubgoalSpace

SPARSE = RewardRange(-1.0, 0.0)


def make_rules(
    dt_max: float = 10.0, dt_min: float = 0.0, max_options: int = 6, window_end: str = "timed"
) -> OptionRules:
    return OptionRules(dt_max, dt_min, max_options, window_end)


def make_reward(
    target: str = "decision", gamma: float = 0.9, rules: OptionRules | None = None, **kw: float
) -> HighLevelReward:
    rules = rules or make_rules()
    costs = {"decision_cost": 1.0, "duration_cost": 0.0, **kw}
    return HighLevelReward(target, gamma, rules.dt_ref, rules.dt_max, **costs)


def test_tennis_as_it_is_shipped() -> None:
    """Six decisions at -3 each, the penalty of a failed test: -3 (1 - .9^6) / .1."""
    bounds = high_level_bounds(make_reward(), make_rules(), SPARSE, -3.0)
    total = (1 - 0.9**6) / 0.1
    assert bounds == pytest.approx(ValueBounds(-3.0 * total, 0.0, total - 1.0))


def test_without_tests_the_task_alone_counts() -> None:
    bounds = high_level_bounds(make_reward(duration_cost=2.0), make_rules(dt_min=5.0), SPARSE, None)
    assert bounds.low == pytest.approx(-3.0 * (1 - 0.9**6) / 0.1)
    assert bounds.high == pytest.approx(-1.0)  # the shortest budget is half of the longest


def test_rounded_time_budgets_are_paid_for_as_they_are() -> None:
    """From 2.4 to 7.6 steps, the price is that of 2 to 8 steps."""
    rules = OptionRules(7.6, 2.4, max_options=1, whole_budgets=True)
    bounds = high_level_bounds(make_reward(rules=rules, duration_cost=2.0), rules, SPARSE, None)
    assert bounds.low == pytest.approx(-1.0 - 2.0 * 8 / 7.6)
    assert bounds.high == pytest.approx(-2.0 * 2 / 7.6)


def test_smdp_counts_windows() -> None:
    """dt_ref = 5, gamma_step = .9^(1/5): the lowest decision is the longest window, ten steps of -1."""
    bounds = high_level_bounds(make_reward("smdp", duration_cost=0.5), make_rules(), SPARSE, None)
    step = 0.9**0.2
    lowest = -(1 - step**10) / (1 - step) / 5 - 1.0 - 0.5
    assert bounds.low == pytest.approx(lowest * (1 - step**6) / (1 - step))
    assert bounds.high == pytest.approx(-1.0)


def test_positive_rewards_add_up() -> None:
    bounds = high_level_bounds(make_reward("smdp", decision_cost=0.0), make_rules(), RewardRange(0.0, 1.0), None)
    step = 0.9**0.2
    assert bounds.low == 0.0
    assert bounds.high == pytest.approx((1 - step**10) / (1 - step) / 5 * (1 - step**6) / (1 - step))


def test_completion_bonus_and_positive_penalty() -> None:
    plain = high_level_bounds(make_reward(), make_rules(), SPARSE, None)
    bonus = high_level_bounds(make_reward(completion_bonus=0.5), make_rules(), SPARSE, None)
    assert bonus.low == plain.low
    assert bonus.high == pytest.approx(0.5 * (1 - 0.9**6) / 0.1)


def test_no_discount() -> None:
    assert geometric(1.0, 7) == 7.0
    assert geometric(0.5, 3) == 1.75
    assert high_level_bounds(make_reward(gamma=1.0), make_rules(), SPARSE, -6.0).low == -36.0


@pytest.mark.parametrize(("kind", "low", "high"), [("sparse", 0.0, 1.0), ("dense", -1.0, 2.0)])
def test_low_level(kind: str, low: float, high: float) -> None:
    bounds = low_level_bounds(make_low(kind), 0.99)
    assert bounds == pytest.approx(ValueBounds(low, high, (1 - 0.99**10) / 0.01 - 1.0))


def test_low_level_that_pays_for_steps() -> None:
    total = (1 - 0.99**10) / 0.01
    assert low_level_bounds(make_low("step"), 0.99) == pytest.approx(ValueBounds(-total, 0.0, total - 1.0))


def make_low(kind: str, window_end: str = "timed") -> LowLevelReward:
    space = SubgoalSpace(
        low=[0, 0],
        high=[1, 1],
        thresholds=[0.1, 0.1],
        achieved=lambda seen: seen["achieved_goal"],
        local=lambda seen: seen["observation"],
        local_scale=[1],
        names=("x", "y"),
    )
    return LowLevelReward(kind, space, make_rules(9.5, window_end=window_end))


@settings(max_examples=100, deadline=None)
@given(
    seed=st.integers(0, 10_000),
    target=st.sampled_from(["smdp", "decision"]),
    gamma=st.floats(0.5, 1.0),
    costs=st.tuples(*(st.floats(0.0, 3.0) for _ in range(2)), st.floats(-1.0, 1.0)),
    rewards=st.tuples(st.floats(-5.0, 5.0), st.floats(0.0, 5.0)),
    penalty=st.none() | st.floats(-10.0, 1.0),
    dt_min=st.sampled_from([0.0, 3.0]),
)
def test_no_episode_returns_more_or_less(seed, target, gamma, costs, rewards, penalty, dt_min) -> None:
    rng = np.random.default_rng(seed)
    rules = make_rules(dt_max=7.5, dt_min=dt_min)
    reward = HighLevelReward(target, gamma, rules.dt_ref, rules.dt_max, *costs)
    low, high = rewards[0], rewards[0] + rewards[1]
    bounds = high_level_bounds(reward, rules, RewardRange(low, high), penalty)
    budgets = rng.choice([dt_min, rules.dt_max, rng.uniform(dt_min, rules.dt_max)], rng.integers(1, 7))
    durations = np.maximum(np.ceil(budgets), 1).astype(np.int64)
    durations[-1] = rng.integers(1, durations[-1] + 1)  # the episode's end cuts the last window
    starts = np.concatenate([[0], np.cumsum(durations)[:-1]])
    steps = rng.choice([low, high, rng.uniform(low, high)], durations.sum())
    gained = reward.window_rewards(steps, starts, durations) - reward.duration_cost * budgets / rules.dt_max
    gained += reward.completion_bonus * rng.integers(0, 2, len(gained))
    if penalty is not None:
        gained = np.where(rng.random(len(gained)) < 0.5, penalty, gained)
    discounts = np.concatenate([[1.0], np.cumprod(reward.discounts(durations))[:-1]])
    value = float((discounts * gained).sum())
    assert bounds.low - 1e-6 <= value <= bounds.high + 1e-6


@settings(max_examples=60, deadline=None)
@given(seed=st.integers(0, 10_000), kind=st.sampled_from(["sparse", "dense", "step"]), gamma=st.floats(0.5, 1.0))
def test_no_window_returns_more_or_less(seed: int, kind: str, gamma: float) -> None:
    rng = np.random.default_rng(seed)
    reward = make_low(kind)
    n = int(rng.integers(1, math.ceil(reward.rules.dt_max) + 1))
    points = rng.choice([0.0, 0.5, 1.0], (n + 1, 2))
    subgoal = np.repeat(rng.choice([0.0, 0.5, 1.0], (1, 2)), n, axis=0)
    expired = np.arange(n) == n - 1
    gained, over = reward.rewards_and_ends(points[:-1], points[1:], subgoal, expired)
    end = int(np.argmax(over)) + 1 if over.any() else n
    value = float((gamma ** np.arange(end) * gained[:end]).sum())
    bounds = low_level_bounds(reward, gamma)
    assert bounds.low - 1e-9 <= value <= bounds.high + 1e-9
