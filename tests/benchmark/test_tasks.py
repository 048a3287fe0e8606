"""The speed table: its rows, and another environment timed beside ours."""

from __future__ import annotations

import sys
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from sb3_tbc.tasks import TASKS, register_tasks

from sb3_tbc.benchmark import tasks as benchmark


class OldGym:
    """Old interface: ``reset`` takes no seed, ``step`` returns four values."""

    def __init__(self) -> None:
        self.resets, self.steps = 0, 0

    def reset(self) -> float:
        self.resets += 1
        return 0.0

    def step(self, action: np.ndarray[Any, Any]) -> tuple[float, float, bool, dict[str, Any]]:
        self.steps += 1
        return 0.0, 0.0, self.steps % 10 == 0, {}


def test_old_gym_interface_and_resets() -> None:
    env = OldGym()
    assert benchmark.steps_per_second(env, np.zeros((45, 1)), None) > 0
    assert (env.steps, env.resets) == (45, 5)


def test_rows_say_what_they_compare_with() -> None:
    register_tasks()
    assert benchmark.measure("Drawbridge", 0.01, repeats=2).endswith("recorded")
    assert benchmark.measure("Drawbridge", 0.01, OldGym(), repeats=2).endswith("this run")
    assert set(benchmark.PUBLIC) <= set(TASKS)


def test_share_of_the_engine() -> None:
    env = benchmark.gym.make("sb3_tbc/Drawbridge-v0")
    assert 0 < benchmark.engine_share(env, benchmark.random_actions(env, 500, 0)) < 1
    assert "_advance" not in vars(env.unwrapped)


@pytest.mark.parametrize("path", ["nothing", "no_such_module:f", "math:no_such_function"])
def test_wrong_against(path: str, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]) -> None:
    monkeypatch.setattr(sys, "argv", ["benchmark", "Drawbridge", "--against", path])
    with pytest.raises(SystemExit) as stop:
        benchmark.main()
    assert stop.value.code == 2
    assert "--against" in capsys.readouterr().err.splitlines()[-1]


def test_table(monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str], tmp_path: Path) -> None:
    (tmp_path / "other_tasks.py").write_text("import test_tasks as t\nmake = lambda task: t.OldGym()\n")
    monkeypatch.setattr(sys, "path", [str(tmp_path), str(Path(__file__).parent), *sys.path])
    monkeypatch.setattr(sys, "argv", ["benchmark", "Drawbridge", "--seconds", "0.02", "--against", "other_tasks:make"])
    benchmark.main()
    assert "this run" in capsys.readouterr().out


@pytest.mark.parametrize("seconds", ["nan", "inf", "0", "-1", "long"])
def test_seconds_are_a_finite_number_above_zero(
    seconds: str, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr(sys, "argv", ["benchmark", "Drawbridge", "--seconds", seconds])
    with pytest.raises(SystemExit) as stop:
        benchmark.main()
    assert stop.value.code == 2
    assert f"'{seconds}' is not a" in capsys.readouterr().err.splitlines()[-1]
