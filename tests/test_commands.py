"""Every command through both entries, its help text, and its answer where an optional package is missing."""

from __future__ import annotations

import argparse
import runpy
import subprocess
import sys
from importlib import import_module
from pathlib import Path
from types import ModuleType
from typing import Any

import pytest
import sb3_tbc.tasks
from test_cli import said

from sb3_tbc import __main__, evaluate, train
from sb3_tbc.benchmark import command as benchmark
from sb3_tbc.commands import COMMANDS, Parser, given_path, output_file, python, run_command
from sb3_tbc.export import command as export
from sb3_tbc.extras import MissingExtraError, require
from sb3_tbc.ndbc.wiring import NDBCWiring
from sb3_tbc.settings import Settings
from sb3_tbc.settings.listing import entries
from sb3_tbc.tbc_hrl.config import FlatConfig, TBCConfig
from sb3_tbc.tune import command as tune
from sb3_tbc.zoo.runner import evaluation_seed, final_seed

RIDDLES = (
    "in so many",
    "is said too",
    "silent for so long",
    "goes on where",
    "brings along",
    "where there are such",
    "of which --config",
    "every so many",
    "of so many",
    "after so long",
    "without say",
    "left all sense",
    "there is no longer",
    "lived through",
    "near is near enough",
    "stays owed",
    "who is owed",
    "none writes none",
)
"""Phrases that a newcomer has to read twice, kept out of help texts, docstrings and messages."""


def parsers() -> dict[str, argparse.ArgumentParser]:
    """The parser of every command and of every sub-command."""
    found: dict[str, argparse.ArgumentParser] = {}
    for name, command in COMMANDS.items():
        found[name] = import_module(command.module).build_parser()
        for action in found[name]._actions:
            if isinstance(action, argparse._SubParsersAction):
                found.update({f"{name} {sub}": parser for sub, parser in action.choices.items()})
    return found


@pytest.mark.parametrize("name", COMMANDS)
def test_help_through_the_console_script(name: str, capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(SystemExit) as stop:
        __main__.main([name, "--help"])
    assert stop.value.code == 0
    assert f"usage: sb3_tbc.{name}" in capsys.readouterr().out


@pytest.mark.parametrize("name", COMMANDS)
@pytest.mark.filterwarnings("ignore:.*found in sys.modules:RuntimeWarning")
def test_help_through_python_m(name: str, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]) -> None:
    monkeypatch.setattr(sys, "argv", [f"sb3_tbc.{name}", "--help"])
    with pytest.raises(SystemExit) as stop:
        runpy.run_module(f"sb3_tbc.{name}", run_name="__main__", alter_sys=True)
    assert stop.value.code == 0
    assert f"usage: sb3_tbc.{name}" in capsys.readouterr().out


@pytest.mark.parametrize("name", COMMANDS)
def test_help_ends_with_examples_that_the_parser_takes(name: str) -> None:
    import shlex

    parser = parsers()[name]
    lines = [line for line in parser.format_help().splitlines() if line.startswith(f"  python -m sb3_tbc.{name}")]
    assert lines
    for line in lines:
        arguments = shlex.split(line.partition(" > ")[0], comments=True)[3:]
        if "--list" not in arguments:
            parser.parse_args(arguments)


@pytest.mark.parametrize("name", parsers())
def test_every_option_says_what_it_is_for(name: str) -> None:
    for action in parsers()[name]._actions:
        assert action.help or isinstance(action, argparse._SubParsersAction), f"{name}: {action.dest}"
        assert not [riddle for riddle in RIDDLES if riddle in str(action.help)]


@pytest.mark.parametrize("name", parsers())
def test_an_option_given_again_adds_its_values(name: str, monkeypatch: pytest.MonkeyPatch) -> None:
    parser = parsers()[name]
    for action in parser._actions:
        if action.nargs in ("+", "*") and action.option_strings:
            monkeypatch.setattr(action, "type", None)
            (option,), default = action.option_strings, list(action.default or [])
            args = parser.parse_args([option, "a", option, "b", "c"])
            assert getattr(args, action.dest) == ["a", "b", "c"], option
            assert list(action.default or []) == default


def test_settings_are_given_in_one_or_several_options() -> None:
    given = ["--hyperparams", "low.gamma:0.9", "--hyperparams", "max_options:5"]
    for parser in (train.build_parser(), tune.build_parser(), import_module("sb3_tbc.reproduce").build_parser()):
        assert parser.parse_args(given).hyperparams == ["low.gamma:0.9", "max_options:5"]


