"""Objectives by hand, and pruning on made-up curves."""

from __future__ import annotations

from typing import Any

import optuna
import pytest
from optuna.storages import BaseStorage

from sb3_tbc.errors import ConfigError
from sb3_tbc.tune.objectives import ACROSS, OBJECTIVES
from sb3_tbc.tune.pruning import SEED_VALUES, make_pruner
from sb3_tbc.tune.study import SamplerOfEachTrial, make_sampler
from sb3_tbc.zoo.callbacks import EvaluationRow


def curve(*rates: float) -> list[EvaluationRow]:
    return [EvaluationRow(100 * (k + 1), rate, 20, 50.0, 0.5, 9.0, 1.0) for k, rate in enumerate(rates)]


@pytest.mark.parametrize(
    ("objective", "rates", "value"),
    [
        ("final", (0.2, 0.9, 0.6), 0.6),
        ("success", (0.2, 0.9, 0.6), 0.6),
        ("best", (0.2, 0.9, 0.6), 0.9),
        ("auc", (1.0, 1.0), 0.75),  # a triangle over the first 100 steps, then a square
        ("auc", (0.0, 1.0), 0.25),
        ("auc", (), 0.0),
        ("steps-to-success", (0.2, 0.9, 0.6), 200.0),
        ("steps-to-success", (0.2, 0.45), 300 * 1.5),  # half of the threshold: 1.5 times the budget
        ("steps-to-success", (0.0, 0.0), 600.0),
    ],
)
def test_scores(objective: str, rates: tuple[float, ...], value: float) -> None:
    assert OBJECTIVES[objective].score(curve(*rates), 300, 0.9) == pytest.approx(value)


def test_directions_and_seeds() -> None:
    assert {k: o.direction for k, o in OBJECTIVES.items() if o.direction == "minimize"} == {
        "steps-to-success": "minimize"
    }
    assert ACROSS["mean"]([0.0, 0.0, 0.9]) == pytest.approx(0.3)
    assert ACROSS["median"]([0.0, 0.0, 0.9]) == 0.0


def add(study: optuna.Study, seeds: list[float], curve_values: dict[int, float] | None = None) -> None:
    study.add_trial(
        optuna.create_trial(
            value=sum(seeds) / len(seeds),
            user_attrs={SEED_VALUES: {str(k): v for k, v in enumerate(seeds)}},
            intermediate_values=curve_values,
        )
    )


def running(study: optuna.Study, seeds: list[float]) -> optuna.Trial:
    trial = study.ask()
    trial.set_user_attr(SEED_VALUES, {str(k): v for k, v in enumerate(seeds)})
    return trial


def study_with(pruner: Any, direction: str = "maximize") -> optuna.Study:
    return optuna.create_study(direction=direction, pruner=pruner, sampler=optuna.samplers.RandomSampler(seed=0))


def test_wilcoxon_compares_seeds_not_curves() -> None:
    study = study_with(make_pruner("wilcoxon", 10, 5))
    good = [0.9, 0.8, 0.95, 0.85, 0.9]
    add(study, good, {step: 0.0 for step in range(1, 51)})  # its curve is worse than anything reported below
    worse = running(study, [0.5, 0.3, 0.6, 0.4])
    for step in range(1, 30):
        worse.report(0.99, step)
    assert worse.should_prune()  # four of four seeds worse: p = 1/16
    assert "Wilcoxon" in study.pruner.reason  # type: ignore[attr-defined]
    assert not running(study, [0.5, 0.3, 0.6]).should_prune()  # p = 1/8: three seeds cannot be sure
    assert not running(study, [0.5, 0.9, 0.99, 0.9]).should_prune()
    assert not running(study, []).should_prune()


def test_wilcoxon_when_less_is_better() -> None:
    study = study_with(make_pruner("wilcoxon", 10, 5), "minimize")
    add(study, [100.0, 120.0, 90.0, 110.0])
    assert running(study, [300.0, 310.0, 290.0, 305.0]).should_prune()
    assert not running(study, [50.0, 60.0, 40.0, 55.0]).should_prune()


