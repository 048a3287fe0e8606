"""The C file in other programs than the exporter's own check: broken sensors, C++, several agents, strict compilers."""

from __future__ import annotations

import shutil
import subprocess
from pathlib import Path

import gymnasium as gym
import numpy as np
import pytest
import torch as th
from exported import CASES, make, needs_cc, trained_look

from sb3_tbc import TBCHRL
from sb3_tbc.errors import NonFiniteError
from sb3_tbc.export.c99 import to_c
from sb3_tbc.export.check import CPlayer, NumpyPlayer
from sb3_tbc.export.numpy_module import to_numpy_module
from sb3_tbc.export.policy import Circuit, extract
from sb3_tbc.export.rounding import rounded

pytestmark = needs_cc
needs_cpp = pytest.mark.skipif(shutil.which("c++") is None, reason="no C++ compiler")
RENAMED = ["-Dtbc_reset=b_reset", "-Dtbc_step=b_step", "-Dtbc_low_mean=b_low_mean"]


def compiled(folder: Path, *command: str) -> subprocess.CompletedProcess[str]:
    return subprocess.run(command, cwd=folder, capture_output=True, text=True)


@pytest.mark.parametrize("bad", [np.nan, np.inf, -np.inf])
@pytest.mark.parametrize("case", ["reached", "whole", "mlp", "lean reflex", "dissipative", "relative"])
def test_a_broken_sensor_gives_no_action_and_leaves_the_state(case: str, bad: float, tmp_path: Path) -> None:
    """``predict`` raises, and its caller still has the state of before; so has the caller of the C function."""
    model, env = make(case)
    trained_look(model)
    policy = extract(model, case)
    (tmp_path / "policy.c").write_text(to_c(policy))
    player = CPlayer(tmp_path / "policy.c", policy)
    state, refusals = None, 0
    seen, _ = env.reset(seed=0)
    for step in range(60):
        key = ("observation", "achieved_goal", "desired_goal")[step % 3]
        broken = {**seen, key: seen[key].copy()}
        broken[key][step % len(seen[key])] = bad
        before = player._state.raw
        try:
            action, after = model.predict(broken, state, deterministic=True)
        except NonFiniteError:
            assert np.isnan(player.step(broken)).all()
            assert player._state.raw == before
            refusals += 1
            action, state = model.predict(seen, state, deterministic=True)
            np.testing.assert_allclose(player.step(seen), action, atol=1e-5)
        else:
            state = after
            np.testing.assert_allclose(player.step(broken), action, atol=1e-5)
        seen = env.step(action)[0]
    assert refusals >= 3


@pytest.mark.parametrize("precision", [[], ["-DTBC_SINGLE"], ["-DTBC_SINGLE", "-DTBC_INTEGRATED_ONLY"]])
@pytest.mark.parametrize("case", [case for case in CASES if case != "hac"])
@pytest.mark.parametrize("rounding", [False, True])
def test_strict_compilers_have_nothing_to_say(case: str, precision: list[str], rounding: bool, tmp_path: Path) -> None:
    policy = extract(make(case)[0], case)
    (tmp_path / "policy.c").write_text(to_c(rounded(policy) if rounding else policy))
    flags = ["-std=c99", "-pedantic", "-Wall", "-Wextra", "-Wconversion", "-Wshadow", "-Werror", *precision]
    built = compiled(tmp_path, "cc", *flags, "-c", "policy.c")
    assert built.returncode == 0, built.stderr


def test_two_agents_in_one_source_file_are_refused(tmp_path: Path) -> None:
    for name, case in {"a": "reached", "b": "mlp"}.items():
        (tmp_path / f"{name}.c").write_text(to_c(extract(make(case)[0], case)))
    (tmp_path / "both.c").write_text('#include "a.c"\n#include "b.c"\n')
    (tmp_path / "twice.c").write_text('#define TBC_DECLARATIONS_ONLY\n#include "a.c"\n#include "a.c"\n')
    assert "Two policies in one source file" in compiled(tmp_path, "cc", "-c", "both.c").stderr
    assert compiled(tmp_path, "cc", "-c", "twice.c").returncode == 0


