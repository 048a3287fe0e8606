"""Options as data: the rules of a window, the live option of each environment, finished episodes. NumPy only."""

from __future__ import annotations

import enum
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from sb3_tbc.smdp.spaces import FloatArray


class TerminationReason(enum.Enum):
    """Why an option ended; stored by name."""

    REACHED = "reached"
    EXPIRED = "expired"
    EPISODE_END = "episode_end"
    EVENT = "event"


@dataclass(frozen=True)
class OptionRules:
    """How long an option may run and what ends it (paper section 4.1).

    :param dt_max: longest time budget, environment steps (may be fractional: episode length / ``max_options``)
    :param dt_min: shortest time budget; in ``"reached"`` mode no window ends before it unless the episode does
    :param max_options: high-level decisions allowed per episode; when they are used up the episode ends as a failure
    :param window_end: ``"timed"`` runs every window to the end of its budget (HiTS), ``"reached"`` also ends it when
        the subgoal is reached (paper, algorithm 1 line 20)
    :raises ValueError: if a number is out of range or ``window_end`` is unknown
    """

    dt_max: float
    dt_min: float = 0.0
    max_options: int = 20
    window_end: str = "timed"

    def __post_init__(self) -> None:
        if not 0.0 <= self.dt_min < self.dt_max:
            raise ValueError(
                f"time budgets need 0 <= dt_min < dt_max (environment steps), got dt_min={self.dt_min}, "
                f"dt_max={self.dt_max}"
            )
        if self.dt_max < 1.0:
            raise ValueError(f"dt_max must allow at least one environment step, got {self.dt_max}; lower max_options?")
        if self.max_options < 1:
            raise ValueError(f"max_options must be at least 1, got {self.max_options}")
        if self.window_end not in ("timed", "reached"):
            raise ValueError(f"window_end must be 'timed' or 'reached', got {self.window_end!r}")

    @property
    def dt_ref(self) -> float:
        """The typical window, which sets the scale of the SMDP reward and discount."""
        return self.dt_max / 2.0

    def budget(self, unit: FloatArray) -> FloatArray:
        """Time budget in steps of a unit action coordinate in [-1, 1]."""
        return np.asarray(self.dt_min + 0.5 * (unit + 1.0) * (self.dt_max - self.dt_min))

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

    def as_info(self) -> dict[str, Any]:
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

    @property
    def length(self) -> int:
        """Number of environment steps T."""
        return len(self.rewards)


class OptionClock:
    """The SMDP clock: the live option of every environment of a vector.

    :param n_envs: number of environments
    :param subgoal_dim: size of a subgoal
    :param rules: what ends an option
    """

    fields = ("unit_action", "subgoal", "time_budget", "testing", "elapsed", "used")
    """The arrays that hold its state, one row per environment."""

    def __init__(self, n_envs: int, subgoal_dim: int, rules: OptionRules) -> None:
        self.rules = rules
        self.unit_action = np.zeros((n_envs, subgoal_dim + 1))
        self.subgoal = np.zeros((n_envs, subgoal_dim))
        self.time_budget = np.zeros(n_envs)
        self.testing = np.zeros(n_envs, dtype=bool)
        self.elapsed = np.zeros(n_envs, dtype=np.int64)
        self.used = np.zeros(n_envs, dtype=np.int64)

    def begin_episode(self, indices: NDArray[np.intp]) -> None:
        """Forget the options used so far in the environments ``indices``."""
        self.used[indices] = 0

    def begin(
        self, indices: NDArray[np.intp], unit_action: FloatArray, subgoal: FloatArray, testing: NDArray[np.bool_]
    ) -> None:
        """Start a new option in each environment of ``indices``; arrays have one row per index."""
        self.unit_action[indices] = unit_action
        self.subgoal[indices] = subgoal
        self.time_budget[indices] = self.rules.budget(unit_action[:, -1])
        self.testing[indices] = testing
        self.elapsed[indices] = 0
        self.used[indices] += 1

    def tick(self) -> None:
        """One environment step has passed everywhere."""
        self.elapsed += 1

    @property
    def time_left(self) -> FloatArray:
        """Steps left of each time budget, ``(n_envs,)``; zero or below when it has expired."""
        return self.time_budget - self.elapsed

    @property
    def expired(self) -> NDArray[np.bool_]:
        """Whose time budget is spent, ``(n_envs,)``."""
        return np.asarray(self.elapsed >= self.time_budget)

    def close(self, index: int, step: int, reached: bool, episode_over: bool, event: bool = False) -> Option:
        """The option of environment ``index`` as a record; ``step`` is the number of steps of its episode so far."""
        expired = bool(self.elapsed[index] >= self.time_budget[index])
        if expired:
            reason = TerminationReason.REACHED if reached else TerminationReason.EXPIRED
        elif episode_over:
            reason = TerminationReason.EPISODE_END
        elif event:
            reason = TerminationReason.EVENT
        else:
            reason = TerminationReason.REACHED
        duration = int(self.elapsed[index])
        return Option(
            start=step - duration,
            duration=duration,
            unit_action=self.unit_action[index].copy(),
            subgoal=self.subgoal[index].copy(),
            time_budget=float(self.time_budget[index]),
            testing=bool(self.testing[index]),
            # an option that was cut off did not get to show whether it reaches its subgoal
            reached=reached and reason is TerminationReason.REACHED,
            reason=reason,
        )
