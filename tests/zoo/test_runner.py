"""The end of a run: what is evaluated, and what the result says."""

from __future__ import annotations

import signal
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from sb3_tbc.stopping import StopRequest
from sb3_tbc.zoo import callbacks, runner
from sb3_tbc.zoo.algorithms import read_zip
from sb3_tbc.zoo.callbacks import EvaluationRow, write_evaluations
from sb3_tbc.zoo.checkpoints import find_checkpoint
from sb3_tbc.zoo.config import load_config
from sb3_tbc.zoo.curves import EvaluationEpisodes
from sb3_tbc.zoo.ledger import RunFolder
from sb3_tbc.zoo.run_spec import RunOptions, RunSpec
from sb3_tbc.zoo.runner import Interrupted, Training, resume_run, start_run


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


def small(tmp_path: Path, steps: int) -> tuple[RunSpec, RunFolder]:
    few = {"n_timesteps": steps, "n_envs": 1, "buffer_size": 1000, "gradient_ratio": 0.01}
    run = load_config("sac", "Pendulum", overrides=few)
    spec = RunSpec(run, "sb3_tbc/Pendulum-v0", seed=3, eval_freq=90, n_eval_episodes=1, n_final_episodes=1)
    return spec, RunFolder(tmp_path / "run")


def test_a_checkpoint_that_is_to_be_kept_is_kept_when_the_run_is_extended_without_saying_so_again(
    tmp_path: Path,
) -> None:
    spec, folder = small(tmp_path, 20)
    start_run(spec, folder, "", RunOptions(verbose=0, keep_checkpoint=True))
    for steps in (30, 40):
        resume_run(folder, RunOptions(verbose=0), steps)
        assert find_checkpoint(folder.path).timesteps == steps  # type: ignore[union-attr]


def test_the_best_agent_goes_back_with_the_curve(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """A run dies after its best evaluation, and resumed from before it, it does not do as well again."""
    rates = {90: 0.5, 180: 0.0, 270: 1.0}

    def evaluate(model: Any, env: Any, n_episodes: int, **how: Any) -> Any:
        if model.num_timesteps not in rates:
            raise KeyboardInterrupt
        one, success = np.ones(n_episodes), np.full(n_episodes, rates[model.num_timesteps])
        return SimpleNamespace(successes=success, lengths=one, subgoal_success=one, mean_window=one, returns=one)

    monkeypatch.setattr(callbacks, "evaluate_agent", evaluate)
    monkeypatch.setattr(EvaluationEpisodes, "add", lambda *_: None)
    spec, folder = small(tmp_path, 370)
    saved = Training.checkpoint
    monkeypatch.setattr(Training, "checkpoint", lambda self: saved(self) if self.model.num_timesteps < 250 else None)
    with pytest.raises(KeyboardInterrupt):
        start_run(spec, folder, "", RunOptions(verbose=0, checkpoint_seconds=0.0))
    assert read_zip(folder.best_model)["num_timesteps"] == 270
    rates |= {270: 0.25, 360: 0.25}
    resume_run(folder, RunOptions(verbose=0))
    assert [row.success_rate for row in folder.read_evaluations()] == [0.5, 0.0, 0.25, 0.25]
    assert read_zip(folder.best_model)["num_timesteps"] == 90
