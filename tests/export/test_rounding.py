"""Weights of eight bits: what rounding does to a matrix, and exports that compute with the rounded weights."""

from __future__ import annotations

import shutil
from dataclasses import fields, is_dataclass
from pathlib import Path

import gymnasium as gym
import numpy as np
import pytest
from exported import CASES, assert_same_actions, make, needs_cc, trained_look
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra.numpy import array_shapes, arrays

import sb3_tbc.export.command
from sb3_tbc.arrays import FloatArray
from sb3_tbc.export.c99 import to_c
from sb3_tbc.export.check import CPlayer, NumpyPlayer, compare_rounded, cortex_m4
from sb3_tbc.export.policy import Circuit, extract
from sb3_tbc.export.rounding import LARGEST, rounded, whole
from sb3_tbc.pretrained import model_path
from sb3_tbc.zoo.algorithms import load_two_levels

SMALLEST_NORMAL = float(np.finfo(np.float32).tiny)
WEIGHTS = st.floats(-1e4, 1e4, width=32).filter(lambda v: v == 0 or abs(v) > 1e-20)
MATRICES = arrays(np.float32, array_shapes(min_dims=2, max_dims=2, min_side=0, max_side=9), elements=WEIGHTS)


@given(MATRICES)
def test_entries_are_off_by_half_a_step_at_most(matrix: FloatArray) -> None:
    numbers, unit, halvings = whole(matrix)
    steps = unit / 2.0**halvings
    assert (np.abs(numbers.astype(int)) <= LARGEST).all()
    assert (np.abs(whole(matrix).values - matrix) <= 0.5 * steps).all()
    assert unit == 2.0 ** np.rint(np.log2(unit))  # exact in C


@given(MATRICES)
def test_steps_are_as_fine_as_eight_bits_allow(matrix: FloatArray) -> None:
    """The largest entry of an output takes at least seven of the eight bits, unless other outputs are far stronger."""
    numbers, _, halvings = whole(matrix)
    used = np.abs(numbers.astype(int)).max(axis=0, initial=0)
    some = np.abs(matrix).max(axis=0, initial=0.0) > 0
    assert ((used > LARGEST // 2) | ~some | (halvings == 30)).all()


@given(MATRICES)
def test_rounding_again_changes_nothing(matrix: FloatArray) -> None:
    once = whole(matrix)
    again = whole(once.values)
    np.testing.assert_array_equal(again.values, once.values)


@pytest.mark.parametrize("case", CASES)
def test_only_the_low_levels_weights_are_rounded(case: str) -> None:
    policy = extract(trained_look(make(case)[0]), case)
    small = rounded(policy)
    assert small.weights == "int8"
    assert small.high is policy.high
    matrices = {"weights", "current_weight", "from_inputs", "recurrent", "readout", "input_weight"}
    assert is_dataclass(policy.low)
    changed = {f.name for f in fields(policy.low) if getattr(policy.low, f.name) is not getattr(small.low, f.name)}
    assert changed
    assert changed <= matrices
    for name in changed - {"weights"}:
        before, after = getattr(policy.low, name), getattr(small.low, name)
        assert not np.array_equal(before, after) or (name == "from_inputs" and not len(policy.low.sensory_gain))
        assert np.abs(after - before).max() <= np.abs(before).max() / LARGEST + SMALLEST_NORMAL


@pytest.mark.parametrize("case", ["lean", "reached"])
def test_synapses_stay_what_they_are(case: str) -> None:
    """A lean synapse's conductance is its weight's size; in the paper's form no current flows without conductance."""
    low = rounded(extract(trained_look(make(case)[0]), case)).low
    assert isinstance(low, Circuit)
    weighted, total = np.split(low.recurrent, 2, axis=1)
    if case == "lean":
        np.testing.assert_array_equal(np.abs(weighted), total)
    assert (total >= 0).all()
    assert (weighted[total == 0] == 0).all()


@needs_cc
@pytest.mark.parametrize("flags", [("-O2",), ("-O2", "-DTBC_INTEGRATED_ONLY")])
@pytest.mark.parametrize("case", CASES)
def test_the_c_file_computes_with_the_rounded_weights(case: str, flags: tuple[str, ...], tmp_path: Path) -> None:
    """The NumPy module, which is checked against predict without rounding, has the same weights as floats."""
    model, env = make(case)
    policy = rounded(extract(trained_look(model), case))
    for kind in ("c", "numpy"):
        sb3_tbc.export.command.WRITERS[kind](policy, tmp_path / f"policy{sb3_tbc.export.command.SUFFIXES[kind]}")
    assert "static const signed char" in (tmp_path / "policy.c").read_text()
    c, module = CPlayer(tmp_path / "policy.c", policy, flags), NumpyPlayer(tmp_path / "policy.py")
    assert_same_actions(module, c, env, 200)


@needs_cc
def test_a_packaged_agent_succeeds_with_weights_of_eight_bits(tmp_path: Path) -> None:
    model = load_two_levels(model_path("pretrained:UR5Reacher"))
    env = gym.make("sb3_tbc/UR5Reacher-v0", observation="compact")
    policy = rounded(extract(model, "UR5Reacher"))
    (tmp_path / "policy.c").write_text(to_c(policy))
    result = compare_rounded(model, CPlayer(tmp_path / "policy.c", policy), env, 1500)
    assert result.beside.max_difference > 0
    assert "WARNING" not in str(result)
    assert result.alone.successes >= result.alone.finished - 1 > 10
    unlike = str(result._replace(half_range=1e-3))
    assert "WARNING: with weights of eight bits it does not act as this agent does" in unlike
    assert "--weights float32" in unlike


@pytest.mark.skipif(shutil.which("arm-none-eabi-gcc") is None, reason="no Cortex-M compiler")
def test_the_packaged_ants_low_level_fits_eight_kibibytes(tmp_path: Path) -> None:
    policy = extract(load_two_levels(model_path("pretrained:AntFourRooms")), "AntFourRooms")
    (tmp_path / "policy.c").write_text(to_c(rounded(policy)))
    size = cortex_m4(tmp_path / "policy.c")
    assert size is not None
    assert size.flash + size.library < 8 * 1024


@needs_cc
def test_the_command_says_what_rounding_costs(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    make("memoryless")[0].save(tmp_path / "agent.zip")
    arguments = [str(tmp_path / "agent.zip"), "--format", "c", "--weights", "int8", "--env", "Pendulum"]
    assert sb3_tbc.export.command.command(arguments) == 0
    assert "weights of eight bits: not compared with the agent" in capsys.readouterr().out
    assert sb3_tbc.export.command.command([*arguments, "--check", "30"]) == 0
    printed = capsys.readouterr().out
    assert "weights of eight bits: actions differ from predict's by" in printed
    assert "closed form" not in printed
    assert "acting alone for 30 steps" in printed
