"""The commands, end to end on tiny runs, and their answers to mistakes."""

from __future__ import annotations

import csv
import datetime
import json
import shlex
import shutil
import signal
import subprocess
import sys
from pathlib import Path
from typing import Any

import pytest
import yaml
from checks import said

from sb3_tbc import evaluate, train
from sb3_tbc.zoo.algorithms import load_model
from sb3_tbc.zoo.callbacks import write_evaluations
from sb3_tbc.zoo.checkpoints import read_checkpoint
from sb3_tbc.zoo.environments import make_envs
from sb3_tbc.zoo.ledger import RunFolder

TINY = ["--hyperparams", "compile:false", "gradient_ratio:0.05", "low.batch_size:16", "high.batch_size:4"]
TINY += ["low.buffer_size:2000", "high.buffer_size:500", "max_options:3"]
SHORT = ["--eval-freq", "200", "--n-eval-episodes", "1", "--n-final-episodes", "2", "--no-progress"]
PINNED = ["task", "algo", "variant", "config", "seed", "n_timesteps", "n_episodes", "success_rate", "success_ci95"]
PINNED += ["mean_length", "mean_length_success", "subgoal_success", "mean_window"]


@pytest.fixture(scope="module")
def root(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder with one small finished run."""
    folder = tmp_path_factory.mktemp("runs")
    arguments = ["--env", "Pendulum", "--n-timesteps", "400", "--log-folder", str(folder), "--seed", "5"]
    assert train.main([*arguments, "--keep-checkpoint", "--trace", *SHORT, *TINY]) == 0
    return folder


@pytest.fixture
def run(root: Path) -> RunFolder:
    return RunFolder.for_run(root, "Pendulum", "tbc-hrl", "custom", 5)


def test_the_evaluation_that_is_printed_finds_ones_own_task(tmp_path: Path, monkeypatch: Any, capsys: Any) -> None:
    register = "gymnasium.register('Own-v0', corridor.Corridor, max_episode_steps=20)"
    (tmp_path / "own_tasks.py").write_text(f"import corridor, gymnasium\n{register}\n")
    monkeypatch.syspath_prepend(tmp_path)
    arguments = ["--env", "own_tasks:Own-v0", "--n-timesteps", "100", "--log-folder", str(tmp_path)]
    assert train.main([*arguments, *SHORT, *TINY]) == 0
    printed = shlex.split(capsys.readouterr().out.splitlines()[-1].partition("sb3_tbc.evaluate ")[2])
    del sys.modules["own_tasks"]
    assert evaluate.main([*printed, "--n-episodes", "1"]) == 0


def test_a_run_leaves_everything_behind(run: RunFolder) -> None:
    names = {p.name for p in run.path.iterdir()}
    assert {"config.yml", "command.txt", "versions.json", "evaluations.csv", "final.json"} <= names
    assert {"model.zip", "best_model.zip", "progress.csv", "options.csv", "checkpoint"} <= names
    final = run.read_final()
    assert set(PINNED) <= set(final)
    expected = ("Pendulum", "tbc-hrl", "custom", "tuned")
    assert (final["task"], final["algo"], final["variant"], final["config"]) == expected
    assert (final["seed"], final["n_timesteps"], final["n_episodes"]) == (5, 400, 2)
    assert [row.timesteps for row in run.read_evaluations()] == [200, 400]
    assert run.read_config()["model"]["low"]["batch_size"] == 16
    assert (run.path / "command.txt").read_text().startswith("python -m sb3_tbc.train --env Pendulum")
    with (run.path / "options.csv").open(encoding="utf-8", newline="") as file:
        assert sum(int(option["duration"]) for option in csv.DictReader(file)) > 1


def test_evaluate_prints_what_it_writes(run: RunFolder, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    out = tmp_path / "e.json"
    arguments = [str(run.model), "--n-episodes", "2", "--seed", str(run.read_final()["eval_seed"]), "--json", str(out)]
    assert evaluate.main(arguments) == 0
    assert capsys.readouterr().out == out.read_text()
    result = json.loads(out.read_text())
    assert list(result)[: len(PINNED)] == PINNED
    final = run.read_final()
    assert {k: result[k] for k in PINNED} == {k: final[k] for k in PINNED}  # a loaded agent acts as the saved one


def test_evaluate_prints_a_summary_for_people(run: RunFolder, capsys: pytest.CaptureFixture[str]) -> None:
    arguments = [str(run.model), "--n-episodes", "2", "--seed", str(run.read_final()["eval_seed"])]
    assert evaluate.main(arguments) == 0
    lines = capsys.readouterr().out.splitlines()
    assert lines[0] == "agent            tbc-hrl (custom), 400 training steps on Pendulum"
    assert lines[1].startswith(f"success rate     {run.read_final()['success_rate']:.2f}  (")
    assert "of 2 episodes; 95 % Wilson interval" in lines[1]
    assert 4 <= len(lines) <= 6


def test_json_to_standard_output_is_nothing_but_json(run: RunFolder, capsys: pytest.CaptureFixture[str]) -> None:
    arguments = [str(run.model), "--n-episodes", "2", "--seed", str(run.read_final()["eval_seed"]), "--json", "-"]
    assert evaluate.main(arguments) == 0
    captured = capsys.readouterr()
    assert {k: json.loads(captured.out)[k] for k in PINNED} == {k: run.read_final()[k] for k in PINNED}
    assert captured.err == ""


def test_a_folder_names_the_agent_inside(run: RunFolder, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert evaluate.main([str(run.path.parent)]) == 2
    assert f"did you mean {run.model}?" in said(capsys)
    assert evaluate.main([str(tmp_path)]) == 2
    assert "there is no .zip inside it" in said(capsys)


def test_watching_without_a_display(
    run: RunFolder, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.delenv("DISPLAY", raising=False)
    assert evaluate.main([str(run.model), "--n-episodes", "1", "--render"]) == 2
    assert "--render cannot open a window" in said(capsys)


def test_watching_shows_every_frame(run: RunFolder, monkeypatch: pytest.MonkeyPatch) -> None:
    from sb3_tbc.tasks import window

    shown: list[tuple[int, ...]] = []

    class Recorder:
        def __init__(self, title: str, fps: float) -> None:
            assert title == "Pendulum, tbc-hrl"

        def show(self, picture: Any) -> None:
            shown.append(picture.shape)

        def close(self) -> None:
            pass

    monkeypatch.setattr(window, "Window", Recorder)
    assert evaluate.main([str(run.model), "--n-episodes", "1", "--render", "--json", "-"]) == 0
    assert len(shown) > 1
    assert set(shown) == {shown[0]}


def test_names_without_regard_to_case(capsys: pytest.CaptureFixture[str]) -> None:
    from sb3_tbc.zoo.environments import resolve_env

    assert resolve_env("pendulum") == ("Pendulum", "sb3_tbc/Pendulum-v0")
    assert resolve_env("sb3_tbc/ur5reacher-V0") == ("UR5Reacher", "sb3_tbc/UR5Reacher-v0")
    args = train.build_parser().parse_args(["--algo", "HiTS", "--env", "DRAWBRIDGE", "--n-timesteps", "500"])
    spec = train.build_spec(args)
    assert (spec.run.algo, spec.run.task) == ("hits", "Drawbridge")


@pytest.mark.parametrize(
    ("arguments", "variant"),
    [
        ([], "full"),
        (["--n-timesteps", "500", "--hyperparams", "n_timesteps:600"], "full"),
        (["--config", "paper"], "full-paper"),
        (["--hyperparams", "learning_rate:1e-2"], "custom"),
        (["--config", "paper", "--on-bad-step", "end-episode"], "custom-paper"),
        (["--n-envs", "3"], "custom"),
        (["--hyperparams", "learning_rate:1e-2", "--variant", "quick"], "quick"),
    ],
)
def test_settings_of_ones_own_have_a_variant_of_their_own(arguments: list[str], variant: str) -> None:
    assert train.build_spec(train.build_parser().parse_args(["--algo", "sac", *arguments])).variant == variant


def test_a_file_of_ones_own_is_a_variant_only_where_it_differs(tmp_path: Path) -> None:
    from sb3_tbc.zoo.config import config_file

    copy = tmp_path / "mine.yml"
    shutil.copy(config_file("sac"), copy)
    args = train.build_parser().parse_args(["--algo", "sac", "--config", str(copy)])
    assert train.build_spec(args).variant == "full"
    sections = yaml.safe_load(copy.read_text())
    sections["Pendulum"]["tuned"]["gamma"] = 0.5
    copy.write_text(yaml.safe_dump(sections))
    for given in (["--config", str(copy)], ["--config", "tuned", "--config-file", str(copy)]):
        assert train.build_spec(train.build_parser().parse_args(["--algo", "sac", *given])).variant == "custom"


def test_evaluate_in_a_new_process(run: RunFolder, tmp_path: Path) -> None:
    out = tmp_path / "e.json"
    seed = str(run.read_final()["eval_seed"])
    arguments = [sys.executable, "-m", "sb3_tbc.evaluate", str(run.model), "--n-episodes", "2", "--seed", seed]
    done = subprocess.run([*arguments, "--json", str(out)], capture_output=True, text=True, timeout=120)
    assert done.returncode == 0, done.stderr
    assert {k: json.loads(out.read_text())[k] for k in PINNED} == {k: run.read_final()[k] for k in PINNED}


def test_a_finished_run_is_not_overwritten(run: RunFolder, root: Path, capsys: pytest.CaptureFixture[str]) -> None:
    before = {p: p.stat().st_mtime_ns for p in run.path.rglob("*")}
    assert train.main(["--n-timesteps", "200", "--log-folder", str(root), "--seed", "5", *SHORT, *TINY]) == 2
    assert "holds a finished run; nothing was changed" in said(capsys)
    assert {p: p.stat().st_mtime_ns for p in run.path.rglob("*")} == before


def test_resume_goes_on_and_keeps_the_curve(run: RunFolder, tmp_path: Path) -> None:
    copy = RunFolder(tmp_path / "seed_5")
    shutil.copytree(run.path, copy.path)
    assert train.main(["--resume", str(copy.path), "--n-timesteps", "600", "--no-progress"]) == 0
    assert [row.timesteps for row in copy.read_evaluations()] == [200, 400, 600]
    assert copy.read_final()["n_timesteps"] == 600
    assert copy.read_evaluations()[:2] == run.read_evaluations()
    assert copy.read_evaluations()[2].wall_time > run.read_evaluations()[1].wall_time
    assert copy.checkpoint.is_dir()  # --keep-checkpoint is remembered
    lines = (copy.path / "command.txt").read_text().splitlines()
    assert lines[0] == (run.path / "command.txt").read_text().strip()
    assert lines[1:] == [f"python -m sb3_tbc.train --resume {copy.path} --n-timesteps 600 --no-progress"]
    assert (copy.path / "versions.json").read_text() == (run.path / "versions.json").read_text()


@pytest.mark.parametrize(
    "given",
    [
        ["--algo", "hits"],
        ["--env", "UR5Reacher"],
        ["--seed", "0"],
        ["--hyperparams", "low.gamma:0.5"],
        ["--eval-freq", "100"],
        ["--n-eval-episodes", "20"],
        ["--n-envs", "2"],
        ["--config-file", "mine.yml"],
        ["--on-bad-step", "stop"],
        ["--log-folder", "runs"],
        ["--overwrite"],
    ],
)
def test_resume_refuses_what_it_would_ignore(
    given: list[str], run: RunFolder, capsys: pytest.CaptureFixture[str]
) -> None:
    before = (run.path / "config.yml").read_text()
    assert train.main(["--resume", str(run.path), "--n-timesteps", "600", *given]) == 2
    assert f"{given[0]} cannot be changed by --resume, which goes on as the run's config.yml says" in said(capsys)
    assert (run.path / "config.yml").read_text() == before


def test_every_option_is_a_setting_of_the_run_or_one_of_how_it_is_carried_out() -> None:
    of_how = {"n_timesteps", "resume", "ledger", "trace", "tensorboard", "checkpoint_minutes", "keep_checkpoint"}
    of_how |= {"device", "num_threads", "progress", "trust", "help_settings"}
    assert set(vars(train.build_parser().parse_args([]))) - {"list"} == of_how | set(train.NOT_RESUMED)


def test_a_ledger_that_cannot_take_the_result_is_told_before_training(
    run: RunFolder, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    root, ledger = tmp_path / "runs", tmp_path / "results"
    copy = RunFolder(root / run.path.relative_to(run.path.parents[3]))
    shutil.copytree(run.path, copy.path)
    monkeypatch.chdir(tmp_path)

    def trained(*_: Any, **__: Any) -> None:
        raise AssertionError("it was trained")

    monkeypatch.setattr(train, "resume_run", trained)
    monkeypatch.setattr(train, "start_run", trained)
    resume = ["--resume", str(copy.path), "--n-timesteps", "600", "--no-progress"]
    fresh = ["--n-timesteps", "600", "--log-folder", "runs", "--seed", "6", *SHORT, *TINY]
    for arguments, place in ((resume, str(root)), (fresh, str(root)), (fresh, "./runs")):
        assert train.main([*arguments, "--ledger", place]) == 2
        assert f"--ledger {Path(place)} is the folder of the runs itself; name another one" in said(capsys)
    copy.copy_to(RunFolder.for_run(ledger, "Pendulum", "tbc-hrl", "custom", 5))
    assert train.main([*resume, "--ledger", str(ledger)]) == 2
    assert "already holds a result; remove it first" in said(capsys)


def test_resume_without_a_checkpoint(run: RunFolder, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert train.main(["--resume", str(tmp_path)]) == 2
    assert "holds no run" in said(capsys)
    copy = RunFolder(tmp_path / "seed_5")
    shutil.copytree(run.path, copy.path)
    assert train.main(["--resume", str(copy.path)]) == 0  # there is nothing left to do
    assert "success rate" in capsys.readouterr().out
    assert train.main(["--resume", str(copy.path), "--n-timesteps", "300"]) == 2
    assert "is at 400 of 300 steps already; raise --n-timesteps" in said(capsys)
    shutil.rmtree(copy.checkpoint)
    assert train.main(["--resume", str(copy.path), "--n-timesteps", "600"]) == 2
    assert "has no checkpoint" in said(capsys)


def test_an_extended_run_cannot_end_where_it_was_before(
    run: RunFolder, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    """The folder still has the agent of the first end, which is not that of the checkpoint."""
    from sb3_tbc.zoo.callbacks import SuccessEvalCallback

    original = SuccessEvalCallback._on_step

    def interrupt(self: SuccessEvalCallback) -> bool:
        if self.num_timesteps == 650:
            signal.raise_signal(signal.SIGINT)
        return original(self)

    copy = RunFolder(tmp_path / "seed_5")
    shutil.copytree(run.path, copy.path)
    monkeypatch.setattr(SuccessEvalCallback, "_on_step", interrupt)
    assert train.main(["--resume", str(copy.path), "--n-timesteps", "2000", "--no-progress"]) == 130
    monkeypatch.setattr(SuccessEvalCallback, "_on_step", original)
    capsys.readouterr()
    steps = json.loads((copy.checkpoint / "state.json").read_text())["timesteps"]
    assert train.main(["--resume", str(copy.path), "--n-timesteps", "400", "--no-progress"]) == 2
    assert f"is at {steps} of 400 steps already; raise --n-timesteps" in said(capsys)
    assert not copy.finished
    assert copy.checkpoint.is_dir()
    assert train.main(["--resume", str(copy.path), "--n-timesteps", str(steps), "--no-progress"]) == 0
    assert copy.read_final()["n_timesteps"] == copy.read_config()["n_timesteps"] == steps


def test_an_extended_run_may_go_back_to_its_first_end(run: RunFolder, tmp_path: Path) -> None:
    """It was killed before its next checkpoint: what it had written beyond the first end goes."""
    copy = RunFolder(tmp_path / "seed_5")
    shutil.copytree(run.path, copy.path)
    copy.reopen(read_checkpoint(copy.checkpoint))
    copy.start({**copy.read_config(), "n_timesteps": 2000}, "")
    rows = run.read_evaluations()
    write_evaluations(copy.evaluations, [*rows, rows[-1]._replace(timesteps=600)])
    assert train.main(["--resume", str(copy.path), "--n-timesteps", "400", "--no-progress"]) == 0
    assert copy.read_final()["n_timesteps"] == copy.read_config()["n_timesteps"] == 400
    assert copy.read_evaluations() == rows


def test_ctrl_c_saves_and_resume_finishes(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    from sb3_tbc.zoo.callbacks import SuccessEvalCallback

    original = SuccessEvalCallback._on_step

    def interrupt(self: SuccessEvalCallback) -> bool:
        if self.num_timesteps in (150, 151):  # an impatient second Ctrl-C must not lose what the first one saves
            signal.raise_signal(signal.SIGINT)
        return original(self)

    monkeypatch.setattr(SuccessEvalCallback, "_on_step", interrupt)
    arguments = ["--algo", "hits", "--config", "paper", "--n-timesteps", "300", "--log-folder", str(tmp_path)]
    assert train.main([*arguments, *SHORT, *TINY]) == 130
    folder = RunFolder.for_run(tmp_path, "Pendulum", "hits", "custom-paper", 0)
    assert f"--resume {folder.path}" in capsys.readouterr().err
    assert not folder.finished
    monkeypatch.setattr(SuccessEvalCallback, "_on_step", original)
    assert train.main([*arguments, *SHORT, *TINY]) == 2
    assert f"or --resume {folder.path}" in said(capsys)
    ledger = tmp_path / "results"
    assert train.main(["--resume", str(folder.path), "--no-progress", "--ledger", str(ledger)]) == 0
    assert folder.read_final()["n_timesteps"] == 300
    assert RunFolder.for_run(ledger, "Pendulum", "hits", "custom-paper", 0).finished


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["--env", "Pendulm"], "unknown environment 'Pendulm'; did you mean 'Pendulum'?"),
        (["--env", "sb3_tbc/UR5reach-v0"], "did you mean 'sb3_tbc/UR5Reacher-v0'?"),
        (["--env", "no_such_module:Env-v0"], "cannot import module 'no_such_module'"),
        (["--env", "Pendulum-v1"], "its observation must be a Dict with the keys"),
        (["--algo", "hit"], "unknown algorithm 'hit'; did you mean 'hits'?"),
        (["--hyperparams", "low.learningrate:1"], "did you mean 'learning_rate'?"),
        (["--hyperparams", "env_kwargs:{observation: compct}"], "observation must be one of"),
        (["--hyperparams", "random_fraction:2"], "random_fraction must be a number from 0 to 1, got 2"),
        (["--ablation", "no-tz"], "no ablation 'no-tz'"),
        (["--config-file", "nowhere.yml"], "cannot read nowhere.yml: there is no such file"),
    ],
)
def test_mistakes_cost_one_line_and_write_nothing(
    arguments: list[str], message: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert train.main([*arguments, "--log-folder", str(tmp_path), "--no-progress"]) == 2
    assert message in said(capsys)
    assert list(tmp_path.iterdir()) == []


def test_zips_that_are_none_of_ours(run: RunFolder, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    from stable_baselines3 import SAC

    truncated, foreign = tmp_path / "cut.zip", tmp_path / "sac.zip"
    whole = run.model.read_bytes()
    truncated.write_bytes(whole[: len(whole) // 2])
    SAC("MlpPolicy", "Pendulum-v1", buffer_size=1, policy_kwargs={"net_arch": [2]}).save(foreign)
    capsys.readouterr()
    for path, message in [
        (tmp_path / "missing.zip", "no such file"),
        (truncated, "is not a complete agent .zip"),
        (foreign, "holds an agent of another algorithm (stable_baselines3.sac.policies)"),
    ]:
        assert evaluate.main([str(path)]) == 2
        assert message in said(capsys)
    assert evaluate.main([str(run.model), "--env", "UR5Reacher", "--n-episodes", "1"]) == 2
    assert "trained on observations of 3 entries, the environment gives 48" in said(capsys)


def test_arguments_of_an_environment_that_an_agents_file_cannot_give(
    run: RunFolder, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    path, env = tmp_path / "agent.zip", make_envs("sb3_tbc/Pendulum-v0", 1, 0)
    agent = load_model(run.model, env)
    agent.run_info["env_kwargs"] = {"day": datetime.date(2026, 1, 2)}  # type: ignore[union-attr]
    agent.save(path)
    env.close()
    capsys.readouterr()
    assert evaluate.main([str(path)]) == 2
    error = said(capsys)
    assert "does not give its environment's arguments as plain data but as \"{'day': datetime.date(2026" in error
    assert "pass --env, and --trust if you trust the file" in error
    assert evaluate.main([str(path), "--env", "Pendulum", "--trust", "--n-episodes", "1"]) == 0


def test_a_flipped_byte_is_noticed(run: RunFolder, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    damaged = tmp_path / "damaged.zip"
    content = bytearray(run.model.read_bytes())
    content[len(content) // 2] ^= 0xFF
    damaged.write_bytes(bytes(content))
    assert evaluate.main([str(damaged)]) == 2
    assert "damaged.zip" in said(capsys)


def test_config_of_a_run_builds_the_same_run(run: RunFolder) -> None:
    from sb3_tbc.zoo.run_spec import RunSpec

    data = yaml.safe_load((run.path / "config.yml").read_text())
    assert RunSpec.from_dict(data).to_dict() == data


@pytest.mark.parametrize("algo", ["hac", "sac"])
def test_baselines_go_through_the_same_doors(algo: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    small = TINY if algo == "hac" else ["--hyperparams", "gradient_ratio:0.02", "batch_size:16", "buffer_size:1000"]
    arguments = ["--algo", algo, "--env", "Drawbridge", "--log-folder", str(tmp_path), "--n-timesteps", "300"]
    assert train.main([*arguments, "--keep-checkpoint", *SHORT, *small]) == 0
    printed = capsys.readouterr().out
    assert ("subgoals reached" in printed) == (algo == "hac")
    assert "nan" not in printed
    folder = RunFolder.for_run(tmp_path, "Drawbridge", algo, "custom", 0)
    final = folder.read_final()
    assert final["algo"] == algo
    assert (final["subgoal_success"] is None) == (algo == "sac")
    out = tmp_path / "e.json"
    assert (
        evaluate.main([str(folder.model), "--n-episodes", "2", "--seed", str(final["eval_seed"]), "--json", str(out)])
        == 0
    )
    assert {k: json.loads(out.read_text())[k] for k in PINNED} == {k: final[k] for k in PINNED}
    assert train.main(["--resume", str(folder.path), "--n-timesteps", "500", "--no-progress"]) == 0
    assert folder.read_final()["n_timesteps"] >= 500


def test_ablations_print_their_parameters(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    arguments = ["--ablation", "no-ndbc", "--n-timesteps", "200", "--log-folder", str(tmp_path)]
    assert train.main([*arguments, *SHORT, *TINY]) == 0
    assert "no-ndbc: " in capsys.readouterr().out
    folder = RunFolder.for_run(tmp_path, "Pendulum", "tbc-hrl", "no-ndbc-custom", 0)
    assert folder.read_final()["variant"] == "no-ndbc-custom"
    assert folder.read_config()["model"]["low"]["policy_kwargs"]["ndbc"] is None
