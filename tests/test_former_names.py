"""What was imported or saved under a module's former name still works; tests/data/agents was made by version 0.1.0."""

from __future__ import annotations

import importlib
import json
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
from making import make

from sb3_tbc import HAC, TBCHRL, HiTS
from sb3_tbc.former_names import FORMER_NAMES

AGENTS = Path(__file__).parent / "data" / "agents"


@pytest.mark.parametrize("name", sorted(FORMER_NAMES))
def test_a_former_name_is_the_module_it_has_become(name: str) -> None:
    if ".tune." in FORMER_NAMES[name]:
        pytest.importorskip("optuna")
    if name == "sb3_tbc.export_onnx":
        pytest.importorskip("onnx")
    present = importlib.import_module(FORMER_NAMES[name])
    assert importlib.import_module(name) is present
    assert present.__spec__.name == FORMER_NAMES[name]


def test_a_former_command_runs() -> None:
    done = subprocess.run([sys.executable, "-m", "sb3_tbc.tasks.benchmark", "--help"], capture_output=True, text=True)
    assert done.returncode == 0, done.stderr


@pytest.mark.parametrize("kind", [TBCHRL, HiTS, HAC])
def test_agents_of_the_first_version_load_and_act_the_same(kind: type[TBCHRL]) -> None:
    env = make("Pendulum")
    model = kind.load(AGENTS / f"{kind.__name__}-0.1.0.zip", env=env, trust=True)
    observation, _ = env.reset(seed=5)
    state = None
    for expected in json.loads((AGENTS / "actions.json").read_text())[kind.__name__]:
        action, state = model.predict(observation, state, deterministic=True)
        np.testing.assert_allclose(action, expected, atol=1e-6)
        observation = env.step(action)[0]
    model.learn(200, reset_num_timesteps=False)
