"""Comparisons of TBC-HRL with every baseline and with its own ablations: tests, intervals, environment steps saved."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import NamedTuple

import numpy as np

from sb3_tbc import stats
from sb3_tbc.report.conditions import differences
from sb3_tbc.report.runs import (
    OURS,
    Results,
    Run,
    is_shipped,
    on_union_of_steps,
    reference_of,
    shipped,
    successes,
)
from sb3_tbc.zoo.config import ABLATIONS, OF_PAPER

BLOCK = 10
"""Episodes in a block of the paired bootstrap: the number of episodes that are evaluated in parallel."""
CONVERGED = 0.5
"""If no method reaches this success, the paper reports no convergence gain (Tennis2D), and neither do we."""


class Gain(NamedTuple):
    """Environment steps until the mean curve first reaches a threshold; ``None`` if it never does."""

    threshold: float
    ours: int | None
    theirs: int | None
    until: int  # where the other method's mean curve ends
    ours_until: int  # where ours ends

    @property
    def ahead(self) -> bool | None:
        """Whether ours reaches the threshold first; ``None`` if one side was trained for too few steps to tell.

        A curve that ends before the other one is at the threshold might have been there first.
        """
        if self.ours is not None and self.theirs is not None:
            return self.ours < self.theirs
        if self.ours is not None:
            return True if self.until >= self.ours else None
        return None if self.theirs is not None and self.ours_until < self.theirs else False

    def __str__(self) -> str:
        if self.ours is not None and self.theirs is not None:
            return f"{self.theirs - self.ours:,}"
        if self.ours is not None:
            short = f"trained for {self.until:,} only, ours needs {self.ours:,}"
            return short if self.ahead is None else f"not reached in {self.until:,}"
        if self.theirs is not None:
            short = f"ours was trained for {self.ours_until:,} only, the other needs {self.theirs:,}"
            return short if self.ahead is None else "ours does not reach it"
        return "-"


class Row(NamedTuple):
    """One comparison of ours, with shipped settings or the paper's, with another row of a task."""

    task: str
    other: str
    interval: stats.Interval
    test: stats.Comparison
    gain: Gain | None
    strongest: bool
    unequal: tuple[str, ...] = ()  # conditions in which the other row differs, our value in brackets
    ours: str = OURS  # our row


def interval_of(runs: Sequence[Run]) -> stats.Interval:
    """Mean final success over seeds and its interval, which is never of width zero if the episodes are known."""
    episodes = [run.episodes for run in runs]
    if not all(episodes):
        return stats.bootstrap_mean(successes(runs))
    return stats.success_interval(successes(runs), episodes)


def difference_of(first: Sequence[Run], second: Sequence[Run]) -> stats.Interval:
    """Difference of the mean success and its interval.

    With fewer than three seeds on a side, episodes are resampled in pairs if both sides recorded them on the same
    evaluation seeds (paper, section 5.1). The interval is never narrower than the one combined from both sides.
    """
    combined = stats.difference(interval_of(first), interval_of(second))
    if min(len(first), len(second)) >= stats.FEWEST_SEEDS:
        return combined
    ours, theirs = _outcomes_by_seed(first), _outcomes_by_seed(second)
    pairs = [(outcomes, theirs.get(seed)) for seed, outcomes in ours.items()]
    whole = [(a, b) for a, b in pairs if a and b and len(a) == len(b)]
    if len(whole) < max(len(first), len(second)):
        return combined
    paired = stats.paired_block_bootstrap([a for a, _ in whole], [b for _, b in whole], BLOCK)
    return stats.Interval(combined.mean, min(combined.low, paired.low), max(combined.high, paired.high))


def _outcomes_by_seed(runs: Sequence[Run]) -> dict[int, list[int] | None]:
    """Outcomes of each run's episodes by its evaluation seed; empty where seeds do not tell runs apart, or are missing.

    Without them, which run of the other side has the same episodes would be a guess.
    """
    seeds = [run.final.get("eval_seed") for run in runs]
    alone = None not in seeds and len(set(seeds)) == len(seeds)
    return {seed: run.outcomes for seed, run in zip(seeds, runs, strict=True) if seed is not None} if alone else {}


