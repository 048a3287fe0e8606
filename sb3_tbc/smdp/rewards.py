"""What each level is rewarded for, and the high level's discount. NumPy only."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from sb3_tbc.arrays import BoolArray, FloatArray, IntArray
from sb3_tbc.smdp.options import OptionRules
from sb3_tbc.smdp.spaces import SubgoalSpace

KINDS = ("sparse", "dense", "step")


@dataclass(frozen=True)
class LowLevelReward:
    """Reward and end of a low-level step, for subgoals asked for and subgoals given in hindsight alike.

    ``"sparse"`` (HiTS): 1 where the window ends with its subgoal reached, else 0. ``"dense"``: the same plus what the
    step added to the subgoal's degree of completion, so that the rewards of a window sum up to how much nearer it came
    (paper section 4.1: the low level's reward "measures the degree of subgoal completion and is updated at every
    step"; it gives no formula). ``"step"`` (HAC): -1 per step, 0 where the subgoal is reached; only reaching it ends
    the low level's problem, running out of time does not.

    :param kind: ``"sparse"``, ``"dense"`` or ``"step"``
    :param subgoals: thresholds and bounds
    :param rules: what ends a window
    :raises ValueError: if ``kind`` is unknown
    """

    kind: str
    subgoals: SubgoalSpace
    rules: OptionRules

    def __post_init__(self) -> None:
        if self.kind not in KINDS:
            raise ValueError(f"low_reward must be one of {', '.join(map(repr, KINDS))}, got {self.kind!r}")

    def completion(self, achieved: FloatArray, subgoal: FloatArray) -> FloatArray:
        """Degree of completion in [0, 1], ``(n,)``: 1 less the root mean square distance in bounds' widths."""
        distance = (achieved - subgoal) / (self.subgoals.high - self.subgoals.low)
        return np.asarray(np.maximum(1.0 - np.sqrt(np.square(distance).mean(axis=-1)), 0.0))

    def rewards_and_ends(
        self,
        here: FloatArray,
        achieved: FloatArray,
        subgoal: FloatArray,
        expired: BoolArray,
        may_end: BoolArray | bool = True,
    ) -> tuple[FloatArray, BoolArray]:
        """Rewards ``(n,)`` and whether the low level's problem is over ``(n,)``.

        :param here: subgoal-space points before the steps, ``(n, subgoal_dim)``
        :param achieved: and after them
        :param subgoal: what was asked for
        :param expired: whether the time budget is spent after the step, ``(n,)``
        :param may_end: whether reaching the subgoal may end the window yet (``dt_min``)
        """
        reached = self.subgoals.reached(achieved, subgoal)
        if self.kind == "step":
            return reached.astype(np.float64) - 1.0, reached
        over = self.rules.completed(expired, reached, may_end)
        rewards = (over & reached).astype(np.float64)
        if self.kind == "dense":
            rewards += self.completion(achieved, subgoal) - self.completion(here, subgoal)
        return rewards, over


@dataclass(frozen=True)
class HighLevelReward:
    """The high level's reward and discount (paper section 4.1, with the scale of docs/decisions.md).

    :param target: ``"smdp"``: ``R(dt) / dt_ref - decision_cost - duration_cost * dt / dt_max``, discounted by
        ``gamma_step ** duration``; ``"decision"`` (HiTS): the last reward of the window minus the duration cost,
        discounted by ``gamma`` once per decision
    :param gamma: discount per decision
    :param dt_ref: typical window, environment steps; ``gamma_step = gamma ** (1 / dt_ref)``
    :param dt_max: longest window, environment steps
    :param decision_cost: price of a decision (``"smdp"`` only: the HiTS reward has it built in)
    :param duration_cost: price of the longest time budget
    :param completion_bonus: added where an option reached its subgoal, in hindsight too (paper section 4.5)
    :raises ValueError: if ``target`` is unknown
    """

    target: str
    gamma: float
    dt_ref: float
    dt_max: float
    decision_cost: float
    duration_cost: float
    completion_bonus: float = 0.0

    def __post_init__(self) -> None:
        if self.target not in ("smdp", "decision"):
            raise ValueError(f"target must be 'smdp' or 'decision', got {self.target!r}")

    @property
    def gamma_step(self) -> float:
        """Discount per environment step."""
        return float(self.gamma ** (1.0 / self.dt_ref)) if self.target == "smdp" else 1.0

    def window_rewards(self, step_rewards: FloatArray, starts: IntArray, durations: IntArray) -> FloatArray:
        """Reward of windows that lie one behind the other in ``step_rewards``, before the duration cost, ``(n,)``."""
        if self.target == "decision":
            return np.asarray(step_rewards[starts + durations - 1], dtype=np.float64)
        return discounted_sums(step_rewards, starts, durations, self.gamma_step) / self.dt_ref - self.decision_cost

    def price(self, time_budgets: FloatArray) -> FloatArray:
        """What time budgets in steps cost, ``(n,)``: the duration cost."""
        return np.asarray(self.duration_cost * time_budgets / self.dt_max)

    def discounts(self, durations: IntArray) -> FloatArray:
        """Factor of the next state's value for windows of these lengths, ``(n,)``."""
        if self.target == "decision":
            return np.full(len(durations), self.gamma)
        return np.asarray(self.gamma_step**durations)


def discounted_sums(step_rewards: FloatArray, starts: IntArray, durations: IntArray, gamma: float) -> FloatArray:
    """``sum_j gamma^j r_(start + j)`` of each window; windows must cover ``step_rewards`` in order (paper, R(dt))."""
    within = np.arange(len(step_rewards)) - np.repeat(starts, durations)
    return np.add.reduceat(step_rewards * gamma**within, starts)
