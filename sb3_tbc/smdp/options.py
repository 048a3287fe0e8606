"""Options as data: the rules of a window, the live option of each environment, finished episodes. NumPy only."""

from __future__ import annotations

import enum
import math
from dataclasses import dataclass
from numbers import Integral
from typing import NamedTuple

import numpy as np

from sb3_tbc.aliases import Plain
from sb3_tbc.arrays import Arrays, BoolArray, FloatArray, Indices, IntArray
from sb3_tbc.errors import NonFiniteError
from sb3_tbc.smdp.goal_spaces import GOAL_KEYS
from sb3_tbc.smdp.spaces import GoalObservation, SubgoalSpace


class TerminationReason(enum.Enum):
    """What ended an option; stored by name. Whether its subgoal was reached is another question.

    ``REACHED`` is an end *before* the time budget, because the subgoal was reached; ``EXPIRED`` the end of the budget,
    reached or not; ``EPISODE_END`` and ``EVENT`` cut an option off; ``RECONSIDERED`` is cut off by the high level. The
    last option that an episode may have ends the episode, and keeps the reason of its own end.
    """

    REACHED = "reached"
    EXPIRED = "expired"
    EPISODE_END = "episode_end"
    EVENT = "event"
    RECONSIDERED = "reconsidered"


WINDOW_ENDS = ("timed", "reached", "reconsider")
"""What may end a window, see :class:`OptionRules`."""


@dataclass(frozen=True)
class OptionRules:
    """How long an option may run and what ends it (paper section 4.1).

    :param dt_max: longest time budget, environment steps (may be fractional: episode length / ``max_options``)
    :param dt_min: shortest time budget; in ``"reached"`` mode no window ends before it unless the episode does
    :param max_options: high-level decisions allowed per episode; when they are used up the episode ends as a failure
    :param window_end: ``"timed"`` runs every window to the end of its budget (HiTS), ``"reached"`` also ends it when
        the subgoal is reached (paper, algorithm 1 line 20), ``"reconsider"`` also when the high level values a new
        option more than the rest of this one (see :class:`~sb3_tbc.tbc_hrl.reconsideration.Reconsideration`)
    :param whole_budgets: round time budgets to the nearest whole number of steps, at least 1 (paper section 4.1); else
        a fractional budget lasts until the first whole step that is not shorter
    :raises ValueError: if a number is out of range or ``window_end`` is unknown
    """

    dt_max: float
    dt_min: float = 0.0
    max_options: int = 20
    window_end: str = "timed"
    whole_budgets: bool = False

    def __post_init__(self) -> None:
        if not 0.0 <= self.dt_min < self.dt_max:
            raise ValueError(
                f"time budgets need 0 <= dt_min < dt_max (environment steps), got dt_min={self.dt_min}, "
                f"dt_max={self.dt_max}"
            )
        if self.dt_max < 1.0:
            raise ValueError(f"dt_max must allow at least one environment step, got {self.dt_max}; lower max_options?")
        if math.isinf(self.dt_max):
            raise ValueError("dt_max must be a finite number of environment steps: time budgets are shares of it")
        if isinstance(self.max_options, bool) or not isinstance(self.max_options, Integral) or self.max_options < 1:
            raise ValueError(f"max_options must be a whole number of at least 1, got {self.max_options!r}")
        if self.window_end not in WINDOW_ENDS:
            raise ValueError(f"window_end must be one of {', '.join(map(repr, WINDOW_ENDS))}, got {self.window_end!r}")

    @property
    def dt_ref(self) -> float:
        """The typical window, which sets the scale of the SMDP reward and discount."""
        return self.dt_max / 2.0

    @property
    def ends_when_reached(self) -> bool:
        """Whether a window ends as soon as its subgoal is reached."""
        return self.window_end == "reached"

    @property
    def may_be_reconsidered(self) -> bool:
        """Whether the high level may end a window before its time."""
        return self.window_end == "reconsider"

    def completed(self, expired: BoolArray, reached: BoolArray | None, may_end: BoolArray | bool = True) -> BoolArray:
        """Which windows ended by their own rule, i.e. were not cut off from outside.

        This is the one place for the rule: acting and both levels' learning use it.

        :param expired: whose time budget is spent
        :param reached: whose subgoal is reached; may be None where that ends no window
        :param may_end: whose window is old enough (``dt_min``) to end by reaching its subgoal
        """
        return expired | (reached & may_end) if self.ends_when_reached and reached is not None else expired

    def budget(self, unit: FloatArray) -> FloatArray:
        """Time budget in steps of a unit action coordinate in [-1, 1]."""
        steps = self.dt_min + 0.5 * (unit + 1.0) * (self.dt_max - self.dt_min)
        return np.maximum(np.rint(steps), 1.0) if self.whole_budgets else np.asarray(steps)

    def lasts(self, budget: float) -> int:
        """Steps that a window of this time budget lasts if nothing cuts it off, at least 1."""
        return max(round(budget) if self.whole_budgets else math.ceil(budget), 1)

    def budget_that_lasted(self, steps: FloatArray, rng: np.random.Generator) -> FloatArray:
        """Time budgets that expire after exactly ``steps`` steps, drawn uniformly before rounding, ``(n,)``."""
        return np.asarray(steps + (0.5 if self.whole_budgets else 0.0) - rng.random(len(steps)))

    def unit_budget(self, steps: FloatArray) -> FloatArray:
        """Unit action coordinate of a time budget, clipped to [-1, 1]."""
        return np.asarray(np.clip(2.0 * (steps - self.dt_min) / (self.dt_max - self.dt_min) - 1.0, -1.0, 1.0))

    def remaining(self, steps: FloatArray) -> FloatArray:
        """Remaining time as the low level sees it: ``clip(dt_rem / dt_max, 0, 1)`` (paper section 4.1)."""
        return np.asarray(np.minimum(np.maximum(steps / self.dt_max, 0.0), 1.0))  # clip takes twice as long