USER = """
#include <stdio.h>
#define TBC_DECLARATIONS_ONLY
#include "{name}.c"
#ifdef __cplusplus
extern "C"
#endif
void act_{name}(void);
void act_{name}(void)
{{
    tbc_state state;
    float o[TBC_OBSERVATION] = {{1.0f}}, a[TBC_ACHIEVED_GOAL] = {{0.5f}}, d[TBC_DESIRED_GOAL] = {{0.0f}}, u[TBC_ACTION];
    tbc_reset(&state);
    printf("%d ", tbc_step(&state, o, a, d, 0, u));
    printf("%.6f\\n", (double)u[0]);
}}
"""


@needs_cpp
def test_two_agents_serve_one_program_of_c_and_cpp(tmp_path: Path) -> None:
    models = {"a": make("reached")[0], "b": make("mlp")[0]}
    for name, model in models.items():
        (tmp_path / f"{name}.c").write_text(to_c(extract(model, name)))
        (tmp_path / f"use_{name}.cpp").write_text(USER.format(name=name))
    (tmp_path / "main.c").write_text(
        "void act_a(void); void act_b(void); int main(void) { act_a(); act_b(); return 0; }"
    )
    steps = [
        ["cc", "-c", "a.c"],
        ["cc", "-c", *RENAMED, "b.c"],
        ["c++", "-Wall", "-Wextra", "-Werror", "-c", "use_a.cpp"],
        ["c++", "-Wall", "-Wextra", "-Werror", "-c", *RENAMED, "use_b.cpp"],
        ["c++", "-c", "a.c", "-o", "as_cpp.o"],  # the definitions, too, are C++
        ["cc", "-c", "main.c"],
        ["c++", "main.o", "a.o", "b.o", "use_a.o", "use_b.o", "-o", "main", "-lm"],
    ]
    for step in steps:
        built = compiled(tmp_path, *step)
        assert built.returncode == 0, built.stderr
    printed = compiled(tmp_path, "./main").stdout.split()
    seen = {"observation": [1.0, 0.0, 0.0], "achieved_goal": [0.5, 0.0], "desired_goal": [0.0, 0.0]}
    actions = [
        model.predict({k: np.array(v) for k, v in seen.items()}, deterministic=True)[0] for model in models.values()
    ]
    assert printed == ["1", f"{actions[0][0]:.6f}", "1", f"{actions[1][0]:.6f}"]


def test_a_time_budget_that_is_not_finite_is_refused(tmp_path: Path) -> None:
    """An infinite goal saturates the subgoal, which alone the low level sees, and makes the time budget NaN."""
    model = TBCHRL("MultiInputPolicy", gym.make("sb3_tbc/Pendulum-v0"), seed=1, compile=False, whole_budgets=True)
    with th.no_grad():
        for p in model.high.policy.average_actor.parameters():
            p.abs_()
        model.high.policy.average_actor.mu.weight[-1, ::2] *= -1.0
    model.high.acting.refresh()
    policy = extract(model)
    (tmp_path / "policy.c").write_text(to_c(policy))
    player = CPlayer(tmp_path / "policy.c", policy)
    goal = {"observation": np.zeros(3), "achieved_goal": np.zeros(2), "desired_goal": np.array([np.inf, 0.0])}
    with pytest.raises(NonFiniteError, match="time budget"):
        model.predict(goal, deterministic=True)
    assert np.isnan(player.step(goal)).all()


@pytest.mark.parametrize("rounding", [False, True])
def test_a_circuit_with_more_synapses_than_a_short_counts_acts_as_the_agent(rounding: bool, tmp_path: Path) -> None:
    """Where a neuron's synapses begin is a number beyond 65,535 then; compilers cut it off with a warning."""
    wiring = {"inter": 270, "command": 270, "inter_fanout": 250, "synapses": "lean"}
    env = gym.make("sb3_tbc/Pendulum-v0")
    low = {"policy_kwargs": {"ndbc": wiring}, "buffer_size": 100}
    model = TBCHRL("MultiInputPolicy", env, low=low, memory="window", seed=1, compile=False)
    exact = extract(model)
    policy = rounded(exact) if rounding else exact
    assert isinstance(policy.low, Circuit)
    assert (policy.low.recurrent[:, : policy.low.n_neurons] != 0).sum() > 2**16
    (tmp_path / "policy.c").write_text(to_c(policy))
    (tmp_path / "policy.py").write_text(to_numpy_module(policy))
    c, module = CPlayer(tmp_path / "policy.c", policy), NumpyPlayer(tmp_path / "policy.py")
    seen, _ = env.reset(seed=0)
    for _ in range(5):
        action = c.step(seen)
        np.testing.assert_allclose(action, module.step(seen), atol=1e-5)
        seen = env.step(action)[0]
