"""When a trial is pruned: within a run, by comparison with other trials' curves; across seeds, by a paired test."""

from __future__ import annotations

import copy
import warnings
from dataclasses import dataclass
from typing import cast

from optuna.pruners import BasePruner, HyperbandPruner, MedianPruner, NopPruner, SuccessiveHalvingPruner, WilcoxonPruner
from optuna.study import Study, StudyDirection
from optuna.trial import FrozenTrial

from sb3_tbc.errors import ConfigError, nearest

WITHIN = ("median", "hyperband", "halving")
ACROSS = "wilcoxon"
NONE = "none"
P_VALUE = 0.1
"""Limit of the one-sided Wilcoxon test; a smaller p needs at least four seeds (four of four worse: p = 1/16)."""
SEED_VALUES = "seed_values"
"""Trial attribute: seed -> its score."""


@dataclass
class _SeedView:
    """Stands for a study in the Wilcoxon test, which then compares the best trial's seeds instead of its curve."""

    best_trial: FrozenTrial
    direction: StudyDirection


def seed_view(trial: FrozenTrial) -> FrozenTrial:
    """A copy of a trial whose intermediate values are the scores of its finished seeds."""
    view = copy.copy(trial)
    view.intermediate_values = {int(seed): score for seed, score in trial.user_attrs.get(SEED_VALUES, {}).items()}
    return view


class SeedPruner(BasePruner):
    """Two pruners for trials of several seeds: one sees each evaluation, the other each finished seed.

    Optuna allows one pruner per study and one list of reports per trial. Reports are numbered consecutively over a
    trial's seeds. Each is the mean over the finished seeds and the running one, so that trials are compared at the same
    evaluation of the same seed.

    :param within: asked after each evaluation
    :param across: asked with the scores of the finished seeds
    """

    def __init__(self, within: BasePruner, across: WilcoxonPruner | None) -> None:
        self.within = within
        self.across = across
        self.reason = ""

    def prune(self, study: Study, trial: FrozenTrial) -> bool:
        """Whether to prune a trial; ``reason`` says why."""
        if self.across is not None and self._worse_across(study, trial):
            self.reason = "worse than the best trial on the same seeds (Wilcoxon)"
            return True
        if self.within.prune(study, trial):
            name = type(self.within).__name__.removesuffix("Pruner").lower()
            self.reason = f"curve behind the other trials' ({name})"
            return True
        return False

    def _worse_across(self, study: Study, trial: FrozenTrial) -> bool:
        view = seed_view(trial)
        try:
            best = seed_view(study.best_trial)
        except ValueError:
            return False  # no complete trial yet
        if self.across is None or not view.intermediate_values or not best.intermediate_values:
            return False
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")  # seeds that only one of the two has are left out, as they should be
            return self.across.prune(cast(Study, _SeedView(best, study.direction)), view)


def make_pruner(name: str, n_evaluations: int, n_seeds: int) -> SeedPruner:
    """A pruner by name: ``none``, ``median``, ``hyperband``, ``halving``, ``wilcoxon``, or two joined by ``+``.

    :param n_evaluations: per training run; the first third of a trial's first run is never pruned by the median
    :raises ConfigError: for unknown names, or two for the same place
    """
    parts = [part for part in name.lower().split("+") if part]
    for part in parts:
        if part not in (*WITHIN, ACROSS, NONE):
            raise ConfigError(f"unknown pruner {part!r}; {nearest(part, (*WITHIN, ACROSS, NONE))}")
    inner = [part for part in parts if part in WITHIN]
    if not parts or len(inner) > 1 or len(set(parts)) != len(parts) or (NONE in parts and len(parts) > 1):
        choices = ", ".join((*WITHIN, ACROSS, NONE))
        raise ConfigError(f"--pruner takes one of {choices}, or two like median+{ACROSS}; got {name!r}")
    total, first = n_evaluations * n_seeds, max(1, n_evaluations // 3)
    within: dict[str, BasePruner] = {
        "median": MedianPruner(n_startup_trials=5, n_warmup_steps=first, n_min_trials=3),
        "hyperband": HyperbandPruner(min_resource=first, max_resource=max(total, first), reduction_factor=3),
        "halving": SuccessiveHalvingPruner(min_resource=first, reduction_factor=3),
    }
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # "experimental", since version 3.6
        across = WilcoxonPruner(p_threshold=P_VALUE) if ACROSS in parts else None
    return SeedPruner(within[inner[0]] if inner else NopPruner(), across)