def test_median_within_a_run_spares_the_beginning() -> None:
    study = study_with(make_pruner("median+wilcoxon", 9, 2))
    for level in (0.5, 0.6, 0.7, 0.8, 0.9):
        add(study, [level, level], {step: level for step in range(1, 21)})
    trial = running(study, [])
    for step in range(1, 8):
        trial.report(0.1, step)
        assert trial.should_prune() == (step >= 3), step
    assert study.pruner.reason == "curve behind the other trials' (median)"  # type: ignore[attr-defined]
    good = running(study, [])
    for step in range(1, 21):
        good.report(0.75, step)
        assert not good.should_prune()


@pytest.mark.parametrize("name", ["hyperband", "halving"])
def test_hyperband_gives_up_the_worst(name: str) -> None:
    study = study_with(make_pruner(name, 9, 2))
    pruned = []
    for k in range(30):
        trial = study.ask()
        level = (7 * k % 30) / 30
        for step in range(1, 21):
            trial.report(level, step)
            if trial.should_prune():
                pruned.append(level)
                study.tell(trial, state=optuna.trial.TrialState.PRUNED)
                break
        else:
            study.tell(trial, level)
    assert len(pruned) > 5
    assert max(t.value or 0 for t in study.trials) == pytest.approx(29 / 30)
    assert sum(pruned) / len(pruned) < 0.5


@pytest.mark.parametrize("name", ["medain", "median+hyperband", "", "none+median", "wilcoxon+wilcoxon"])
def test_unknown_pruners(name: str) -> None:
    with pytest.raises(ConfigError, match="pruner"):
        make_pruner(name, 10, 2)


def test_samplers() -> None:
    assert isinstance(make_sampler("tpe", 0), optuna.samplers.TPESampler)
    assert isinstance(make_sampler("RandomSampler", 0), optuna.samplers.RandomSampler)
    assert isinstance(make_sampler("qmc", 0), optuna.samplers.QMCSampler)
    with pytest.raises(ConfigError, match="unknown sampler 'tpee'; did you mean 'tpe'"):
        make_sampler("tpee", 0)
    with pytest.raises(ConfigError, match="cannot be used by name"):
        make_sampler("grid", 0)


def test_streams_draw_different_numbers() -> None:
    drawn = set()
    for stream in ((0,), (1,), (7,)):
        study = optuna.create_study(sampler=make_sampler("random", 0, stream))
        drawn.add(study.ask().suggest_float("x", 0, 1))
    assert len(drawn) == 3


def _search(storage: BaseStorage, seed: int = 0, name: str = "tpe") -> optuna.Study:
    """A process that opens a study, or joins it."""
    study = optuna.create_study(study_name="s", storage=storage, load_if_exists=True)
    study.sampler = SamplerOfEachTrial(lambda number: make_sampler(name, seed, (number,)))
    return study


def _draw(study: optuna.Study) -> tuple[float, float]:
    trial = study.ask()
    values = trial.suggest_float("x", 0, 1), trial.suggest_float("y", 0, 1)
    study.tell(trial, values[0])
    return values


@pytest.mark.parametrize("name", ["tpe", "random", "qmc"])
def test_processes_that_join_a_study_draw_no_trial_twice(name: str) -> None:
    """The same command given twice drew each of its first trials twice."""
    storage = optuna.storages.InMemoryStorage()
    first, second = _search(storage, name=name), _search(storage, name=name)
    drawn = [_draw(study) for _ in range(8) for study in (first, second)]
    assert len(set(drawn)) == 16


def test_a_search_is_repeated_by_its_seed() -> None:
    runs = []
    for seed in (0, 0, 1):
        study = _search(optuna.storages.InMemoryStorage(), seed)
        runs.append([_draw(study) for _ in range(15)])
    assert runs[0] == runs[1]
    assert set(runs[0]).isdisjoint(runs[2])


def test_a_resumed_search_draws_what_an_undisturbed_one_does() -> None:
    storage = optuna.storages.InMemoryStorage()
    whole = _search(optuna.storages.InMemoryStorage())
    undisturbed = [_draw(whole) for _ in range(14)]
    assert [_draw(_search(storage)) for _ in range(14)] == undisturbed  # a process of its own for each trial
