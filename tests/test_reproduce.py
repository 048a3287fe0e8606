"""The campaign: what it runs, what it leaves alone, how it goes on."""

from __future__ import annotations

from pathlib import Path

import pytest

from sb3_tbc import reproduce
from sb3_tbc.campaign.jobs import Job
from sb3_tbc.zoo.ledger import LEDGER_FILES, RunFolder

TINY = [
    "--hyperparams",
    "compile:false",
    "gradient_ratio:0.02",
    "low.batch_size:8",
    "high.batch_size:4",
    "max_options:3",
]


def campaign(tmp_path: Path, *more: str) -> list[str]:
    folders = ["--log-folder", str(tmp_path / "runs"), "--ledger", str(tmp_path / "results")]
    usual = {"--tasks": ["Pendulum"], "--algos": ["hits", "tbc-hrl"]}
    kept = [word for option, values in usual.items() if option not in more for word in (option, *values)]
    return [*kept, "--seeds", "2", *folders, *more]


def test_every_first_seed_comes_before_any_second(tmp_path: Path) -> None:
    order = [(job.seed, job.algo) for job in reproduce.jobs(campaign(tmp_path))]
    assert order == [(0, "hits"), (0, "tbc-hrl"), (1, "hits"), (1, "tbc-hrl")]


def test_a_run_that_is_named_twice_is_planned_once(tmp_path: Path) -> None:
    twice = campaign(tmp_path, "--tasks", "Pendulum", "pendulum", "--algos", "hits", "HiTS", "--seeds", "2")
    assert [(job.env, job.seed) for job in reproduce.jobs(twice)] == [("Pendulum", 0), ("Pendulum", 1)]


def test_ablations_have_folders_of_their_own(tmp_path: Path) -> None:
    job = next(iter(reproduce.jobs(campaign(tmp_path, "--algos", "tbc-hrl", "--ablation", "no-ts"))))
    assert job.target.path.parent.name == "no-ts"
    assert "--ablation no-ts" in " ".join(job.command())
    job = next(iter(reproduce.jobs(campaign(tmp_path, "--algos", "tbc-hrl", "--ablation", "no-ts", *TINY))))
    assert job.variant == "no-ts-custom"
    assert "--variant no-ts-custom" in " ".join(job.command())


