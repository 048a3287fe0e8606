"""The examples of the page on other tools are run as they stand, where the tool is installed."""

from __future__ import annotations

import re
from pathlib import Path
from typing import Any

import pytest
from contract import every_algorithm, make

PAGE = Path(__file__).parents[2] / "docs" / "integrations.md"


def example(heading: str) -> str:
    """The Python code below a heading of the page."""
    section = PAGE.read_text(encoding="utf-8").partition(f"## {heading}\n")[2].partition("\n## ")[0]
    (code,) = re.findall(r"```python\n(.*?)```", section, re.DOTALL)
    return str(code)


@pytest.mark.slow
def test_weights_and_biases(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    pytest.importorskip("wandb")
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv("WANDB_SILENT", "true")
    exec(example("Weights & Biases"), {})
    (run,) = tmp_path.glob("wandb/offline-run-*")
    assert list(run.glob("*.wandb"))
    assert (run / "files" / "model.zip").exists()
    assert list(tmp_path.glob("runs/*/TBCHRL_1/events*"))


@pytest.mark.slow
def test_mlflow(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    mlflow = pytest.importorskip("mlflow")
    pytest.importorskip("sqlalchemy")
    monkeypatch.chdir(tmp_path)
    exec(example("MLflow"), {})
    (run,) = mlflow.search_runs(output_format="list")
    assert run.data.params["max_options"] == "20"
    assert run.data.metrics["time/total_timesteps"] > 0
    assert list(tmp_path.rglob("artifacts/model.zip"))


@every_algorithm
def test_tensorboard_shows_the_settings(algo: str, tmp_path: Path) -> None:
    pytest.importorskip("tensorboard")
    from tensorboard.backend.event_processing.event_accumulator import EventAccumulator
    from tensorboard.plugins.hparams.plugin_data_pb2 import HParamsPluginData

    model: Any = make(algo, tensorboard_log=tmp_path)
    for _ in range(3):
        model.learn(60, log_interval=1, reset_num_timesteps=False)
    events = EventAccumulator(str(next(tmp_path.iterdir()))).Reload()
    told = events.summary_metadata["_hparams_/session_start_info"].plugin_data.content
    settings = HParamsPluginData.FromString(told).session_start_info.hparams
    name = "batch_size" if algo == "sac" else "low.batch_size"
    assert settings[name].number_value == 16
    assert settings["algorithm"].string_value == type(model).__name__
