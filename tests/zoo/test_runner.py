"""The end of a run: what is evaluated, and what the result says."""

from __future__ import annotations

import signal
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from sb3_tbc.stopping import StopRequest
from sb3_tbc.zoo import runner
from sb3_tbc.zoo.callbacks import EvaluationRow, write_evaluations
from sb3_tbc.zoo.config import load_config
from sb3_tbc.zoo.ledger import RunFolder
from sb3_tbc.zoo.runner import Interrupted, RunOptions, RunSpec, resume_run, start_run


def test_the_result_is_that_of_the_trained_agent_not_the_best_of_the_curve(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    evaluated: list[tuple[Any, ...]] = []

    def evaluate(model: Any, env: Any, n_episodes: int, **how: Any) -> Any:
        evaluated.append((model, n_episodes, how))
        share = np.full(n_episodes, 0.5)
        successes = np.arange(n_episodes) < 3
        return SimpleNamespace(successes=successes, lengths=share, subgoal_success=share, mean_window=share)

    monkeypatch.setattr(runner, "evaluate_agent", evaluate)
    folder = RunFolder(tmp_path)
    rows = [EvaluationRow(1000 * i, rate, 20, 10.0, 0.5, 4.0, 1.0) for i, rate in enumerate((0.2, 1.0, 0.5), 1)]
    write_evaluations(folder.evaluations, rows)
    spec = RunSpec(load_config("hits", "Pendulum"), "sb3_tbc/Pendulum-v0", "full", 7, 1000, 20, n_final_episodes=10)
    model: Any = SimpleNamespace(num_timesteps=3000)
    result = runner.finish(model, spec, folder, RunOptions(), 1.0)
    assert (result["success_rate"], result["best_success_rate"]) == (0.3, 1.0)
    assert result["outcomes"] == "1110000000"
    assert folder.read_final() == result
    assert evaluated == [(model, 10, {"seed": runner.final_seed(7), "deterministic": True})]


@pytest.mark.parametrize("algo", ["hits", "sac"])
def test_the_evaluation_after_training_stops_on_a_signal_and_is_repeated(
    algo: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    own = {"compile": False} if algo == "hits" else {"buffer_size": 1000}
    run = load_config(algo, "Pendulum", overrides={"n_timesteps": 20, "n_envs": 1, **own})
    spec = RunSpec(run, "sb3_tbc/Pendulum-v0", seed=3, eval_freq=1000, n_final_episodes=2)
    folder, undisturbed = RunFolder(tmp_path / "stopped"), RunFolder(tmp_path / "undisturbed")
    expected = start_run(spec, undisturbed, "", RunOptions(verbose=0))
    stop = StopRequest()

    def asked_within_the_evaluation(seed: int) -> int:
        stop.ask(signal.SIGTERM)
        return runner.evaluation_seed(seed)

    with monkeypatch.context() as patch:
        patch.setattr(runner, "final_seed", asked_within_the_evaluation)
        with pytest.raises(Interrupted, match="stopped after all 20 steps, before the result"):
            start_run(spec, folder, "", RunOptions(verbose=0, stop=stop))
        assert folder.model.is_file()
        assert not folder.finished
        with pytest.raises(Interrupted, match="before the result"):
            resume_run(folder, RunOptions(stop=stop))
    timed, result = {"wall_time": 0, "steps_per_second": 0}, resume_run(folder, RunOptions())
    assert {**result, **timed} == {**expected, **timed}
    assert (
        result["steps_per_second"] < 1e6
    )  # of training that took no time, it was 2e10: no evaluation had told its time
