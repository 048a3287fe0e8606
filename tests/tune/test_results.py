"""What is made of a finished search: importances, plots, and the settings in which a trial differs."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import optuna
import pytest

from sb3_tbc.errors import ConfigError
from sb3_tbc.tune.results import difference, find_trial, importances, write_plots
from sb3_tbc.tune.study import ORIGIN


def test_plots_and_importances(tmp_path: Path) -> None:
    study = optuna.create_study(direction="maximize", study_name="toy")
    study.set_user_attr("settings", {"objective": "auc"})
    assert write_plots(study, tmp_path) == []
    rng = np.random.default_rng(0)
    space = {n: optuna.distributions.FloatDistribution(0, 1) for n in ("matters", "idle")}
    for _ in range(40):
        x, y = rng.random(2)
        params = {"matters": x, "idle": y}
        study.add_trial(optuna.create_trial(params=params, distributions=space, value=x))
    shares = importances(study)
    assert shares["matters"] > 5 * shares["idle"]
    assert [p.name for p in write_plots(study, tmp_path)] == ["history.png", "importances.png"]


def test_equal_trials_have_no_importances() -> None:
    study = optuna.create_study(direction="maximize")
    for x in np.linspace(0, 1, 10):
        distributions = {"idle": optuna.distributions.FloatDistribution(0, 1)}
        study.add_trial(optuna.create_trial(params={"idle": float(x)}, distributions=distributions, value=0.0))
    assert importances(study) == {}


def test_difference_is_what_merging_needs() -> None:
    assert difference({"a": 1, "b": {"c": 1, "d": 2}}, {"a": 1, "b": {"c": 1, "d": 3}, "e": None}) == {
        "b": {"d": 3},
        "e": None,
    }
    assert difference({"a": 1}, {"a": True}) == {"a": True}


def test_a_trial_that_chose_nothing_has_no_settings_to_train_on() -> None:
    """Of two workers that begin the last trial one drops its own: training on it took the settings of no trial."""
    study = optuna.create_study()
    study.tell(study.ask(), state=optuna.trial.TrialState.FAIL)
    with pytest.raises(ConfigError, match="trial 0 has chosen no settings: it was dropped, or has just begun"):
        find_trial(study, "0")
    study.add_trial(optuna.trial.create_trial(state=optuna.trial.TrialState.FAIL, user_attrs={ORIGIN: "paper"}))
    assert find_trial(study, "1").number == 1  # its settings are those of its configuration
