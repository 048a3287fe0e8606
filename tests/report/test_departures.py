"""Departures from the paper, and the rows that measure them."""

from __future__ import annotations

from pathlib import Path

import pytest
import yaml
from made_up_runs import fake_run

from sb3_tbc.errors import ConfigError
from sb3_tbc.report.departures import departures_of, departures_table
from sb3_tbc.report.runs import load_results

ROOT = Path(__file__).parents[2]


def test_departures_from_the_paper_come_with_their_measurement(tmp_path: Path) -> None:
    for seed in range(3):
        fake_run(tmp_path, "Pendulum", "tbc-hrl", seed, 0.9)
        fake_run(tmp_path, "Pendulum", "tbc-hrl", seed, 0.6, variant="with-memory", config={"n_timesteps": 1000})
        fake_run(tmp_path, "UR5Reacher", "tbc-hrl", seed, 0.9)
    fake_run(tmp_path, "Pendulum", "tbc-hrl", 3, 0.0)  # a seed that the other row does not have
    (tmp_path / "measurements.yml").write_text("default: {tbc-hrl with-memory: [memory]}")
    header, *rows = departures_table(tmp_path, load_results(tmp_path))
    cells = {(row[0], row[3]): dict(zip(header, row, strict=True)) for row in rows}
    memory = cells["memory", "all"]
    assert (memory["paper"], memory["shipped"]) == ("window", "none")
    assert memory["what it is worth"].startswith("Pendulum: +0.300 (")
    assert "), steps saved: not reached in 4,000, against tbc-hrl with-memory" in memory["what it is worth"]
    assert memory["what it is worth"].endswith("which differs in training steps: 1,000 (4,000)")
    assert cells["window_end", "all"]["what it is worth"] == "not measured"
    assert cells["max_options", "UR5Reacher"]["paper"] == "24"
    assert not [row for row in rows if row[1] == row[2]]
    assert not [row for row in rows if row[0] == "kappa"]  # the same in both


def test_rows_of_former_settings_measure_against_ours_of_then(tmp_path: Path) -> None:
    for variant, rate in (("full", 1.0), ("no-hindsight-cuts", 0.8), ("with-memory", 0.7)):
        fake_run(tmp_path, "Pendulum", "tbc-hrl", 0, rate, variant)
    (tmp_path / "measurements.yml").write_text("default: {tbc-hrl with-memory: [memory]}")
    (tmp_path / "references.yml").write_text("Pendulum: {tbc-hrl no-hindsight-cuts: [tbc-hrl with-memory]}")
    (said,) = [row[-1] for row in departures_table(tmp_path, load_results(tmp_path)) if row[0] == "memory"]
    assert said.startswith("Pendulum: +0.100 (")
    assert said.endswith("against tbc-hrl with-memory (ours: tbc-hrl no-hindsight-cuts)")


@pytest.mark.parametrize("settings", ["memory_of_old", "5", ""])
def test_measured_settings_are_a_list(settings: str, tmp_path: Path) -> None:
    """In the text, ``memory`` was found, and the row counted as its measurement; a number ended in a traceback."""
    fake_run(tmp_path, "Pendulum", "tbc-hrl", 0, 0.9)
    (tmp_path / "measurements.yml").write_text(f"default: {{tbc-hrl with-memory: {settings}}}")
    with pytest.raises(
        ConfigError, match=r"default, tbc-hrl with-memory must be a list of settings, as \[gamma\], got"
    ):
        departures_table(tmp_path, load_results(tmp_path))


def test_measurements_name_departures_that_there_are() -> None:
    """Nothing is said to measure a setting that the shipped agent does not depart in."""
    table = yaml.safe_load((ROOT / "results" / "measurements.yml").read_text())
    everywhere = {name for task in load_results(ROOT / "results") for name in departures_of(task)}
    for task, rows in table.items():
        allowed = everywhere if task == "default" else set(departures_of(task))
        assert not [(row, name) for row, names in rows.items() for name in names if name not in allowed]
