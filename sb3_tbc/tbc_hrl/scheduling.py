"""Who decides how long a window lasts: the high level, the reachability rule, or nobody."""

from __future__ import annotations

import math

import numpy as np

from sb3_tbc.arrays import Float32, FloatArray
from sb3_tbc.level.acting import ActingLevel
from sb3_tbc.smdp.options import OptionRules
from sb3_tbc.smdp.spaces import GoalObservation
from sb3_tbc.smdp.views import LevelViews
from sb3_tbc.tbc_hrl.reachability import Reachability


class FixedWindows:
    """Every window has the same length (HIRO's schedule; HAC's action budget of the low level).

    :param rules: bounds of a time budget
    :param steps: window length, rounded up to whole steps
    :raises ValueError: if the length lies outside of the bounds
    """

    def __init__(self, rules: OptionRules, steps: float) -> None:
        if not max(1.0, rules.dt_min) <= steps <= rules.dt_max:
            raise ValueError(
                f"fixed_duration must lie between max(1, dt_min={rules.dt_min:g}) and dt_max={rules.dt_max:g} steps, "
                f"got {steps}"
            )
        # half a step less than whole, so that no rounding error adds a step
        whole = round(steps) if rules.whole_budgets else math.ceil(steps) - 0.5
        self.unit = float(rules.unit_budget(np.array(whole)))

    def __call__(self, unit_actions: FloatArray, observation: GoalObservation) -> FloatArray:
        """Append the time budget to unit subgoals ``(n, subgoal_dim)``."""
        return np.concatenate([unit_actions, np.full((len(unit_actions), 1), self.unit)], axis=1)


class ReachRule:
    """Time budgets by the rule ``dt* = clip(kappa * H_reach(s, g), dt_min, dt_max)`` (paper, equation 1).

    :param views: reads state and place out of goal observations
    :param rules: bounds of a time budget
    :param reachability: the estimate of ``H_reach``
    :param kappa: the paper's temporal scaling (table A2), 0.6 to 1.2
    :raises ValueError: if ``kappa`` is not positive
    """

    def __init__(self, views: LevelViews, rules: OptionRules, reachability: Reachability, kappa: float) -> None:
        if kappa <= 0:
            raise ValueError(f"kappa must be positive (the paper's lie in [0.6, 1.2]), got {kappa}")
        self.views, self.rules, self.reachability, self.kappa = views, rules, reachability, kappa

    def steps(self, local: FloatArray, here: FloatArray, subgoal: FloatArray) -> FloatArray:
        """Time budgets ``(n,)`` in steps for subgoals in task units."""
        reach = self.reachability.steps(local, here, subgoal)
        return np.asarray(np.clip(self.kappa * reach, self.rules.dt_min, self.rules.dt_max))

    def __call__(self, unit_actions: FloatArray, observation: GoalObservation) -> FloatArray:
        """Append the rule's time budget to unit subgoals ``(n, subgoal_dim)``."""
        subgoals = self.views.subgoals
        local, here = subgoals.local(observation), subgoals.achieved(observation)
        unit = self.rules.unit_budget(self.steps(local, here, subgoals.unscale(unit_actions)))
        return np.concatenate([unit_actions, unit[:, None]], axis=1)


class DurationTeacher:
    """Pseudo-labels of the duration loss: the rule's time budget for the subgoal that the high level would choose now.

    Time budget and subgoal are independent given the state (a diagonal Gaussian), so the mean's subgoal serves.
    """

    def __init__(self, rule: ReachRule, high: ActingLevel) -> None:
        self.rule, self.high = rule, high

    def __call__(self, observations: Float32, local: Float32, here: Float32) -> Float32:
        """Unit time budgets ``(n,)`` of high-level observations and of the states they were made of."""
        subgoal = self.rule.views.subgoals.unscale(self.high.means(observations)[:, :-1])
        return self.rule.rules.unit_budget(self.rule.steps(local, here, subgoal)).astype(np.float32)
