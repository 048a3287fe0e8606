"""The search command on a corridor that trains in a second: first trials, resuming, retrying, best trial, mistakes."""

from __future__ import annotations

import csv
import os
import shlex
import signal
import subprocess
import sys
import threading
from dataclasses import asdict, replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import optuna
import pytest
import yaml
from checks import said
from optuna.trial import TrialState

from sb3_tbc import train
from sb3_tbc.stopping import StopRequest
from sb3_tbc.tbc_hrl.level_config import CircuitConfig
from sb3_tbc.tune import command as tune
from sb3_tbc.tune import study as studies
from sb3_tbc.tune import trial as trials
from sb3_tbc.tune import worker
from sb3_tbc.tune.results import difference, find_trial, write_trial
from sb3_tbc.tune.study import ORIGIN, REASON, open_storage, read_settings
from sb3_tbc.zoo.callbacks import SuccessEvalCallback
from sb3_tbc.zoo.config import load_config
from sb3_tbc.zoo.ledger import RunFolder

ENV = "tuned_corridor:TunedCorridor-v0"
TINY = [
    "--hyperparams",
    "compile:false",
    "gradient_ratio:0.05",
    "low.batch_size:16",
    "low.buffer_size:2000",
    "high.buffer_size:500",
]
SHORT = ["--n-timesteps", "200", "--eval-freq", "100", "--n-eval-episodes", "2", "--n-final-episodes", "2"]
NAME = "tbc-hrl-TunedCorridor-v0"


def arguments(folder: Path, *more: str) -> list[str]:
    return ["--env", ENV, "--log-folder", str(folder), *more]


def load(folder: Path, grace: int = 60) -> optuna.Study:
    return optuna.load_study(study_name=NAME, storage=open_storage(str(folder / NAME / "journal.log"), grace))


