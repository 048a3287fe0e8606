"""The scripts' own arithmetic: what a picture weighs, what a table says."""

from __future__ import annotations

import importlib.util
import io
import json
from pathlib import Path
from types import ModuleType

import numpy as np
import pytest

SCRIPTS = Path(__file__).parents[1] / "scripts"


def script(name: str) -> ModuleType:
    spec = importlib.util.spec_from_file_location(name, SCRIPTS / f"{name}.py")
    assert spec is not None
    assert spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


def test_a_picture_gets_coarser_until_it_fits() -> None:
    image = pytest.importorskip("PIL.Image")
    picture = script("readme_picture")
    noise = np.random.default_rng(0).integers(0, 255, (120, 60, 80, 3), dtype=np.uint8)
    frames = list(noise)
    whole = picture.fitted(frames, 30.0, "webp", 10_000_000, 400)
    smaller = picture.fitted(frames, 30.0, "webp", len(whole) // 2, 400)
    assert len(smaller) < len(whole) // 2
    counts = [image.open(io.BytesIO(data)).n_frames for data in (whole, smaller)]
    assert counts[0] > counts[1] > 20
    with pytest.raises(SystemExit, match="below 100 bytes"):
        picture.fitted(frames, 30.0, "webp", 100, 400)


def test_one_id_stands_for_its_family_and_kind_of_reward() -> None:
    table = script("goal_environments")
    ids = [
        "gymnasium_robotics:PointMaze_Large-v3",
        "gymnasium_robotics:PointMaze_UMaze-v3",
        "gymnasium_robotics:PointMaze_UMazeDense-v3",
        "gymnasium_robotics:HandManipulateBlockRotateZ-v1",
        "gymnasium_robotics:HandManipulateBlock_BooleanTouchSensors-v1",
        "gymnasium_robotics:HandManipulateEgg-v1",
    ]
    chosen = table.one_of_each(ids)
    assert len(chosen) == 4
    assert set(chosen) > {"gymnasium_robotics:PointMaze_UMaze-v3", "gymnasium_robotics:HandManipulateEgg-v1"}
    assert len(chosen["gymnasium_robotics:PointMaze_UMaze-v3"]) == 2


def test_the_committed_table_is_that_of_the_committed_results() -> None:
    results = json.loads((SCRIPTS.parent / "docs" / "goal_environments.json").read_text())
    page = (SCRIPTS.parent / "docs" / "goal_environments.md").read_text()
    assert script("goal_environments").summary(list(results.values())) in page
    for result in results.values():
        assert f"`{result['id'].partition(':')[2]}`" in page
        assert not [said for said in result.values() if str(said).startswith(("TRACEBACK", "DIED", "TIMEOUT"))]


def test_the_table_says_what_happened() -> None:
    table = script("goal_environments")
    well = {"id": "panda_gym:A-v1", "training": "yes", "evaluating": "yes", "filming": "yes", "exporting": "yes"}
    refused = {
        "id": "panda_gym:B-v1",
        "training": "B-v1 cannot be used as a goal environment: its reward is x|y",
    }
    died = {"id": "panda_gym:C-v1", "training": "DIED with code -9: "}
    lines = [("panda_gym", table.row({**w, **extra}, ["a", "b"])) for w, extra in (
        (well, {"difference": "1e-07"}), (refused, {}), (died, {}),
    )]  # fmt: skip
    text = table.page(lines, ["highway-env"], 2, table.summary([well, refused, died]))
    assert "Of 3 families tried, 1 do all four, 1 are refused, 1 are broken." in text
    assert "| `A-v1` | 1 | yes | yes | yes | yes, within 1e-07 |" in text
    assert "| `B-v1` | 1 | refused: its reward is x/y |" in text
    assert "| `C-v1` | 1 | DIED with code -9" in text
    assert "Not tried yet: 2 more" in text
    assert "highway-env" in text
