"""One number for a learning curve: what a search maximises or minimises."""

from __future__ import annotations

import statistics
from collections.abc import Callable, Sequence
from typing import Literal, NamedTuple

from sb3_tbc.zoo.callbacks import EvaluationRow

Rows = Sequence[EvaluationRow]


class Objective(NamedTuple):
    """A score and the direction in which it improves; ``score(rows, n_timesteps, threshold)`` rates a curve so far."""

    direction: Literal["minimize", "maximize"]
    score: Callable[[Rows, int, float], float]
    text: str


def final(rows: Rows, n_timesteps: int, threshold: float) -> float:
    """Success rate of the last evaluation."""
    return rows[-1].success_rate if rows else 0.0


def best(rows: Rows, n_timesteps: int, threshold: float) -> float:
    """Success rate of the best evaluation."""
    return max((row.success_rate for row in rows), default=0.0)


def area(rows: Rows, n_timesteps: int, threshold: float) -> float:
    """Area under the success curve from step 0 (success 0) to the last evaluation, by trapezoids, over its length."""
    total, steps, rate = 0.0, 0, 0.0
    for row in rows:
        total += 0.5 * (rate + row.success_rate) * (row.timesteps - steps)
        steps, rate = row.timesteps, row.success_rate
    return total / steps if steps else 0.0


def steps_to_success(rows: Rows, n_timesteps: int, threshold: float) -> float:
    """Environment steps until an evaluation first reaches ``threshold``.

    A run that does not reach it gets ``n_timesteps (2 - best success / threshold)``: worse than all runs that do, and
    better the nearer it came.
    """
    for row in rows:
        if row.success_rate >= threshold:
            return float(row.timesteps)
    return n_timesteps * (2.0 - best(rows, n_timesteps, threshold) / threshold)


OBJECTIVES = {
    "auc": Objective("maximize", area, "area under the success curve"),
    "final": Objective("maximize", final, "success rate of the last evaluation"),
    "best": Objective("maximize", best, "success rate of the best evaluation"),
    "success": Objective("maximize", final, "success rate of the evaluation after training"),
    "steps-to-success": Objective("minimize", steps_to_success, "steps until the success rate reaches --threshold"),
}
ACROSS: dict[str, Callable[[Sequence[float]], float]] = {"mean": statistics.fmean, "median": statistics.median}
"""How the values of a trial's seeds are combined."""