def mean_curve(runs: Sequence[Run]) -> tuple[list[int], list[float]] | None:
    """Mean success over seeds at all evaluated steps; ``None`` without curves, or if they have no steps in common."""
    curves = [run.curve for run in runs if run.rows]
    if not curves:
        return None
    steps, values = on_union_of_steps(curves)
    if not len(steps):  # a seed ends before another one is evaluated for the first time
        return None
    return steps.astype(int).tolist(), values.mean(axis=0).tolist()


def common_threshold(methods: Mapping[str, Sequence[Run]]) -> float | None:
    """0.9 of the best mean success that any method with shipped settings reaches in an evaluation.

    The best method sets it, so a method that never learns cannot reach it. ``None`` if none reaches :data:`CONVERGED`.
    """
    curves = [curve for runs in shipped(methods).values() if (curve := mean_curve(runs))]
    best = max((max(rates) for _, rates in curves if rates), default=0.0)
    return 0.9 * best if best >= CONVERGED else None


def convergence_gain(ours: Sequence[Run], theirs: Sequence[Run], threshold: float | None) -> Gain | None:
    """Environment steps that ours needs less to reach a threshold; ``None`` without curves or threshold."""
    curves = mean_curve(ours), mean_curve(theirs)
    if threshold is None or curves[0] is None or curves[1] is None:
        return None
    ours_at, theirs_at = stats.steps_to(*curves[0], threshold), stats.steps_to(*curves[1], threshold)
    return Gain(threshold, ours_at, theirs_at, until=curves[1][0][-1], ours_until=curves[0][0][-1])


def baselines(methods: Mapping[str, Sequence[Run]]) -> list[str]:
    """Methods that ours is compared with: shipped settings of other algorithms, no variant, no ablation."""
    return [method for method in methods if is_shipped(method) and method != OURS]


def strongest_baselines(methods: Mapping[str, Sequence[Run]]) -> list[str]:
    """The baseline with the best mean success; among equals, the one that reaches the common threshold first.

    :return: several if they are equal in both, none without a baseline
    """
    threshold = common_threshold(methods)

    def rank(method: str) -> tuple[float, float]:
        curve = mean_curve(methods[method])
        steps = stats.steps_to(*curve, threshold) if curve and threshold is not None else None
        return float(np.mean(successes(methods[method]))), -np.inf if steps is None else -steps

    ranks = {method: rank(method) for method in baselines(methods)}
    return [method for method, found in ranks.items() if found == max(ranks.values())]


def _rows(results: Results, others: Mapping[str, Sequence[str]]) -> list[Row]:
    """Compare ours with named rows of each task; the p-values are corrected over all of them."""
    keys = [(task, name) for task, names in others.items() for name in names]
    references = {(task, name): reference_of(results[task][name]) for task, name in keys}
    tests = stats.compare(
        {(task, name): successes(results[task][references[task, name]]) for task, name in keys},
        {(task, name): successes(results[task][name]) for task, name in keys},
    )
    rows = []
    for task, name in keys:
        reference = references[task, name]
        ours, theirs = results[task][reference], results[task][name]
        gain = convergence_gain(ours, theirs, common_threshold(results[task]))
        strongest = name in strongest_baselines(results[task])
        unequal = tuple(differences(theirs, ours))
        difference = difference_of(ours, theirs)
        rows.append(Row(task, name, difference, tests[task, name], gain, strongest, unequal, reference))
    return rows


def against_baselines(results: Results) -> list[Row]:
    """Ours against every baseline of every task (table 2)."""
    return _rows(results, {task: baselines(methods) for task, methods in results.items() if OURS in methods})


def against_ablations(results: Results) -> list[Row]:
    """Ours against its own ablations (table 3): of the shipped settings, of the paper's, and of rows that are named."""
    names = [f"{OURS} {ablation}{config}" for config in ("", OF_PAPER) for ablation in sorted(ABLATIONS)]
    found = {}
    for task, methods in results.items():
        named = [name for name, runs in methods.items() if runs[0].compared_with and name not in names]
        found[task] = [n for n in (*names, *named) if n in methods and reference_of(methods[n]) in methods]
    return _rows(results, found)