@pytest.fixture(scope="module")
def searched(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder with a finished search of three trials."""
    folder = tmp_path_factory.mktemp("tune")
    assert tune.main(arguments(folder, "--n-trials", "3", *SHORT, *TINY)) == 0
    return folder


def test_first_trial_is_the_configuration_without_search(searched: Path) -> None:
    study = load(searched)
    assert [t.state for t in study.trials] == [TrialState.COMPLETE] * 3
    assert [t.user_attrs.get(ORIGIN) for t in study.trials] == ["default", None, None]
    settings = read_settings(study)
    assert settings.config_of(study.trials[0]).model == settings.run.model
    assert study.trials[0].params["tau"] == settings.run.model.get("tau", 0.0125)
    assert "max_options" not in study.trials[0].params  # the task decides: auto
    for t in study.trials:
        assert set(t.user_attrs["seed_values"]) == {"0", "1"}
        assert t.value == pytest.approx(np.mean(list(t.user_attrs["seed_values"].values())))
        assert sorted(t.intermediate_values) == [1, 2, 4, 5]  # two evaluations for each of two seeds


def test_the_paper_and_the_tuned_row_come_first(tmp_path: Path) -> None:
    args = tune.build_parser().parse_args(["--env", "Drawbridge", "--log-folder", str(tmp_path)])
    settings = tune.new_settings(args)
    assert list(settings.first_trials()) == ["paper", "tuned"]
    for name in ("paper", "tuned"):
        run, shipped = settings.baselines[name], load_config("tbc-hrl", "Drawbridge", name).to_dict()
        assert run["env_kwargs"] == shipped["env_kwargs"]
        written = difference(shipped["model"], run["model"])["low"]["policy_kwargs"].pop("ndbc")
        assert written.items() <= CircuitConfig().to_dict().items()  # the circuit is written out, with its defaults
        assert written["sub_steps"] == 3
    assert settings.base == settings.baselines["tuned"]
    assert settings.first_trials()["paper"]["tau"] == 0.346
    assert settings.first_trials()["tuned"]["learning_rate_schedule"] == "linear"


@pytest.mark.parametrize("config", [None, "paper"])
def test_an_unknown_task_begins_with_what_train_would_run(tmp_path: Path, config: str | None) -> None:
    given = ["--config", config] if config else []
    settings = tune.new_settings(tune.build_parser().parse_args(arguments(tmp_path, *given)))
    plain = load_config("tbc-hrl", "TunedCorridor-v0", config).model
    assert {key: settings.run.model[key] for key in plain if key != "low"} == {
        key: value for key, value in plain.items() if key != "low"
    }
    assert settings.run.model["memory"] == ("window" if config else "none")
    assert list(settings.first_trials()) == ["default"]


def test_what_is_left_behind(searched: Path) -> None:
    folder = searched / NAME
    with (folder / "trials.csv").open() as file:
        rows = list(csv.DictReader(file))
    assert [(r["number"], r["state"], r["origin"]) for r in rows[:2]] == [
        ("0", "COMPLETE", "default"),
        ("1", "COMPLETE", ""),
    ]
    assert (folder / "history.png").read_bytes().startswith(b"\x89PNG")
    assert (folder / "trial_0002" / "seed_1" / "model.zip").is_file()  # the policies of trials are kept
    assert not list(folder.rglob("checkpoint*"))


def test_the_printed_command_trains_the_best_trial_again(
    searched: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert yaml.safe_load((searched / NAME / "best.yml").read_text())["TunedCorridor-v0"]["n_timesteps"] == 200
    assert tune.main(arguments(searched, "--n-trials", "3")) == 0
    (line,) = (line for line in capsys.readouterr().out.splitlines() if line.startswith("its curve"))
    command = shlex.split(line.partition("sb3_tbc.train")[2])
    assert train.main([*command, "--log-folder", str(tmp_path), "--no-progress"]) == 0
    again = RunFolder(tmp_path / "TunedCorridor-v0" / "tbc-hrl" / "best" / "seed_0")
    first = RunFolder(searched / NAME / f"trial_{load(searched).best_trial.number:04d}" / "seed_0")
    rows, wanted = ([row._replace(wall_time=0) for row in run.read_evaluations()] for run in (again, first))
    assert rows == wanted
    assert rows
    for figure in ("success_rate", "n_episodes", "eval_seed"):  # what the objective `success` is made of
        assert again.read_final()[figure] == first.read_final()[figure]


@pytest.mark.parametrize("which", ["0", "1", "best"])
def test_train_from_a_trial(searched: Path, which: str, capsys: pytest.CaptureFixture[str]) -> None:
    more = ["--seed", "1"] if which == "0" else []
    own = ["--n-timesteps", "100", "--eval-freq", "50", "--n-eval-episodes", "1", "--n-final-episodes", "3"]
    assert tune.main(arguments(searched, "--trial", which, "--overwrite", *own, *more)) == 0
    assert ("seed 1 is one of those on which the trials were chosen" in capsys.readouterr().out) == bool(more)
    seed = 1 if more else 2  # by default one on which nothing was chosen
    study = load(searched)
    number = find_trial(study, which).number
    runs = list((searched / NAME / "train").glob(f"*/tbc-hrl/trial_{number:04d}/seed_{seed}/config.yml"))
    assert len(runs) == 1
    made = yaml.safe_load(runs[0].read_text())
    assert [str(made[name[2:].replace("-", "_")]) for name in own[::2]] == own[1::2]
    assert made["model"] == read_settings(study).config_of(study.trials[number]).model
    assert tune.main(arguments(searched, "--trial", which, *own, *more)) == 2  # a second time
    assert "nothing was changed: use --overwrite or another --seed" in capsys.readouterr().err


def test_resuming_needs_no_options_and_counts_what_is_done(searched: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert tune.main(arguments(searched, "--n-trials", "3")) == 0
    assert "(3 of 3 trials done)" in capsys.readouterr().out
    assert len(load(searched).trials) == 3
    assert tune.main(arguments(searched, "--n-trials", "4", "--sampler", "random", "--pruner", "none")) == 0
    assert "worker 0: trial 3, seed 0: " in capsys.readouterr().out
    study = load(searched)
    assert len(study.trials) == 4
    assert len(study.trials[3].user_attrs["seed_values"]) == 2


@pytest.mark.parametrize(
    ("more", "message"),
    [
        (["--algo", "hits", "--study-name", NAME], "is of another algorithm: --algo is tbc-hrl there, not hits"),
        (["--env", "Pendulum", "--study-name", NAME], "--env is TunedCorridor-v0 there, not Pendulum"),
        (["--objective", "final"], "begun with other options: --objective is auc there, not final"),
        (["--n-seeds", "3"], "--n-seeds is 2 there, not 3"),
        (["--hyperparams", "low.tau:0.1"], "--hyperparams is ['compile:false'"),
        (["--trial", "best", "--algo", "hits", "--study-name", NAME], "--algo is tbc-hrl there, not hits"),
        (["--trial", "best", "--hyperparams", "low.gamma:0.5"], "--hyperparams is ['compile:false'"),
        (["--trial", "99"], "a trial's number (0 to"),
        (["--trial", "last"], "--trial must be 'best' or a trial's number"),
        (["--trial", "best", "--study-name", "other"], "no study 'other'"),
        (["--sampler", "tpee"], "unknown sampler 'tpee'; did you mean 'tpe'?"),
        (["--pruner", "medain"], "unknown pruner 'medain'; did you mean 'median'?"),
        (["--algo", "hit"], "unknown algorithm 'hit'"),
        (["--env", "Pendulm"], "unknown environment 'Pendulm'"),
    ],
)
def test_mistakes_on_an_existing_study(
    searched: Path, more: list[str], message: str, capsys: pytest.CaptureFixture[str]
) -> None:
    before = (searched / NAME / "journal.log").read_bytes()
    assert tune.main(arguments(searched, *more)) == 2
    assert message in said(capsys)
    assert (searched / NAME / "journal.log").read_bytes() == before


@pytest.mark.parametrize(
    ("more", "message"),
    [
        (["--storage", "nowhere/study.txt"], "storage must be a journal file ending in .log or .journal, or a URL"),
        (["--storage", "postgres//me:secret@host/db"], "storage must be a journal file"),
        (["--storage", "nosuchdb://me:secret@host/db"], "cannot open storage nosuchdb://me:***@host/db"),
        (["--storage", "nosuchdb://host/db?password=secret&x=1"], "nosuchdb://host/db?password=***&x=1"),
        (["--n-timesteps", "200", "--eval-freq", "300"], "--eval-freq must be at most the 200 steps of a run"),
        (["--seed", "3"], "--seed 3 belongs to --trial; a search takes its seeds from --first-seed"),
        (["--minutes", "0"], "--minutes must be above 0, got 0"),
        (["--minutes", "nan"], "--minutes must be above 0, got nan"),
        (["--storage", "sqlite:////no/such/folder/study.db"], "cannot open storage sqlite:////no/such/folder/study.db"),
        (["--storage", "/proc/study.log"], "cannot open storage /proc/study.log"),
        (["--hyperparams", "random_fraction:2"], "random_fraction must be a number from 0 to 1"),
        (["--search", "low.gama"], "matches no parameter"),
        (["--search-space", "nowhere.yml"], "cannot read nowhere.yml: there is no such file"),
        (["--threshold", "0"], "--threshold is a success rate"),
        (["--trial", "best"], "no study"),
    ],
)
def test_mistakes_on_a_new_study(
    tmp_path: Path, more: list[str], message: str, capsys: pytest.CaptureFixture[str]
) -> None:
    assert tune.main(arguments(tmp_path, *more)) == 2
    error = said(capsys)
    assert message in error
    assert "secret" not in error
    assert not list(tmp_path.rglob("journal.log*"))


# --------------------------------------------------------------------------------------------- what goes wrong


def quick(monkeypatch: pytest.MonkeyPatch, outcome: Any) -> list[int]:
    """Replace training by ``outcome(spec, folder, after_eval)``; returns the seeds trained, in order."""
    seeds: list[int] = []

    def start(spec: Any, folder: Any, command: str, options: Any, overwrite: bool, after_eval: Any) -> Any:
        seeds.append(spec.seed)
        return outcome(spec, folder, after_eval) or {"success_rate": 0.5}

    monkeypatch.setattr(trials, "start_run", start)
    return seeds


def test_a_run_that_is_not_finite_is_pruned_with_its_reason(tmp_path: Path) -> None:
    space = tmp_path / "space.yml"
    space.write_text("default: {low.learning_rate: {low: 1.0e+37, high: 2.0e+37}}\n")
    more = ["--n-trials", "2", "--search", "low.learning_rate", "--search-space", str(space)]
    assert tune.main(arguments(tmp_path, *more, *SHORT, *TINY)) == 0
    study = load(tmp_path)
    assert [t.state for t in study.trials] == [TrialState.COMPLETE, TrialState.PRUNED]
    assert study.trials[1].user_attrs[REASON].startswith("not finite: low.")
    assert "not finite: low." in (tmp_path / NAME / "trials.csv").read_text()
    assert study.best_trial.number == 0


def test_a_diverging_run_is_pruned_with_its_reason() -> None:
    watch = trials.LossWatch(trials.DIVERGED)
    watch.write({"low/critic_loss": 3.0, "low/q_mean": 1e9}, {}, 100)
    assert watch.reason == ""
    watch.write({"low/critic_loss": 2e6, "high/critic_loss": float("nan")}, {}, 1200)
    assert watch.reason == "diverging: low/critic_loss is 2e+06 at step 1,200"
    callback = trials.ReportCallback(lambda rows: None)
    callback.watch = watch
    callback.parent = object.__new__(SuccessEvalCallback)
    with pytest.raises(optuna.TrialPruned, match="diverging: low/critic_loss"):
        callback._on_step()


def test_a_stopped_trial_goes_back_into_the_queue(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    def stop_in_the_second_seed(spec: Any, folder: Any, after_eval: Any) -> None:
        if spec.seed == 1 and not stopped:
            stopped.append(True)
            raise trials.Interrupted("stopped at 100 of 200 steps", folder.path)

    stopped: list[bool] = []
    seeds = quick(monkeypatch, stop_in_the_second_seed)
    assert tune.main(arguments(tmp_path, "--n-trials", "2", *SHORT, *TINY)) == 130
    assert "the same command continues" in capsys.readouterr().err
    states = [t.state for t in load(tmp_path).trials]
    assert states == [TrialState.FAIL, TrialState.WAITING]
    assert tune.main(arguments(tmp_path, "--n-trials", "2")) == 0
    study = load(tmp_path)
    assert [t.state for t in study.trials] == [TrialState.FAIL, TrialState.COMPLETE, TrialState.COMPLETE]
    assert study.trials[1].user_attrs[ORIGIN] == "default"
    assert study.trials[1].params == study.trials[0].params
    assert seeds == [0, 1, 1, 0, 1]  # the finished seed of the stopped trial is not trained twice


def test_a_trial_that_raised_an_error_is_run_again(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    def fail_once(spec: Any, folder: Any, after_eval: Any) -> None:
        if spec.variant == "trial_0" and spec.seed == 1:
            raise KeyError("a bug")

    seeds = quick(monkeypatch, fail_once)
    with pytest.raises(KeyError):
        tune.main(arguments(tmp_path, "--n-trials", "2", *SHORT, *TINY))
    assert "trial 0 failed: KeyError: 'a bug'; it is back in the queue" in capsys.readouterr().out
    assert [t.state for t in load(tmp_path).trials] == [TrialState.FAIL, TrialState.WAITING]
    assert tune.main(arguments(tmp_path, "--n-trials", "2")) == 0
    study = load(tmp_path)
    assert [t.state for t in study.trials] == [TrialState.FAIL, TrialState.COMPLETE, TrialState.COMPLETE]
    assert [t.user_attrs.get(ORIGIN) for t in study.trials] == ["default", "default", None]
    assert study.trials[1].params == study.trials[0].params
    assert seeds == [0, 1, 1, 0, 1]


def test_a_trial_that_always_raises_an_error_is_given_up(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    def fail(spec: Any, folder: Any, after_eval: Any) -> None:
        if spec.variant != "trial_0":
            raise ValueError("no such thing")  # no answer of the storage, although its type is the same

    quick(monkeypatch, fail)
    for _ in range(1 + studies.MAX_RETRIES):
        with pytest.raises(ValueError, match="no such thing"):
            tune.main(arguments(tmp_path, "--n-trials", "2", *SHORT, *TINY))
    assert "this was retry 3, so it is not run again" in capsys.readouterr().out.splitlines()[-1]
    states = [t.state for t in load(tmp_path).trials]
    assert states == [TrialState.COMPLETE] + (1 + studies.MAX_RETRIES) * [TrialState.FAIL]


def test_only_a_killed_workers_trial_is_announced_by_the_command(capsys: pytest.CaptureFixture[str]) -> None:
    codes = {"worker 0": -9, "worker 1": 1}
    ended: Any = [SimpleNamespace(name=name, exitcode=code, is_alive=lambda: False) for name, code in codes.items()]
    worker._watch(ended, StopRequest())
    assert capsys.readouterr().err.splitlines() == [
        "worker 0 ended with signal 9; its trial will be run again by another",
        "worker 1 ended with exit status 1",
    ]


def test_a_dead_workers_trial_is_run_again_and_counted_once(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    quick(monkeypatch, lambda spec, folder, after_eval: None)
    assert tune.main(arguments(tmp_path, "--n-trials", "1", *SHORT, *TINY)) == 0
    study = load(tmp_path)
    dead = study.ask()  # a worker takes a trial, writes a heartbeat, and is killed
    dead.suggest_float("tau", 5e-5, 0.5, log=True)
    study._storage.record_heartbeat(dead._trial_id)  # type: ignore[attr-defined]
    sign = tmp_path / NAME / "journal.log.alive" / f"trial_{dead._trial_id}"
    studies.retire_stale(study)
    assert study.trials[1].state == TrialState.RUNNING  # it still lives, as far as one can see
    os.utime(sign, (1, 1))
    assert tune.main(arguments(tmp_path, "--n-trials", "3")) == 0
    study = load(tmp_path)
    assert [t.state for t in study.trials] == [TrialState.COMPLETE, TrialState.FAIL] + 2 * [TrialState.COMPLETE]
    assert study.trials[2].params["tau"] == study.trials[1].params["tau"]
    assert study.trials[2].system_attrs["retry_history"] == [1]
    assert studies.count_done(study) == 3


def test_a_worker_thought_dead_does_not_count_twice(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    def declared_dead(spec: Any, folder: Any, after_eval: Any) -> None:
        study = load(tmp_path)
        if len(study.trials) == 1:
            (tmp_path / NAME / "journal.log.alive").joinpath(f"trial_{study.trials[0]._trial_id}").unlink()
            study._storage._grace = -1  # type: ignore[attr-defined]
            studies.retire_stale(study)

    quick(monkeypatch, declared_dead)
    assert tune.main(arguments(tmp_path, "--n-trials", "2", *SHORT, *TINY)) == 0
    assert "trial 0 is dropped here: another worker has it" in capsys.readouterr().out
    states = [t.state for t in load(tmp_path).trials]
    assert states == [TrialState.FAIL, TrialState.COMPLETE, TrialState.COMPLETE]


def test_a_trial_too_many_is_dropped(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    quick(monkeypatch, lambda spec, folder, after_eval: None)
    assert tune.main(arguments(tmp_path, "--n-trials", "2", *SHORT, *TINY)) == 0
    job = worker.Job(str(tmp_path / NAME / "journal.log"), NAME, tmp_path, 2, "random", "none", 0, "cpu", 60)
    study, runner = worker.load(job, 0, StopRequest())
    worker._one_trial(study, runner, 0)  # as if another had taken the last one in the same moment
    assert [t.state for t in study.trials] == [TrialState.COMPLETE, TrialState.COMPLETE, TrialState.FAIL]
    assert studies.count_done(study) == 2


def test_a_baseline_queued_twice_runs_once(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    seeds = quick(monkeypatch, lambda spec, folder, after_eval: None)

    def queue_twice(job: worker.Job, n: int, stop: StopRequest) -> int:
        study = load(tmp_path)
        (values,) = (t.system_attrs["fixed_params"] for t in study.trials)
        study.enqueue_trial(values, user_attrs={ORIGIN: "default"})  # as if two machines had begun the study at once
        return run_workers(job, n, stop)

    run_workers = worker.run_workers
    monkeypatch.setattr(worker, "run_workers", queue_twice)
    assert tune.main(arguments(tmp_path, "--n-trials", "2", *SHORT, *TINY)) == 0
    study = load(tmp_path)
    assert [t.state for t in study.trials] == [TrialState.COMPLETE, TrialState.FAIL, TrialState.COMPLETE]
    assert [t.user_attrs.get(ORIGIN) for t in study.trials] == ["default", "default", None]
    assert seeds == [0, 1, 0, 1]


def test_a_study_that_another_machine_is_just_creating_is_joined(tmp_path: Path) -> None:
    args = tune.build_parser().parse_args(arguments(tmp_path, *SHORT, *TINY))
    wanted, storage = tune.new_settings(args), open_storage(str(tmp_path / "study.log"))
    other = optuna.create_study(storage=storage, study_name="shared", direction="maximize")
    later = threading.Timer(0.5, other.set_user_attr, ("settings", asdict(wanted)))
    later.start()
    _, settings = studies.open_study(storage, "shared", "study.log", wanted, {})
    later.join()
    assert settings.run == wanted.run
    optuna.create_study(storage=storage, study_name="foreign", direction="maximize").ask()
    with pytest.raises(studies.ConfigError, match="was not made by this command"):
        studies.open_study(storage, "foreign", "study.log", wanted, {})


def test_ctrl_c_in_a_background_script_is_not_for_the_workers(monkeypatch: pytest.MonkeyPatch) -> None:
    handlers: list[Any] = []
    monkeypatch.setattr(worker, "work", lambda job, index, stop: handlers.append(signal.getsignal(signal.SIGINT)))
    before = {number: signal.getsignal(number) for number in (signal.SIGINT, signal.SIGTERM)}
    job = worker.Job("study.log", NAME, Path(), 1, "random", "none", 0, "cpu", 60)
    try:
        for inherited in (signal.SIG_IGN, signal.default_int_handler):
            signal.signal(signal.SIGINT, inherited)
            worker._main(job, 0)
    finally:
        for number, handler in before.items():
            signal.signal(number, handler)
    assert handlers[0] == signal.SIG_IGN
    assert handlers[1].__func__ is StopRequest.ask  # a flag, looked at between steps: nothing is interrupted


def test_a_refused_combination_is_pruned_not_fatal(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def refuse(spec: Any, folder: Any, after_eval: Any) -> None:
        if spec.variant == "trial_1":
            raise studies.ConfigError("no room")

    quick(monkeypatch, refuse)
    assert tune.main(arguments(tmp_path, "--n-trials", "2", *SHORT, *TINY)) == 0
    assert load(tmp_path).trials[1].user_attrs[REASON] == "refused: no room"


def test_a_text_that_looks_like_a_number_stays_one_in_a_trials_file(tmp_path: Path) -> None:
    settings = tune.new_settings(tune.build_parser().parse_args(arguments(tmp_path, *SHORT, *TINY)))
    run = {**settings.base, "env_kwargs": {"map": "3e-4"}}
    trial = optuna.create_trial(value=0.0, user_attrs={ORIGIN: "default"})
    path = write_trial(replace(settings, baselines={"default": run}), trial, "study", tmp_path / "best.yml")
    assert load_config("tbc-hrl", "TunedCorridor-v0", path=path).env_kwargs == {"map": "3e-4"}


def test_help_needs_no_optuna() -> None:
    code = "import sys, sb3_tbc.tune; print('optuna' in sys.modules)"
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, timeout=120)
    assert done.stdout.strip() == "False", done.stderr