def test_options_are_not_abbreviated(capsys: pytest.CaptureFixture[str]) -> None:
    for name, given in (("reproduce", ["--seed", "300"]), ("benchmark fit", ["--actor", "mlp"])):
        with pytest.raises(SystemExit) as stopped:
            parsers()[name].parse_args(given)
        assert stopped.value.code == 2
        assert f"unrecognized arguments: {given[0]}" in capsys.readouterr().err


@pytest.mark.parametrize("config", [TBCConfig, FlatConfig])
def test_every_setting_is_explained_without_riddles(config: type[Settings]) -> None:
    for entry in entries(config):
        assert not [riddle for riddle in RIDDLES if riddle in entry.text], entry.name


@pytest.mark.parametrize("package", [sb3_tbc, sb3_tbc.tasks])
def test_sources_have_no_riddles(package: ModuleType) -> None:
    for path in Path(str(package.__file__)).parent.rglob("*.py"):
        text = " ".join(path.read_text(encoding="utf-8").split())
        assert not [riddle for riddle in RIDDLES if riddle in text], path


def test_defaults_are_said_once(capsys: pytest.CaptureFixture[str]) -> None:
    text = " ".join(train.build_parser().format_help().split())
    assert "episodes of each evaluation (default: 20)" in text
    assert "seed of everything random in the run (default: 0)" in text
    assert "(default: None)" not in text
    assert "(default: False)" not in text
    parser = Parser("x", {"x --y": "why"})
    parser.add_argument("--y", default=3, help="a number; by default three")
    assert "default: 3" not in parser.format_help()


@pytest.mark.parametrize(("name", "command"), [
    ("sb3_tbc.train", ["sb3_tbc.train", "--help-settings"]), ("sb3-tbc", ["sb3_tbc", "--help"]),
])  # fmt: skip
def test_output_that_nobody_reads_is_one_line(name: str, command: list[str]) -> None:
    pipes = {"stdout": subprocess.PIPE, "stderr": subprocess.PIPE}
    with subprocess.Popen([sys.executable, "-m", *command], **pipes) as process:
        process.stdout.close()  # as head does when it has its lines
        line = f"{name}: error: broken pipe: what reads the output has ended\n"
        assert process.stderr.read() == line.encode()
    assert process.returncode == 1


