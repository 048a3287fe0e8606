"""The lowest and the highest return that each level can have, from its rewards and its discount. No networks.

A critic's target above or below them is wrong, whatever the networks say; clipping targets to them keeps values from
running away (arXiv 2312.05787). The bounds are those of an episode: a level has only so many steps, the high level
``max_options`` decisions, the low level the steps of the longest time budget (HAC bounds its critics likewise). A state
from which success is possible within them has a value within the bounds; hopeless ones end at the lower one.

Soft actor-critic adds the policy's entropy to all values. A uniform policy has a positive entropy, so the best
soft value is never below the lowest return; and it exceeds the highest one by no more than the temperature times the
largest entropy of each later action, whose discounted number is :attr:`ValueBounds.later`.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from sb3_tbc.smdp.options import OptionRules
from sb3_tbc.smdp.rewards import HighLevelReward, LowLevelReward


class ValueBounds(NamedTuple):
    """Bounds of a level's returns."""

    low: float
    high: float
    later: float = 0.0  # discounted number of actions after the first, each of which may add its entropy


class RewardRange(NamedTuple):
    """Lowest and highest reward of one environment step."""

    low: float
    high: float


def geometric(gamma: float, n: int) -> float:
    """``1 + gamma + ... + gamma^(n - 1)``."""
    return float(n) if gamma == 1.0 else (1.0 - gamma**n) / (1.0 - gamma)


def high_level_bounds(
    reward: HighLevelReward, rules: OptionRules, rewards: RewardRange, testing_penalty: float | None
) -> ValueBounds:
    """Bounds of the return of at most ``max_options`` decisions.

    :param rewards: of the environment
    :param testing_penalty: reward of a failed test; None where nothing is tested
    """
    low, high = _decision_range(reward, rules, rewards)
    if testing_penalty is not None:
        low, high = min(low, testing_penalty), max(high, testing_penalty)
    # the largest discount that a decision can have: that of the shortest window, one step
    discount = float(reward.discounts(np.ones(1, dtype=np.int64))[0])
    return _bounds(low, high, discount, rules.max_options)


def _decision_range(reward: HighLevelReward, rules: OptionRules, rewards: RewardRange) -> tuple[float, float]:
    """Lowest and highest reward of one decision that is not a failed test."""
    low, high = rewards
    if reward.target == "smdp":
        # R(n) = r + gamma r + ... + gamma^(n - 1) r grows with a window's length n where r > 0 and falls where r < 0
        lengths = geometric(reward.gamma_step, 1), geometric(reward.gamma_step, math.ceil(rules.dt_max))
        low, high = min(low * n for n in lengths), max(high * n for n in lengths)
        low, high = (x / reward.dt_ref - reward.decision_cost for x in (low, high))
    shares = [rules.dt_min / rules.dt_max, 1.0]  # of the longest time budget
    if rules.whole_budgets:  # rounded, budgets may lie outside of their bounds, and so does their price
        shares = (rules.budget(np.array([-1.0, 1.0])) / rules.dt_max).tolist()
    costs = [reward.duration_cost * share for share in shares]
    bonus = reward.completion_bonus
    return low - max(costs) + min(bonus, 0.0), high - min(costs) + max(bonus, 0.0)


def low_level_bounds(reward: LowLevelReward, gamma: float) -> ValueBounds:
    """Bounds of the return of the steps of the longest time budget.

    :param gamma: discount per environment step
    """
    steps = max(math.ceil(reward.rules.dt_max), 1)
    later = geometric(gamma, steps) - 1.0
    if reward.kind == "step":  # -1 per step, 0 for the one that reaches the subgoal
        return ValueBounds(-geometric(gamma, steps), 0.0, later)
    # A hit is worth 1, once. Dense rewards add the changes of the degree of completion, c_k in [0, 1]: their sum,
    # -c_0 + (1 - gamma) (c_1 + gamma c_2 + ...) + gamma^(n - 1) c_n, lies in [-1, 1] as well.
    return ValueBounds(-1.0, 2.0, later) if reward.kind == "dense" else ValueBounds(0.0, 1.0, later)


def _bounds(low: float, high: float, discount: float, steps: int) -> ValueBounds:
    """Bounds of returns of one to ``steps`` rewards between ``low`` and ``high``, with at most this discount."""
    total = geometric(discount, steps)
    return ValueBounds(low * total if low < 0 else low, high * total if high > 0 else high, total - 1.0)
