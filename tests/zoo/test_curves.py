"""What SB3's and rl_zoo3's plots read of a run, also of one that was stopped and resumed."""

from __future__ import annotations

import csv
import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from stable_baselines3.common.monitor import load_results
from stable_baselines3.common.results_plotter import plot_results, ts2xy

from sb3_tbc.settings import merge
from sb3_tbc.tbc_hrl.evaluation import EvaluationResult
from sb3_tbc.zoo.config import load_config
from sb3_tbc.zoo.curves import EVALUATION_EPISODES, MONITOR, EvaluationEpisodes, TrainingMonitor
from sb3_tbc.zoo.ledger import RunFolder
from sb3_tbc.zoo.run_spec import RunOptions, RunSpec
from sb3_tbc.zoo.runner import resume_run, start_run

SMALL = {"batch_size": 16, "buffer_size": 2000, "policy_kwargs": {"net_arch": [8, 8]}}


def spec(algo: str, steps: int) -> RunSpec:
    levels = SMALL if algo == "sac" else {"low": SMALL, "high": SMALL, "compile": False}
    run = load_config(algo, "Drawbridge", overrides=merge(levels, {"n_timesteps": steps, "gradient_ratio": 0.01}))
    return RunSpec(run, "sb3_tbc/Drawbridge-v0", seed=1, eval_freq=500, n_eval_episodes=3, n_final_episodes=2)


def episodes(folder: Path) -> list[dict[str, str]]:
    with (folder / MONITOR).open() as file:
        assert json.loads(file.readline()[1:])["env_id"] == "sb3_tbc/Drawbridge-v0"
        return list(csv.DictReader(file))


@pytest.mark.parametrize("algo", ["hits", "sac"])
def test_a_run_holds_what_the_plots_read(algo: str, tmp_path: Path) -> None:
    final = start_run(spec(algo, 1500), RunFolder(tmp_path), "train", RunOptions(verbose=0))
    rows = RunFolder(tmp_path).read_evaluations()
    with np.load(tmp_path / EVALUATION_EPISODES) as told:
        assert told["timesteps"].tolist() == [row.timesteps for row in rows] == [500, 1000, 1500]
        assert told["results"].shape == told["ep_lengths"].shape == told["successes"].shape == (3, 3)
        np.testing.assert_allclose(told["successes"].mean(axis=1), [row.success_rate for row in rows], atol=1e-6)
        np.testing.assert_allclose(told["ep_lengths"].mean(axis=1), [row.mean_length for row in rows], rtol=1e-5)
        assert (told["results"] <= 0).all()
    assert final["n_timesteps"] == 1500
    results = load_results(str(tmp_path))
    steps, returns = ts2xy(results, "timesteps")
    assert steps.tolist() == results["timesteps"].tolist()
    assert (returns <= 0).all()
    assert results["is_success"].isin([0, 1]).all()
    plot_results([str(tmp_path)], 1500, "timesteps", algo)


def test_a_resumed_run_holds_the_same(tmp_path: Path) -> None:
    start_run(spec("hits", 2000), RunFolder(tmp_path / "whole"), "train", RunOptions(verbose=0))
    folder = RunFolder(tmp_path / "parts")
    start_run(spec("hits", 1000), folder, "train", RunOptions(verbose=0, keep_checkpoint=True))
    with (folder.path / MONITOR).open("a") as file:  # as a process that is killed after its checkpoint leaves it
        file.write("1200,-99.0,100,9.0,0\n1300,-9")
    resume_run(folder, RunOptions(verbose=0), n_timesteps=2000)
    of = [
        [(row["timesteps"], row["r"], row["l"]) for row in episodes(path)] for path in (folder.path, tmp_path / "whole")
    ]
    assert of[0] == of[1]
    seconds = [float(row["t"]) for row in episodes(folder.path)]
    assert seconds == sorted(seconds)
    with (
        np.load(folder.path / EVALUATION_EPISODES) as parts,
        np.load(tmp_path / "whole" / EVALUATION_EPISODES) as whole,
    ):
        for name in whole.files:
            np.testing.assert_array_equal(parts[name], whole[name])


def result(n: int, value: float) -> EvaluationResult:
    numbers = np.full(n, value)
    return EvaluationResult(
        numbers > 0, numbers.astype(int), numbers, numbers, numbers, numbers.astype(int), numbers > 0
    )


def test_evaluations_that_are_done_again_are_replaced(tmp_path: Path, caplog: Any) -> None:
    path = tmp_path / EVALUATION_EPISODES
    first = EvaluationEpisodes(path)
    for step in (10, 20, 30):
        first.add(step, result(2, step))
    EvaluationEpisodes(path, {10, 20}).add(30, result(2, 5))
    with np.load(path) as told:
        assert told["timesteps"].tolist() == [10, 20, 30]
        assert told["results"].tolist() == [[10, 10], [20, 20], [5, 5]]
    EvaluationEpisodes(path, {10, 20, 30}).add(40, result(3, 1))  # of another number of episodes
    with np.load(path) as told:
        assert told["timesteps"].tolist() == [40]
    path.write_bytes(path.read_bytes()[:50])
    EvaluationEpisodes(path, {40}).add(50, result(2, 1))
    assert "begun anew" in caplog.text


def test_the_monitor_file_is_bounded(tmp_path: Path, caplog: Any) -> None:
    monitor = TrainingMonitor(tmp_path / MONITOR, "A-v0", most=3)
    monitor.num_timesteps = 0
    monitor._on_training_start()
    for step in range(1, 9):
        monitor.num_timesteps = step
        monitor.locals = {"dones": np.array([True]), "infos": [{"episode": {"r": -1.0, "l": 1, "t": 0.1}}]}
        assert monitor._on_step()
    monitor._on_training_end()
    assert len((tmp_path / MONITOR).read_text().splitlines()) == 2 + 3
    assert caplog.text.count("ends here") == 1
