"""Windows that the high level ends before their time, because another option is worth more."""

from __future__ import annotations

import numpy as np

from sb3_tbc.arrays import BoolArray
from sb3_tbc.level.acting import ActingLevel
from sb3_tbc.smdp.goal_spaces import rows_of
from sb3_tbc.smdp.options import OptionClock, OptionRules
from sb3_tbc.smdp.spaces import GoalObservation
from sb3_tbc.smdp.views import LevelViews


class Reconsideration:
    """Which windows no longer serve: emergency action termination (arXiv 2211.06351) for timed subgoals.

    After each step the high level's critic values two options: the rest of the running one (its subgoal with the time
    that is left) and the one that the actor would choose now. Where the second is worth more by ``margin``, the window
    ends. Both values hold the price of a decision, and only the new option costs one: hence the margin.

    :param high: the high level
    :param views: what it sees and chooses
    :param rules: what ends an option
    :param margin: in the high level's rewards
    """

    def __init__(self, high: ActingLevel, views: LevelViews, rules: OptionRules, margin: float) -> None:
        self.high, self.views, self.rules, self.margin = high, views, rules, margin

    def __call__(self, seen: GoalObservation, clock: OptionClock) -> BoolArray:
        """Which windows end now, ``(n_envs,)``.

        :param seen: what the last step led to in every environment
        """
        over = np.zeros(len(clock.elapsed), dtype=bool)
        where = np.flatnonzero(clock.may_be_given_up)
        if not len(where):
            return over
        observations = self.views.high(rows_of(seen, where))
        time_left = self.rules.unit_budget(clock.time_left[where])
        rest = np.column_stack([self.views.subgoals.scale(clock.subgoal[where]), time_left])
        new = self.high.means(observations, average=True)
        values = self.high.values(np.concatenate([observations, observations]), np.concatenate([new, rest]))
        over[where] = values[: len(where)] > values[len(where) :] + self.margin
        return over