class Option(NamedTuple):
    """A finished option; steps count from the start of its episode."""

    start: int
    duration: int
    unit_action: FloatArray  # (subgoal_dim + 1,), what the high level chose, in [-1, 1]
    subgoal: FloatArray  # (subgoal_dim,), task units
    time_budget: float
    testing: bool
    reached: bool
    reason: TerminationReason

    def as_info(self) -> Plain:
        """The trace that ``info["option"]`` carries, plain data."""
        return {
            "subgoal": self.subgoal.copy(),
            "time_budget": self.time_budget,
            "duration": self.duration,
            "reached": self.reached,
            "reason": self.reason.name.lower(),
        }


class Episode(NamedTuple):
    """Everything both levels learn from in one finished episode of T steps; float32 unless said.

    Row t of a (T+1, .) array is what was seen before step t; the last row is what the last step led to.
    """

    observation: FloatArray  # (T+1, obs_dim)
    achieved_goal: FloatArray  # (T+1, goal_dim), float64: hindsight rewards are exact
    desired_goal: FloatArray  # (T+1, goal_dim), float64
    actions: FloatArray  # (T, action_dim), unit coordinates
    states: FloatArray  # (T, state_dim), membrane potentials before the step
    next_states: FloatArray  # (T, state_dim), and after it
    rewards: FloatArray  # (T,), the environment's
    options: tuple[Option, ...]
    terminated: bool
    success: bool
    budget_exhausted: bool = False  # it ended because the high level's decisions were used up

    @property
    def length(self) -> int:
        """Number of environment steps T."""
        return len(self.rewards)

    def seen(self, steps: IntArray | slice) -> Arrays:
        """Goal observations before the steps, one row each; step T is the end of the episode."""
        return {key: getattr(self, key)[steps] for key in GOAL_KEYS}


