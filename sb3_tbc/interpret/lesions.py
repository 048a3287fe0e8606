"""What depends on which unit: lesions of neurons, layers and synapses, with controls."""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from sb3_tbc.arrays import FloatArray
from sb3_tbc.interpret.episodes import HeldOutEpisodes, Outcome, Trace
from sb3_tbc.interpret.units import CircuitUnits, Lesion, Units, clamp, no_lesion

N_RESAMPLES = 2000
MAX_STEPS = 3000
"""Number of steps on which actions are compared."""


class Drop(NamedTuple):
    """Relative drop with its 95 % interval; a negative drop is a gain."""

    drop: float
    low: float
    high: float


class LesionResult(NamedTuple):
    """One lesion beside the whole agent, on the same episodes."""

    what: str  # "top", "random", "alone", "unread", "layer", "synapse", "memory"
    units: tuple[str, ...]  # clamped units, or a synapse's two ends
    clamped_to: str  # "rest" or "mean"; "" where nothing is clamped
    success: Drop | None  # None where the whole agent never succeeds
    subgoals: Drop | None  # None where it never reaches a subgoal
    success_rate: float
    action_change: float  # root mean square change of actions on the whole agent's own inputs, unit coordinates


class Plan(NamedTuple):
    """A lesion with its name."""

    what: str
    names: tuple[str, ...]
    clamped_to: str
    lesion: Lesion


def activity(units: Units, traces: Sequence[Trace]) -> FloatArray:
    """How active each unit is: mean distance of its activation from rest, ``(N,)``."""
    distances = np.abs(np.concatenate([t.activations for t in traces]) - units.rest)
    return np.asarray(distances.mean(axis=0))


def relative_drop(whole: FloatArray, lesioned: FloatArray, seed: int = 0) -> Drop | None:
    """``1 - mean(lesioned) / mean(whole)`` over paired episodes; whole episodes are resampled for the interval.

    :return: None if the mean of ``whole`` is zero: nothing can drop
    """
    if whole.mean() <= 0:
        return None
    rng = np.random.default_rng(seed)
    n = len(whole)
    weights = rng.multinomial(n, np.full(n, 1.0 / n), size=N_RESAMPLES)
    before, after = weights @ whole, weights @ lesioned
    drops = 1.0 - after[before > 0] / before[before > 0]
    low, high = np.percentile(drops, [2.5, 97.5])
    return Drop(float(1.0 - lesioned.mean() / whole.mean()), float(low), float(high))


def plan_lesions(
    units: Units, traces: Sequence[Trace], most: int = 5, n_random: int = 5, max_alone: int = 24, seed: int = 0
) -> list[Plan]:
    """The lesions to try.

    :param traces: of the whole agent: they say which units are most active, and their means
    :param most: how many of the most active units are clamped at most
    :param n_random: random sets of each size, the control of the most active ones
    :param max_alone: units clamped one by one, the most active ones first
    :param seed: of the random sets
    """
    order = np.argsort(-activity(units, traces))
    means = np.concatenate([t.activations for t in traces]).mean(axis=0).astype(np.float64)
    values = {"rest": units.rest, "mean": means}
    rng, n = np.random.default_rng(seed), len(units.names)
    most = min(most, n)
    plans: list[Plan] = []

    def add(what: str, which: Sequence[int], form: str) -> None:
        names = tuple(units.names[i] for i in which)
        plans.append(Plan(what, names, form, clamp(units, which, values[form])))

    for form in values:
        for k in range(1, most + 1):
            add("top", order[:k].tolist(), form)
        for k in range(1, most + 1):
            for _ in range(n_random):
                add("random", rng.choice(n, k, replace=False).tolist(), form)
        for i in order[:max_alone].tolist():
            add("alone", [i], form)
        for part in units.layers.values():
            add("layer", list(range(n))[part], form)
    for i in order[:max_alone].tolist():
        if units.read[i]:
            lesion = clamp(units, [i], means)
            nowhere = np.zeros_like(lesion.held)
            plans.append(Plan("unread", (units.names[i],), "mean", lesion._replace(held=nowhere, unread=lesion.held)))
    return plans


def run_lesions(
    episodes: HeldOutEpisodes, units: Units, traces: Sequence[Trace], whole: Outcome, plans: Sequence[Plan]
) -> list[LesionResult]:
    """Try lesions on the episodes that the whole agent ran.

    :param traces: of the whole agent
    :param whole: how its episodes ended
    :param plans: from :func:`plan_lesions`
    """
    outcomes = episodes.outcomes(units, [plan.lesion for plan in plans])
    return [
        _result(p.what, p.names, p.clamped_to, whole, o, action_change(units, units, traces, p.lesion))
        for p, o in zip(plans, outcomes, strict=True)
    ]


def run_synapses(
    episodes: HeldOutEpisodes, units: CircuitUnits, traces: Sequence[Trace], whole: Outcome
) -> list[LesionResult]:
    """Cut every synapse, one at a time."""
    results = []
    intact = no_lesion(units)
    for index, (before, after, _) in enumerate(units.synapses()):
        cut = units.without_synapse(index)
        (outcome,) = episodes.outcomes(cut, [intact])
        change = action_change(units, cut, traces, intact)
        results.append(_result("synapse", (before, after), "", whole, outcome, change))
    return results


def action_change(units: Units, lesioned: Units, traces: Sequence[Trace], lesion: Lesion) -> float:
    """Root mean square change of actions on the inputs and the memory that the whole agent had."""
    inputs, before = (np.concatenate([getattr(t, name) for t in traces]) for name in ("inputs", "before"))
    some = np.linspace(0, len(inputs) - 1, min(len(inputs), MAX_STEPS)).astype(np.int64)
    whole = units.step(inputs[some], before[some], no_lesion(units))[0]
    other = lesioned.step(inputs[some], before[some], lesion)[0]
    return float(np.sqrt(((whole - other) ** 2).mean()))


def _result(
    what: str, names: tuple[str, ...], form: str, whole: Outcome, outcome: Outcome, change: float
) -> LesionResult:
    return LesionResult(
        what, names, form, relative_drop(whole.success, outcome.success),
        relative_drop(whole.subgoals, outcome.subgoals), float(outcome.success.mean()), change,
    )  # fmt: skip


def mean_drop(results: Sequence[LesionResult], what: str, size: int, form: str) -> Drop | None:
    """Mean drop of success of all lesions of one kind and size, with the interval of their spread.

    :param form: clamped to ``"rest"`` or ``"mean"``
    """
    drops = [
        r.success.drop for r in results
        if r.what == what and len(r.units) == size and r.clamped_to == form and r.success is not None
    ]  # fmt: skip
    if not drops:
        return None
    low, high = np.percentile(drops, [2.5, 97.5])
    return Drop(float(np.mean(drops)), float(low), float(high))
