"""What ``benchmark cells`` and ``benchmark parameters`` print."""

from __future__ import annotations

import json
from pathlib import Path

import pytest

from sb3_tbc.benchmark.cells import _straight_line
from sb3_tbc.benchmark.circuits import PAPER_TASKS, shipped_circuits
from sb3_tbc.benchmark.command import benchmark


def test_every_circuit_is_counted_beside_its_mlp(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert benchmark(["parameters", "--json", str(tmp_path / "out.json")]) == 0
    rows = json.loads((tmp_path / "out.json").read_text())["parameters"]
    assert [row["task"] for row in rows if row["config"] == "paper"] == list(PAPER_TASKS)
    assert all(row["share"] == row["ndbc"] / row["mlp"] for row in rows)
    assert all(row["share"] < (0.3 if row["config"] == "paper" else 0.5) for row in rows)
    printed = capsys.readouterr().out
    assert all(str(row["ndbc"]) in printed for row in rows)


def test_a_tuned_circuit_is_named_beside_table_a1s() -> None:
    found = {circuit.title: circuit for circuit in shipped_circuits()}
    paper, tuned = found["Pendulum"], found["Pendulum, tuned, K = 3, lean"]
    assert paper.wiring.n_inputs == tuned.wiring.n_inputs
    assert paper.wiring.n_synapses < tuned.wiring.n_synapses
    assert found["UR5Reacher, tuned, K = 3, lean"].wiring.sensory_to == ("inter", "command", "motor")


def test_a_curve_that_bends_is_not_called_straight() -> None:
    sizes = (1, 2, 4, 8, 16)
    assert _straight_line("x", {n: 2.0 * n + 1.0 for n in sizes}, "ms")[1]["r2"] == pytest.approx(1.0)
    assert _straight_line("x", {n: float(n**4) for n in sizes}, "ms")[1]["r2"] < 0.95


def test_cells_are_timed_in_one_run(capsys: pytest.CaptureFixture[str]) -> None:
    assert benchmark(["cells", "--rounds", "1", "--batch", "4", "--time", "2", "--no-growth"]) == 0
    printed = capsys.readouterr().out
    for name in ("NDBC K=3", "NDBC K=3 dissipative", "NDBC closed form", "GRU(32)"):
        assert f"| {name} |" in printed
    assert "low level with bounds and squashing" in printed
