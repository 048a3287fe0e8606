"""RL Baselines3 Zoo's own commands with our algorithms: train, continue, enjoy, optimise, plot."""

from __future__ import annotations

import importlib
import pickle
import sys
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from corridor import Corridor

import sb3_tbc.zoo
from sb3_tbc.extras import MissingExtraError
from sb3_tbc.tbc_hrl import HiTS
from sb3_tbc.zoo import rl_zoo
from sb3_tbc.zoo.rl_zoo import IN_ZOO, main, nested, with_subgoals, zoo_settings

TASK = "sb3_tbc/Drawbridge-v0"
SMALL = ["low.batch_size:16", "high.batch_size:16", "gradient_ratio:0.02", "compile:False", "max_options:5", "dt_min:0"]


def test_dotted_names_are_sections() -> None:
    given = {"low": {"gamma": 0.9, "tau": 0.1}, "low.gamma": 0.8, "low.policy_kwargs.net_arch": [8], "seed": 1}
    assert nested(given) == {"low": {"gamma": 0.8, "tau": 0.1, "policy_kwargs": {"net_arch": [8]}}, "seed": 1}


@pytest.mark.parametrize("algo", IN_ZOO)
def test_the_zoo_gets_our_configurations(algo: str) -> None:
    sections = zoo_settings(algo)
    assert {"default", TASK} <= set(sections)
    assert all(section["n_timesteps"] > 0 for section in sections.values())
    assert with_subgoals(Corridor()).subgoals.dim == 1


def test_without_the_zoo_it_says_what_to_install(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "rl_zoo3", None)
    with pytest.raises(MissingExtraError, match=r"sb3_tbc\[zoo\]"):
        sb3_tbc.zoo.register()


@pytest.mark.parametrize("arguments", [[], ["nonsense"]])
def test_an_unknown_command_is_told_in_one_line(arguments: list[str], monkeypatch: Any, capsys: Any) -> None:
    monkeypatch.setattr(sys, "argv", ["rl_zoo", *arguments])
    assert main() == 2
    assert "error: give a command of the zoo: train, enjoy" in capsys.readouterr().err


def test_a_refused_setting_is_told_in_one_line(monkeypatch: Any, capsys: Any) -> None:
    def train() -> None:
        HiTS("MultiInputPolicy", TASK, high={"learning_start": 1})

    monkeypatch.setattr(rl_zoo, "register", lambda: None)
    monkeypatch.setitem(sys.modules, "rl_zoo3.cli", SimpleNamespace(main=train))
    monkeypatch.setattr(sys, "argv", ["rl_zoo", "train"])
    assert main() == 2
    assert capsys.readouterr().err.startswith("sb3_tbc.zoo.rl_zoo: error: unknown setting 'high.learning_start'")


def command(monkeypatch: pytest.MonkeyPatch, name: str, *arguments: str) -> None:
    """Run a command of the zoo."""
    monkeypatch.setattr(sys, "argv", [name, *arguments])
    getattr(importlib.import_module("rl_zoo3.cli"), name)()


def trained(monkeypatch: pytest.MonkeyPatch, algo: str, folder: Path, *more: str) -> Path:
    command(
        monkeypatch, "train", "--algo", algo, "--env", TASK, "-n", "700", "--eval-freq", "350", "--eval-episodes", "2",
        "-f", str(folder), "--seed", "1", "--save-replay-buffer", *more, "-params", *SMALL,
        "--env-kwargs", "max_episode_steps:100",
    )  # fmt: skip
    return max((folder / algo).glob("*Drawbridge-v0_*"))


@pytest.mark.slow
@pytest.mark.parametrize("algo", IN_ZOO)
def test_trains_continues_and_enjoys(algo: str, tmp_path: Path, monkeypatch: Any, capsys: Any) -> None:
    pytest.importorskip("rl_zoo3")
    sb3_tbc.zoo.register()
    sb3_tbc.zoo.register()  # changes nothing
    run = trained(monkeypatch, algo, tmp_path)
    name = run.name.rpartition("_")[0]
    settings = (run / name / "config.yml").read_text()
    assert "- - low.batch_size\n    - 16\n" in settings
    assert "max_options\n    - 5\n" in settings
    with np.load(run / "evaluations.npz") as told:
        assert told["timesteps"].tolist() == [350, 700]
    assert len((run / "0.monitor.csv").read_text().splitlines()) > 3
    again = trained(monkeypatch, algo, tmp_path, "-i", str(run / f"{name}.zip"))
    assert again != run
    command(monkeypatch, "enjoy", "--algo", algo, "--env", TASK, "-f", str(tmp_path), "-n", "300", "--no-render")
    assert "Episode Length" in capsys.readouterr().out
    arguments = ["-a", algo, "-e", "Drawbridge", "-f", str(tmp_path), "--no-display", "-o", str(tmp_path / "plots")]
    command(monkeypatch, "all_plots", *arguments)
    with (tmp_path / "plots.pkl").open("rb") as file:  # written above
        assert next(iter(pickle.load(file)["Drawbridge"].values()))["mean"].shape == (2,)


@pytest.mark.slow
def test_optimises(tmp_path: Path, monkeypatch: Any, capsys: Any) -> None:
    pytest.importorskip("rl_zoo3")
    sb3_tbc.zoo.register()
    trained(
        monkeypatch,
        "hits",
        tmp_path,
        "-optimize",
        "--n-trials",
        "1",
        "--n-evaluations",
        "1",
        "--pruner",
        "none",
        "--no-optim-plots",
    )
    out = capsys.readouterr().out
    assert "Number of finished trials:  1" in out
    assert "low.learning_rate" in out