def test_list_of_tasks(capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(SystemExit) as stop:
        train.main(["--list"])
    assert stop.value.code == 0
    lines = capsys.readouterr().out.splitlines()
    (pendulum,) = [line.split() for line in lines if line.startswith("  Pendulum ")]
    assert pendulum[1] == "200,000"
    assert float(pendulum[2]) > 0
    (tennis,) = [line.split() for line in lines if line.startswith("  Tennis2D ")]
    assert tennis[3] == "box2d"
    assert [line.split()[0] for line in lines if line.startswith("  ")][-4:] == ["tbc-hrl", "hits", "hac", "sac"]


def hide(monkeypatch: pytest.MonkeyPatch, *modules: str) -> None:
    """Make modules impossible to import, as if their package were not installed."""
    for module in modules:
        for loaded in [m for m in sys.modules if m.startswith(f"{module}.")]:
            monkeypatch.delitem(sys.modules, loaded)
        monkeypatch.setitem(sys.modules, module, None)


@pytest.mark.parametrize(
    ("main", "arguments", "module", "extra"),
    [
        (evaluate.main, ["missing.zip", "--video", "film.mp4"], "imageio", "video"),
        (train.main, ["--tensorboard", "--log-folder", "runs"], "tensorboard", "plots"),
        (tune.main, ["--n-trials", "1"], "optuna", "tune"),
        (export.main, ["missing.zip", "--format", "onnx"], "onnx", "export"),
        (benchmark.main, ["parameters"], "Box2D", "box2d"),
    ],
)
def test_a_missing_extra_is_one_line_and_writes_nothing(
    main: object,
    arguments: list[str],
    module: str,
    extra: str,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    monkeypatch.chdir(tmp_path)
    hide(monkeypatch, module)
    assert main(arguments) == 2  # type: ignore[operator]
    said = capsys.readouterr().err
    assert said.count("\n") == 1
    assert f"pip install 'sb3_tbc[{extra}]'" in said
    assert module in said
    assert list(tmp_path.iterdir()) == []


def test_drawing_a_wiring_without_matplotlib(monkeypatch: pytest.MonkeyPatch) -> None:
    hide(monkeypatch, "matplotlib")
    wiring = NDBCWiring(
        3, inter=4, command=3, motor=1, sensory_fanout=2, inter_fanout=2, recurrent_command_synapses=1, motor_fanin=2
    )
    with pytest.raises(MissingExtraError, match=r"sb3_tbc\[plots\]"):
        wiring.draw()


def test_require_gives_the_module_and_names_real_extras() -> None:
    import configparser

    assert require("json", extra="none", what="nothing") is sys.modules["json"]
    parser = configparser.ConfigParser()
    parser.read(Path(__file__).parents[1] / "setup.cfg")
    import re

    sources = (Path(__file__).parents[1] / "sb3_tbc").rglob("*.py")
    named = {extra for source in sources for extra in re.findall(r"require\(.*?extra=\"(\w+)\"", source.read_text())}
    assert named
    assert named <= set(parser["options.extras_require"])


def test_seeds_are_those_that_environments_take(capsys: pytest.CaptureFixture[str]) -> None:
    seeds = [
        (name, option)
        for name, parser in parsers().items()
        for action in parser._actions
        for option in action.option_strings
        if option.endswith("seed")
    ]
    assert len(seeds) > 6
    for name, option in seeds:
        for value in ("-1", str(2**32), "x"):
            with pytest.raises(SystemExit) as stopped:
                parsers()[name].parse_args([option, value])
            assert stopped.value.code == 2
            said = capsys.readouterr().err
            assert f"argument {option}: " in said
            assert "whole number" in said or "is not between 0 and 4294967295" in said


@pytest.mark.parametrize("command", ["interpret", "export"])
def test_another_tasks_environment_is_refused_in_one_line(
    command: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    more = ["--format", "numpy", "--output", str(tmp_path / "p.py"), "--check", "5"] if command == "export" else []
    main = import_module(COMMANDS[command].module).main
    assert main(["pretrained:Pendulum", "--env", "UR5Reacher", *more]) == 2
    said = capsys.readouterr().err
    assert said.count("\n") == 1
    assert "agent and environment do not fit: the agent's observation_space is" in said


def test_evaluations_by_hand_repeat_no_training_episode() -> None:
    """Neither where episodes of training begin, nor those of its evaluations."""
    seed = evaluate.build_parser().parse_args(["pretrained:Pendulum"]).seed
    taken = [first(run) for run in range(1000) for first in (evaluation_seed, final_seed)] + list(range(1000))
    assert min(abs(seed - other) for other in taken) > 1_000_000


BAD = [["--n-timesteps", "0"], ["--n-timesteps", "1.5"], ["--nonsense"]]
BAD += [["--checkpoint-minutes", minutes] for minutes in ("nan", "-1", "soon")]  # nan never came, so nothing was saved


@pytest.mark.parametrize("arguments", BAD)
def test_bad_arguments(arguments: list[str], capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(SystemExit) as stop:
        train.main(arguments)
    assert stop.value.code == 2
    assert said(capsys).startswith("sb3_tbc.train: error: ")


def test_names_of_files_are_refused_before_the_work(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert evaluate.main(["pretrained:Pendulum", "--video", str(tmp_path / "film.gif")]) == 2
    captured = capsys.readouterr()
    assert "must end in .mp4" in captured.err
    assert captured.out == ""
    export = import_module(COMMANDS["export"].module).main
    for kind, name, suffix in (("c", "policy", ".c"), ("numpy", "policy", ".py"), ("onnx", "policy.c", ".onnx")):
        assert export(["pretrained:Pendulum", "--format", kind, "--output", str(tmp_path / name)]) == 2
        assert f"--format {kind} writes a file that ends in {suffix}, got --output" in said(capsys)
    assert list(tmp_path.iterdir()) == []


BROKEN = [("", "an empty text names no file"), ("-", "no name of a file"), (".", "it is a folder"),
          ("file/out.json", "file is a file where a folder is needed")]  # fmt: skip


@pytest.mark.parametrize(("name", "why"), BROKEN)
@pytest.mark.parametrize("command", [["interpret", "pretrained:Pendulum"], ["benchmark", "parameters"]])
def test_outputs_that_cannot_be_written_are_refused_before_the_work(
    command: list[str], name: str, why: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: Any
) -> None:
    monkeypatch.chdir(tmp_path)
    (tmp_path / "file").touch()
    with pytest.raises(SystemExit) as stop:
        import_module(COMMANDS[command[0]].module).main([*command[1:], "--json", name])
    assert stop.value.code == 2
    assert why in said(capsys)


def test_paths_begin_at_home_and_can_be_looked_at(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("HOME", str(tmp_path))
    assert output_file("~/new/out.json") == tmp_path / "new" / "out.json"
    assert list(tmp_path.iterdir()) == []
    with pytest.raises(argparse.ArgumentTypeError, match=r"cannot use xxx.*too long"):
        given_path("x" * 300)


@pytest.mark.parametrize(
    ("command", "what"),
    [
        (["train", "--num-threads", "1e8"], "1024 threads"),
        (["train", "--n-envs", "1e12"], "4096 environments"),
        (["train", "--n-timesteps", "1e15"], "1000000000000 steps"),
        (["tune", "--workers", "1e9"], "1024 processes"),
        (["tune", "--n-envs", "4097"], "4096 environments"),
        (["reproduce", "--seeds", "1e9"], "10000 seeds"),
    ],
)
def test_numbers_that_no_machine_can_serve_are_refused(command: list[str], what: str, capsys: Any) -> None:
    with pytest.raises(SystemExit) as stop:
        import_module(COMMANDS[command[0]].module).main(command[1:])
    assert stop.value.code == 2
    assert f"{command[2]!r} is more than {what}" in said(capsys)


def test_a_place_without_permission_is_one_line(capsys: pytest.CaptureFixture[str]) -> None:
    def refused(argv: object) -> int:
        raise PermissionError(13, "Permission denied", "/there/config.yml")

    assert run_command(refused, "sb3_tbc.train", []) == 2
    assert "error: no permission for /there/config.yml; is it yours, or open to you?" in said(capsys)


def test_what_to_type_next_names_this_python(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(sys, "executable", str(tmp_path / ".venv" / "bin" / "python"))
    assert python() == ".venv/bin/python"  # as make train installs it, where no environment is active
    monkeypatch.setattr(sys, "executable", str(tmp_path / "my clone" / "python"))
    assert python() == "'my clone/python'"
    monkeypatch.setattr(sys, "executable", "/usr/bin/python3")
    assert python() == "python"


def test_flat_sac_without_a_time_limit(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """It never learnt, its evaluation never ended, and no signal stopped it."""
    import gymnasium as gym
    from corridor import Corridor

    class Endless(Corridor):
        def __init__(self) -> None:
            super().__init__()
            self.max_episode_steps = None  # type: ignore[assignment]

    if "EndlessGoal-v0" not in gym.registry:
        gym.register("EndlessGoal-v0", Endless, disable_env_checker=True)
    asked = ["--env", "EndlessGoal-v0", "--algo", "sac", "--n-timesteps", "100", "--log-folder", str(tmp_path)]
    capsys.readouterr()  # a notice of Gymnasium-Robotics
    assert train.main(asked) == 2
    assert "have no time limit" in said(capsys)
    assert list(tmp_path.iterdir()) == []


def test_an_action_space_that_is_no_box(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    import gymnasium as gym
    from gymnasium import spaces

    class Switch(gym.Env[Any, Any]):
        observation_space = spaces.Dict(
            {k: spaces.Box(-1, 1, (1,)) for k in ("observation", "achieved_goal", "desired_goal")}
        )
        action_space = spaces.Discrete(2)

    if "SwitchGoal-v0" not in gym.registry:
        gym.register("SwitchGoal-v0", Switch, disable_env_checker=True)
    assert train.main(["--env", "SwitchGoal-v0", "--log-folder", str(tmp_path)]) == 2
    assert "its actions must be a Box action space" in said(capsys)
    assert list(tmp_path.iterdir()) == []


def test_console_script(capsys: pytest.CaptureFixture[str]) -> None:
    assert __main__.main(["--help"]) == 0
    assert "evaluate" in capsys.readouterr().out
    assert __main__.main(["evalute"]) == 2
    assert "did you mean 'evaluate'?" in said(capsys)
    assert __main__.main(["train", "--env", "Pendulm"]) == 2
    assert "did you mean 'Pendulum'?" in said(capsys)


def test_exit_status_of_the_process() -> None:
    done = subprocess.run(
        [sys.executable, "-m", "sb3_tbc", "train", "--env", "Pendulm"], capture_output=True, text=True, timeout=120
    )
    assert done.returncode == 2
    assert done.stdout == ""
    assert done.stderr.count("\n") == 1


def test_seeds_share_no_evaluation_episode() -> None:
    from sb3_tbc.zoo.runner import evaluation_seed, final_seed

    streams = [final_seed(seed) + env for seed in range(200) for env in range(10)]
    streams += [evaluation_seed(seed) + 1000 * k + env for seed in range(200) for k in range(200) for env in range(10)]
    assert len(set(streams)) == len(streams)
    assert min(streams) >= 0
    assert max(map(final_seed, (0, 10**9))) < 2**32
    assert final_seed(0) == 2_000_000  # as in the committed ledger
