"""The scripts' own arithmetic: what a picture weighs, what a table says."""

from __future__ import annotations

import ast
import importlib
import importlib.util
import io
import json
from pathlib import Path
from types import ModuleType

import numpy as np
import pytest

from sb3_tbc.tune.search_space import load_space, restrict
from sb3_tbc.zoo.config import load_config, parse_overrides

SCRIPTS = Path(__file__).parents[1] / "scripts"


def script(name: str) -> ModuleType:
    spec = importlib.util.spec_from_file_location(name, SCRIPTS / f"{name}.py")
    assert spec is not None
    assert spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


OTHERS = sorted([*SCRIPTS.rglob("*.py"), *(SCRIPTS.parent / "docs" / "images").glob("*.py")])


@pytest.mark.parametrize("path", OTHERS, ids=[path.name for path in OTHERS])
def test_what_a_script_imports_from_the_package_is_there(path: Path) -> None:
    for node in ast.walk(ast.parse(path.read_text())):
        if isinstance(node, ast.ImportFrom) and (node.module or "").startswith("sb3_tbc"):
            module = importlib.import_module(node.module or "")
            for name in (alias.name for alias in node.names):
                assert hasattr(module, name) or importlib.util.find_spec(f"{node.module}.{name}"), (path.name, name)


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


def test_the_committed_comparison_is_that_of_the_committed_runs() -> None:
    compare, docs = script("recurrent_sac"), SCRIPTS.parent / "docs"
    runs = json.loads((docs / "recurrent_sac.json").read_text())
    page = (docs / "recurrent_sac.md").read_text()
    assert compare.table(runs, range(5), 15_000) in page
    assert compare.tests(runs, range(5), 15_000) in page
    ends = {kind: [runs[f"{kind} {seed}"]["returns"][-1] for seed in range(5)] for kind in ("sac", "ndbc", "gru")}
    assert min(ends["ndbc"] + ends["gru"]) > max(ends["sac"])
    assert {run["updates"] for run in runs.values()} == {7000}
    del runs["gru 3"]
    assert "| - |" in compare.table(runs, range(5), 15_000)


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


def test_the_mutation_score_counts_what_was_tried() -> None:
    mutation = script("mutation")
    score = mutation.score_of({"a": 1, "b": 0, "c": None, "d": 33, "e": -24})
    assert (score.tried, score.alive) == (4, ["b", "d"])
    assert str(score) == "2 of 4 caught (50%)"
    assert str(mutation.score_of({})) == "none tried"
    for modules, tests in mutation.SUBJECTS.values():
        assert all((SCRIPTS.parent / path).is_file() for path in (*modules, *tests))


def test_commands_outside_of_the_ledger_are_understood() -> None:
    from sb3_tbc import train
    from sb3_tbc.benchmark import command as benchmark
    from sb3_tbc.tune import command as tune

    parsers = {"sb3_tbc.train": train, "sb3_tbc.benchmark": benchmark, "sb3_tbc.tune": tune}
    outside = script("outside_ledger")
    commands = [command for part in outside.PARTS.values() for command in part()]
    parsed = [(name, parsers[name].build_parser().parse_args(rest)) for name, *rest in commands]
    assert len(parsed) == 2 + 2 * len(outside.SKILLS) + 2
    for name, args in parsed:
        if name == "sb3_tbc.tune":
            path = SCRIPTS.parent / args.search_space
            base = load_config("tbc-hrl", args.env, overrides=parse_overrides(args.hyperparams or []))
            space = restrict(load_space("tbc-hrl", args.env, path), base, args.search, {})
            assert {"low.learning_rate", "tau", "ndbc.sub_steps", "max_options"} <= set(space)
            assert "memory" not in space


def test_the_committed_foreign_tasks_are_those_of_the_committed_runs() -> None:
    compare, docs = script("foreign_tasks"), SCRIPTS.parent / "docs"
    runs = json.loads((docs / "foreign_tasks.json").read_text())
    assert compare.text_of(runs) in (docs / "your_task.md").read_text()


def test_when_a_foreign_task_was_learned() -> None:
    compare = script("foreign_tasks")
    run = [[1000, 10.0, 0.5, 9.0], [2000, 11.0, 0.95, 5.0], [3000, 12.0, 0.8, 3.0]]
    late = [[1000, 30.0, 0.1, None], [2000, 60.0, 0.2, 7.0]]
    found = {"FetchReach-v4 tbc-hrl 100": run, "FetchReach-v4 tbc-hrl 101": run, "FetchReach-v4 sac 100": late}
    table = compare.learned(found).splitlines()
    assert table[2].split(" | ")[2:] == ["2", "2,000", "11", "3.0 |"]
    assert table[3].split(" | ")[2:] == ["1", "never", "never", "7.0 |"]
    assert compare.span([1000, None, 3000]) == "2,000 (1,000 to 3,000); 1 of 3 never"
    fast = [[6000 * k, 60.0 * k, k / 10, None] for k in range(1, 11)]
    slow = [[6000 * k, 120.0 * k, 0.0, None] for k in range(1, 6)]
    curves = compare.curves({"FetchPush-v4 tbc-hrl 100": fast, "FetchPush-v4 sac 100": slow})
    assert "| `FetchPush-v4`, 1,000 steps | 5 | 10 | 15 | 20 | 25 | 30 |" in curves
    assert f"| {compare.AGENTS['tbc-hrl']} | - | 0.10 | 0.20 | 0.30 | 0.40 | 0.50 |" in curves
    assert "| `FetchPush-v4`, CPU minutes | 1 | 2 | 4 | 6 | 8 | 10 |" in curves
    assert f"| {compare.AGENTS['tbc-hrl']} | 0.10 | 0.20 | 0.40 | 0.60 | 0.80 | 1.00 |" in curves


def test_a_run_ends_soon_after_it_has_learned() -> None:
    compare = script("foreign_tasks")
    rates = iter([0.2, 0.95, 0.7, 0.6, 0.5])
    watch = compare.Watch(compare.Plan(5000, 1000, (0,), to_goal=True), lambda model, seed: (next(rates), None), 0.0)
    watch.started = compare.cpu_seconds()
    steps = 0
    goes_on = True
    while goes_on:
        steps += 500
        watch.num_timesteps = steps
        watch.model = None
        goes_on = watch._on_step()
    assert [point.steps for point in watch.points] == [1000, 2000, 3000, 4000]


def test_a_stopwatch_counts_what_comes_after_the_warm_up(monkeypatch: pytest.MonkeyPatch) -> None:
    speeds = script("speeds")
    now = 0.0
    monkeypatch.setattr(speeds.time, "process_time", lambda: now)
    watch = speeds.Stopwatch(after=100, seconds=5.0)
    going = []
    for steps in range(50, 401, 50):
        watch.num_timesteps = steps
        going.append(watch._on_step())
        now += 30.0 if steps < 100 else 1.0  # compilation does not count
    assert going == [True] * 6 + [False] * 2
    assert watch.speed == pytest.approx(300 / 7)
