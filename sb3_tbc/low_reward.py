"""What the low level is rewarded for: the degree to which its subgoal is completed. NumPy only."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from sb3_tbc.options import OptionRules
from sb3_tbc.spaces import FloatArray, SubgoalSpace

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

    def of(
        self,
        here: FloatArray,
        achieved: FloatArray,
        subgoal: FloatArray,
        expired: NDArray[np.bool_],
        may_end: NDArray[np.bool_] | bool = True,
    ) -> tuple[FloatArray, NDArray[np.bool_]]:
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
        over = expired | (reached & may_end) if self.rules.window_end == "reached" else expired
        rewards = (over & reached).astype(np.float64)
        if self.kind == "dense":
            rewards += self.completion(achieved, subgoal) - self.completion(here, subgoal)
        return rewards, over