class OptionClock:
    """The SMDP clock: the live option of every environment of a vector.

    The same clock runs while an agent learns, is evaluated, and in ``predict``, which carries its fields
    :attr:`carried` from call to call.

    :param n_envs: number of environments
    :param subgoals: what may be asked for
    :param rules: what ends an option
    """

    carried = ("subgoal", "time_budget", "elapsed", "used")
    """The fields that acting needs, one row per environment."""
    fields = ("unit_action", *carried, "testing")
    """All fields."""

    def __init__(self, n_envs: int, subgoals: SubgoalSpace, rules: OptionRules) -> None:
        self.subgoals, self.rules = subgoals, rules
        self.unit_action = np.zeros((n_envs, subgoals.dim + 1))
        self.subgoal = np.zeros((n_envs, subgoals.dim))
        self.time_budget = np.zeros(n_envs)
        self.testing = np.zeros(n_envs, dtype=bool)
        self.elapsed = np.zeros(n_envs, dtype=np.int64)
        self.used = np.zeros(n_envs, dtype=np.int64)
        self._given_up = np.zeros(n_envs, dtype=bool)  # by the high level, after the last step

    def begin_episode(self, indices: Indices) -> None:
        """Forget the options used so far in the environments ``indices``."""
        self.used[indices] = 0

    def begin(self, indices: Indices, unit_action: FloatArray, testing: BoolArray | bool = False) -> None:
        """Start a new option in each environment of ``indices``.

        :param unit_action: subgoal and time budget in [-1, 1], one row per index
        :param testing: whether the option is a subgoal test
        :raises ValueError: for another number of rows or columns, which NumPy might spread over all environments
        :raises NonFiniteError: for NaN, whose window would never end
        """
        n, width = len(indices), self.unit_action.shape[1]
        if np.shape(unit_action) != (n, width) or np.shape(testing) not in ((), (n,)):
            raise ValueError(
                f"{n} options need unit actions ({n}, {width}), subgoal and time budget, and testing ({n},); got "
                f"{np.shape(unit_action)} and {np.shape(testing)}"
            )
        if not np.isfinite(unit_action).all():
            raise NonFiniteError(f"the high level's subgoals and time budgets are not finite: {unit_action.tolist()}")
        self.unit_action[indices] = unit_action
        self.subgoal[indices] = self.subgoals.unscale(unit_action[:, :-1])
        self.time_budget[indices] = self.rules.budget(unit_action[:, -1])
        self.testing[indices] = testing
        self.elapsed[indices] = 0
        self.used[indices] += 1
        self._given_up[indices] = False

    def tick(self, where: BoolArray | bool = True) -> None:
        """One environment step has passed, everywhere or in the environments of a mask ``(n_envs,)``."""
        self.elapsed += where

    @property
    def time_left(self) -> FloatArray:
        """Steps left of each time budget, ``(n_envs,)``; zero or below when it has expired."""
        return self.time_budget - self.elapsed

    @property
    def remaining(self) -> FloatArray:
        """Remaining time as the low level sees it, in [0, 1], ``(n_envs,)``."""
        return self.rules.remaining(self.time_left)

    @property
    def expired(self) -> BoolArray:
        """Whose time budget is spent, ``(n_envs,)``."""
        return np.asarray(self.elapsed >= self.time_budget)

    @property
    def is_last(self) -> BoolArray:
        """Whose option uses up the decisions of its episode, ``(n_envs,)``."""
        return np.asarray(self.used >= self.rules.max_options)

    @property
    def may_end(self) -> BoolArray:
        """Whose window is old enough to end by reaching its subgoal, ``(n_envs,)``."""
        return np.asarray(self.elapsed >= self.rules.dt_min)

    @property
    def may_be_given_up(self) -> BoolArray:
        """Which windows the high level may end now, ``(n_envs,)``: no test, and not the episode's last."""
        return np.asarray(self.may_end & ~self.testing & ~self.expired & ~self.is_last)

    def give_up(self, which: BoolArray) -> None:
        """Let the windows of a mask ``(n_envs,)`` end with the last step."""
        self._given_up |= which

    def ended(self, seen: GoalObservation) -> BoolArray:
        """Whose window is over, ``(n_envs,)``: by its own rule, given up by the high level, or by the task's event.

        :param seen: what the last step led to
        """
        reached = self.reached(seen) if self.rules.ends_when_reached else None
        over = self.rules.completed(self.expired, reached, self.may_end) | self._given_up
        return over if self.subgoals.event is None else over | self.subgoals.happened(seen)

    def reached(self, seen: GoalObservation, where: Indices | slice = slice(None)) -> BoolArray:
        """Whose subgoal is reached, among the environments ``where``; ``seen`` has one row for each of them."""
        return self.subgoals.reached(self.subgoals.achieved(seen), self.subgoal[where])

    def close(self, index: int, step: int, reached: bool, cut_off: bool) -> Option:
        """The option of environment ``index`` as a record.

        An option that was cut off had no chance to reach its subgoal: it counts as not reached.

        :param step: the number of steps of its episode so far
        :param reached: whether its subgoal is reached now
        :param cut_off: whether the episode ends with this step, and not because this was the last window it may have;
            if not, and the window is not at an end of its own, the high level gave it up or the task's event ended it
        """
        expired, early = self.expired[index], self.may_end[index]
        if expired:
            reason = TerminationReason.EXPIRED
        elif self.rules.completed(expired, np.asarray(reached), early):
            reason = TerminationReason.REACHED
        elif cut_off:
            reason = TerminationReason.EPISODE_END
        else:
            reason = TerminationReason.RECONSIDERED if self._given_up[index] else TerminationReason.EVENT
        duration = int(self.elapsed[index])
        return Option(
            start=step - duration,
            duration=duration,
            unit_action=self.unit_action[index].copy(),
            subgoal=self.subgoal[index].copy(),
            time_budget=float(self.time_budget[index]),
            testing=bool(self.testing[index]),
            reached=reached and reason in (TerminationReason.EXPIRED, TerminationReason.REACHED),
            reason=reason,
        )