def test_all_ablations_in_one_command(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    planned = list(reproduce.jobs(campaign(tmp_path, "--algos", "tbc-hrl", "--ablations", "--seeds", "1")))
    names = [job.target.path.parent.name for job in planned]
    assert len(set(names)) == len(names) == 12
    assert {"no-ts", "with-memory", "with-early-end", "no-smdp", "no-hindsight-cuts"} <= set(names)
    for job, name in zip(planned, names, strict=True):
        assert f"--ablation {name}" in " ".join(job.command())
    assert reproduce.main(campaign(tmp_path, "--ablations")) == 2
    assert "only tbc-hrl has ablations" in capsys.readouterr().err
    assert reproduce.main(campaign(tmp_path, "--ablations", "--variant", "mine")) == 2
    assert "leave --ablation and --variant out" in capsys.readouterr().err


def test_finished_runs_are_not_repeated(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    keep_result(next(iter(reproduce.jobs(campaign(tmp_path)))))
    assert reproduce.main(campaign(tmp_path, "--dry-run")) == 0
    out = capsys.readouterr().out
    assert "4 runs, 1 of them in" in out
    assert "hits full seed 0" not in out
    assert "hits full seed 1" in out


def keep_result(job: Job) -> None:
    job.target.start(reproduce.wanted_run(job).to_dict(), "x")
    job.target.finish({"success_rate": 1.0})


@pytest.mark.parametrize(
    ("asked", "told"),
    [
        (["--n-timesteps", "1000"], "n_timesteps is 200000 there, not 1000"),
        (["--n-eval-episodes", "3"], "n_eval_episodes is 20 there, not 3"),
        (["--variant", "full", "--hyperparams", "low.gamma:0.5"], "model.low.gamma is 0.99 there, not 0.5"),
    ],
)
def test_a_run_of_the_ledger_with_other_settings_is_not_done(
    asked: list[str], told: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    first, second, *_ = reproduce.jobs(campaign(tmp_path))
    keep_result(first)
    keep_result(second)
    assert reproduce.main(campaign(tmp_path, *asked)) == 2
    said = capsys.readouterr()
    other = f"{first.target.path} holds another run: {told}; ask for that run with the same options"
    assert other in said.err
    assert "(1 more of this kind; --dry-run lists them)" in said.err
    assert said.out == ""
    assert reproduce.main(campaign(tmp_path, *asked, "--dry-run")) == 0  # lists all, plans the rest
    lines = capsys.readouterr().out.splitlines()
    assert lines[0].endswith("results, 2 there are not the runs asked for, 2 to do")
    named = [f"refused Pendulum {job.algo} {job.variant} seed 0   " for job in (first, second)]
    named += [f"to do   Pendulum {job.algo} {job.variant} seed 1   " for job in (first, second)]
    assert all(line.startswith(name) for line, name in zip(lines[1:5], named, strict=True))
    assert other in lines[1]
    assert lines[-1] == "without --dry-run nothing begins before the 2 refused runs are dealt with"
    assert not (tmp_path / "runs").exists()


def test_half_a_result_in_the_ledger_is_not_done(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    first = next(iter(reproduce.jobs(campaign(tmp_path))))
    keep_result(first)
    (first.target.path / "final.json").write_text('{"success')
    assert reproduce.main(campaign(tmp_path)) == 2
    assert "final.json: it is no JSON" in capsys.readouterr().err
    assert reproduce.main(campaign(tmp_path, "--dry-run")) == 0
    said = capsys.readouterr().out
    assert "refused Pendulum hits full seed 0" in said
    assert "final.json: it is no JSON" in said
    assert "3 runs, hours unknown" in said


def test_an_interrupted_run_is_resumed(tmp_path: Path) -> None:
    job = next(iter(reproduce.jobs(campaign(tmp_path))))
    assert "--overwrite" in job.command()
    job.folder.start({}, "x")
    assert "--overwrite" in job.command()
    job.folder.checkpoint.mkdir()
    (job.folder.checkpoint / "state.json").write_text("{}")
    assert job.command()[-2:] == ["--resume", str(job.folder.path)]


def test_mistakes_are_told_before_anything_runs(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert reproduce.main([*campaign(tmp_path), "--tasks", "Pendulum", "UR5"]) == 2
    assert "unknown environment 'UR5'" in capsys.readouterr().err
    assert reproduce.main([*campaign(tmp_path), "--hyperparams", "low.gama:1"]) == 2
    assert "did you mean 'gamma'" in capsys.readouterr().err
    assert list(tmp_path.iterdir()) == []


def test_a_run_that_others_stop_is_no_success(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    class Stopped:
        def start(self, job: object) -> Stopped:
            return self

        def poll(self) -> int:
            return 130

        def stop(self) -> None:
            pass

        def close(self) -> None:
            pass

    monkeypatch.setattr(reproduce, "make_executor", lambda args: Stopped())
    assert reproduce.main(campaign(tmp_path, "--algos", "hits", "--workers", "2")) == 1
    said = capsys.readouterr()
    assert said.out.count("stopped Pendulum hits full seed ") == 2
    assert said.err == "2 of 2 runs were stopped from outside; the same command continues them\n"
    assert not (tmp_path / "results").exists()


def test_the_run_that_is_wanted_is_the_one_that_the_command_makes(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    small = ["--n-timesteps", "300", "--eval-freq", "100", "--n-final-episodes", "1", "--hyperparams", "max_options:3"]
    arguments = ["--algos", "tbc-hrl", "--ablation", "no-ts", "--seeds", "1", *small]
    (job,) = reproduce.jobs(campaign(tmp_path, *arguments))
    spec = reproduce.wanted_run(job)
    assert (spec.run.n_timesteps, spec.eval_freq, spec.n_final_episodes, spec.seed) == (300, 100, 1, 0)
    assert (spec.variant, spec.run.model["max_options"]) == (job.variant, 3)
    assert capsys.readouterr().out == ""
    job.folder.start(spec.to_dict(), "x")
    job.require(spec)


@pytest.mark.slow
def test_a_small_campaign_fills_the_ledger(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    small = ["--n-timesteps", "300", "--eval-freq", "300", "--n-final-episodes", "1", *TINY]
    arguments = campaign(tmp_path, "--seeds", "1", *small)
    assert reproduce.main(arguments) == 0
    for algo in ("hits", "tbc-hrl"):
        folder = RunFolder.for_run(tmp_path / "results", "Pendulum", algo, "custom", 0)
        assert sorted(p.name for p in folder.path.iterdir()) == sorted(LEDGER_FILES)
    assert reproduce.main(arguments) == 0
    assert "0 to do" in capsys.readouterr().out
