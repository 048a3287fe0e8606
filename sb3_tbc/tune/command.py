"""``python -m sb3_tbc.tune``: search settings for a task, several seeds per trial, resumable, on several processes."""

from __future__ import annotations

import argparse
import math
import shlex
import sys
import time
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING

import torch as th

from sb3_tbc.aliases import Plain, PlainMapping
from sb3_tbc.commands import (
    INTERRUPTED,
    Parser,
    Several,
    env_count,
    given_path,
    positive_int,
    process_count,
    python,
    run_command,
    seed_count,
    seed_number,
    step_count,
)
from sb3_tbc.errors import ConfigError
from sb3_tbc.extras import require
from sb3_tbc.outside import flat_name, folder_name
from sb3_tbc.settings import merge
from sb3_tbc.stopping import stop_request
from sb3_tbc.tbc_hrl import TBCHRL
from sb3_tbc.tune.objectives import ACROSS, OBJECTIVES
from sb3_tbc.tune.search_space import complete, load_space, restrict
from sb3_tbc.zoo.algorithms import algorithm, build_model
from sb3_tbc.zoo.config import CONFIGS, RunConfig, config_file, load_config, parse_overrides, read_file
from sb3_tbc.zoo.environments import make_envs, resolve_env
from sb3_tbc.zoo.ledger import RunFolder

if TYPE_CHECKING:
    from optuna.study import Study

    from sb3_tbc.tune.study import StudySettings

ASKED = (
    *("config", "config_file", "search_space", "search", "hyperparams", "n_timesteps", "n_envs", "n_seeds"),
    *("first_seed", "objective", "across_seeds", "threshold", "eval_freq", "n_eval_episodes", "n_final_episodes"),
)
"""Options that determine what is compared. They are stored with a study; other values are refused later."""
TRAINING = ("n_timesteps", "eval_freq", "n_eval_episodes", "n_final_episodes")
"""Those of them that training on a trial's settings may have of its own."""
DEFAULTS: Plain = {
    "n_seeds": 2,
    "first_seed": 0,
    "objective": "auc",
    "across_seeds": "mean",
    "threshold": 0.9,
    "n_eval_episodes": 20,
    "n_final_episodes": 20,
}


EXAMPLES = {
    "sb3_tbc.tune --env Pendulum --workers 2": "30 trials of two seeds each, on two processes",
    "sb3_tbc.tune --env Pendulum --search 'low.*' --n-timesteps 50000": "search the low level's settings, short runs",
    "sb3_tbc.tune --env Pendulum --trial best --seed 100": "train on the best trial's settings with a fresh seed",
}


def build_parser() -> Parser:
    """The command's arguments."""
    parser = Parser("sb3_tbc.tune", EXAMPLES, description=__doc__)
    add = parser.add_argument
    add("--algo", default="tbc-hrl", help="tbc-hrl, hits, hac or sac")
    add("--env", default="Pendulum", help="a task's name or the id of any registered goal environment")
    add("--study-name", help="an existing study is continued; by default <algo>-<task>")
    add("--n-trials", type=positive_int, default=30, help="trials of the whole study, earlier ones included")
    add("--workers", type=process_count, default=1, help="processes on this machine")
    add("--storage", help="journal file (*.log) or any Optuna URL; by default <log-folder>/<study>/journal.log")
    add("--sampler", default="tpe", help="tpe, random, or another of optuna.samplers")
    add("--sampler-seed", type=seed_number, default=0, help="seed of the sampler")
    add("--pruner", default="median+wilcoxon", help="median, hyperband, halving, wilcoxon, none, or two joined by +")
    add(
        "--minutes",
        type=float,
        default=math.inf,
        help="begin no trial after this many minutes; by default there is no limit",
    )
    add("--grace-seconds", type=positive_int, default=120, help="a worker that has written nothing for this many "
        "seconds counts as dead, and its trial is started again")  # fmt: skip
    add("--log-folder", type=given_path, default=Path("runs/tune"), help="runs go to <folder>/<study>/trial_N/seed_S")
    add("--device", default="cpu", help="torch device")
    add("--trial", metavar="best|N", help="do not search: train on this trial's settings with --seed")
    add(
        "--seed",
        type=seed_number,
        help="with --trial: seed of the training; by default the first after those of the search",
    )
    add("--overwrite", action="store_true", help="with --trial: replace an earlier run of that trial and seed")
    same = parser.add_argument_group(
        "what all trials share", "fixed when a study begins; not needed when it is continued"
    )
    add = same.add_argument
    add("--n-seeds", type=seed_count, help="training runs per trial, one per seed (default: 2)")
    add(
        "--first-seed",
        type=seed_number,
        help="seed of a trial's first run; the next runs have the following seeds (default: 0)",
    )
    add("--objective", choices=list(OBJECTIVES), help="what makes a trial good (default: auc). "
        + "; ".join(f"{k}: {o.text}" for k, o in OBJECTIVES.items()))  # fmt: skip
    add(
        "--across-seeds",
        choices=list(ACROSS),
        help="how the values of the seeds are combined into the trial's (default: mean)",
    )
    add("--threshold", type=float, help="success rate that the objective steps-to-success waits for (default: 0.9)")
    add("--n-timesteps", type=step_count, help="environment steps per run; by default the task's")
    add("--n-envs", type=env_count, help="parallel environments; by default the configuration's")
    add("--eval-freq", type=positive_int, help="environment steps between evaluations; by default a fortieth of a run")
    add("--n-eval-episodes", type=positive_int, help="episodes of each evaluation (default: 20)")
    add("--n-final-episodes", type=positive_int, help="episodes of the evaluation after training (default: 20)")
    add("--config", choices=CONFIGS, help="values of all settings that are not searched; by default tuned, for tasks "
                       "that have them")  # fmt: skip
    add("--config-file", type=given_path, help="take these values from this file, with sections as in zoo_configs")
    add("--hyperparams", action=Several, metavar="NAME:VALUE", help="settings that keep this value in all trials")
    add("--search", action=Several, metavar="NAME", help="search only these parameters; * and ? are wildcards")
    add("--search-space", type=given_path, help="a file that changes ranges, see zoo_configs/search")
    return parser


# --------------------------------------------------------------------------------------------- a new study


def asked(args: argparse.Namespace) -> Plain:
    """Those of the given options that determine what is compared, as plain data."""
    given = {name: getattr(args, name) for name in ASKED if getattr(args, name) is not None}
    return {name: str(value) if isinstance(value, Path) else value for name, value in given.items()}


def new_settings(args: argparse.Namespace) -> StudySettings:
    """Settings shared by all trials of a new study.

    :raises ConfigError: for unknown names and wrong values, before anything is written
    """
    from sb3_tbc.tune.study import StudySettings

    task, env_id = resolve_env(args.env)
    fixed = parse_overrides(args.hyperparams or [])
    options = {name: getattr(args, name) if getattr(args, name) is not None else DEFAULTS[name] for name in DEFAULTS}
    if not 0 < options["threshold"] <= 1:
        raise ConfigError(f"--threshold is a success rate above 0 and at most 1, got {options['threshold']}")
    runs = baselines(args, task, env_id, fixed)
    wanted = args.config or next(reversed(runs))
    base = runs[wanted] if wanted in runs else next(iter(runs.values()))
    runs = {name: replace(run, n_timesteps=base.n_timesteps) for name, run in runs.items()}  # equal steps for all
    eval_freq = args.eval_freq or min(max(base.n_timesteps // 40, 100), base.n_timesteps)
    if eval_freq > base.n_timesteps:
        raise ConfigError(
            f"--eval-freq must be at most the {base.n_timesteps} steps of a run, got {eval_freq}: "
            "no evaluation would take place"
        )
    resolved = {"n_timesteps": base.n_timesteps, "n_envs": base.n_envs, "eval_freq": eval_freq}
    space = restrict(load_space(args.algo, task, args.search_space), base, args.search or [], fixed)
    return StudySettings(
        algo=args.algo,
        env=args.env,
        task=task,
        env_id=env_id,
        base=base.to_dict(),
        baselines={name: run.to_dict() for name, run in runs.items()},
        space=space,
        eval_freq=eval_freq,
        asked={**options, **resolved, **asked(args)},
        **options,
    )


def baselines(args: argparse.Namespace, task: str, env_id: str, fixed: Plain) -> dict[str, RunConfig]:
    """The configurations of the first trials: the paper's and the shipped tuned one, or that of ``train``.

    :raises ConfigError: if one of them cannot be built
    """
    known = task in read_file(args.config_file or config_file(args.algo))
    names: list[str | None] = list(CONFIGS) if known else [args.config]
    runs: dict[str, RunConfig] = {}
    for name in names:
        run = load_config(args.algo, task, name, fixed, path=args.config_file)
        run = replace(run, n_timesteps=args.n_timesteps or run.n_timesteps, n_envs=args.n_envs or run.n_envs)
        run = _checked(run, env_id)
        if not any(run.model == other.model and run.env_kwargs == other.env_kwargs for other in runs.values()):
            runs[name if known and name else "default"] = run
    return runs


def _checked(run: RunConfig, env_id: str) -> RunConfig:
    """Check a configuration by building its agent once with small buffers; return it with all settings of the circuit.

    :raises ConfigError: if the task or the agent refuses a setting
    """
    env = make_envs(env_id, 1, 0, run.env_kwargs)
    try:
        action_dim = int(math.prod(env.action_space.shape or (1,)))
        run = complete(run, action_dim)
        hierarchical = issubclass(algorithm(run.algo), TBCHRL)
        small: Plain = {"buffer_size": 1000}
        small = {level: small for level in ("low", "high")} if hierarchical else small
        build_model(replace(run, model=merge(run.model, small)), env, 0)
    finally:
        env.close()
    return run


# --------------------------------------------------------------------------------------------- the command


def open_command_study(args: argparse.Namespace) -> tuple[Study, StudySettings, str, Path]:
    """Open or create the study of a command; return it with its settings, its storage and its folder.

    :raises ConfigError: for a user's mistake
    """
    from sb3_tbc.tune import study as studies

    algorithm(args.algo)
    task, _ = resolve_env(args.env)
    studies.make_sampler(args.sampler, args.sampler_seed)
    name = folder_name(args.study_name or flat_name(f"{args.algo}-{task}", "the study's name"), "--study-name")
    folder = args.log_folder / name
    storage = args.storage or str(folder / "journal.log")
    given = {"algo": args.algo, "env": task, **asked(args)}
    if args.trial is not None:  # what training cannot change must be as it is in the search
        given = {name: value for name, value in given.items() if name not in TRAINING}
    fresh = studies.is_url(storage) or not Path(storage).is_file()
    wanted = new_settings(args) if fresh and args.trial is None else None  # mistakes are reported before a file is made
    if args.trial is not None and not studies.is_url(storage) and not Path(storage).is_file():
        raise ConfigError(f"no study {name!r}: there is no {storage}; search first, or name its --storage")
    opened = studies.open_storage(storage, args.grace_seconds)
    with studies.readable(storage):
        known = studies.names(opened)
    if wanted is None and args.trial is None and name not in known:
        wanted = new_settings(args)
    if args.trial is None:
        studies.claim_folder(folder, storage, name not in known)
    with studies.readable(storage):
        study, settings = studies.open_study(opened, name, studies.shown(storage), wanted, given)
    return study, settings, storage, folder


def command(argv: Sequence[str]) -> int:
    """Search, or train from a trial; see ``--help``."""
    args = build_parser().parse_args(argv)
    require("optuna", extra="tune", what="a search")
    args.algo = args.algo.lower()
    if not args.minutes > 0:
        raise ConfigError(f"--minutes must be above 0, got {args.minutes:g}")
    if args.seed is not None and args.trial is None:
        raise ConfigError(f"--seed {args.seed} belongs to --trial; a search takes its seeds from --first-seed")
    th.set_num_threads(1)
    from sb3_tbc.tune.pruning import make_pruner

    make_pruner(args.pruner, 1, 1)
    study, settings, storage, folder = open_command_study(args)
    if args.trial is not None:
        return train_from(args, study, settings, folder)
    return search(args, study, settings, storage, folder)


def search(args: argparse.Namespace, study: Study, settings: StudySettings, storage: str, folder: Path) -> int:
    """Run the workers and write the results."""
    from sb3_tbc.tune.study import count_done, shown, told_if_lost, try_sampler
    from sb3_tbc.tune.worker import Job, run_workers

    try_sampler(args.sampler, settings)
    runs = f"{settings.n_seeds} seeds of {settings.run.n_timesteps:,} steps each"
    print(f"study          {study.study_name}: {settings.algo} on {settings.task}, {settings.objective}, {runs}")
    print(f"storage        {shown(storage)}   ({count_done(study)} of {args.n_trials} trials done)")
    print(f"dashboard      pip install optuna-dashboard; optuna-dashboard {shlex.quote(shown(storage))}", flush=True)
    until = time.time() + 60.0 * args.minutes
    job = Job(storage, study.study_name, folder, args.n_trials, args.sampler, args.pruner, args.sampler_seed,
              args.device, args.grace_seconds, until)  # fmt: skip
    status = 0
    with told_if_lost(storage):
        try:
            with stop_request() as stop:
                status = run_workers(job, args.workers, stop)
        except KeyboardInterrupt:
            print("\nstopped; the same command continues", file=sys.stderr)
            status = INTERRUPTED
        summarise(study, settings, folder)
    return status


def summarise(study: Study, settings: StudySettings, folder: Path) -> None:
    """Write the table, the plots and the best trial's configuration, and print their paths."""
    from sb3_tbc.tune import results as reports
    from sb3_tbc.tune.study import ORIGIN

    reports.write_table(study, folder / "trials.csv")
    print(f"trials         {folder / 'trials.csv'}")
    for path in reports.write_plots(study, folder):
        print(f"plot           {path}")
    done = reports.complete_trials(study)
    if not done:
        print("best           (no complete trial yet)")
        return
    for trial in done:
        if trial.user_attrs.get(ORIGIN):
            print(f"{trial.user_attrs[ORIGIN]:<14} {settings.objective} {trial.value:.4g}   (trial {trial.number})")
    best = study.best_trial
    path = reports.write_trial(settings, best, study.study_name, folder / "best.yml")
    if len(done) > 1 and len({trial.value for trial in done}) == 1:
        print(f"note           all {len(done)} trials have the same value; a larger --n-timesteps may tell them apart")
    print(f"best           {settings.objective} {best.value:.4g}   (trial {best.number})")
    print(f"settings       {path}")
    episodes = {"n_final_episodes": settings.n_final_episodes}  # so that it ends in the trial's own value, too
    again = shlex.join(train_arguments(settings, path, settings.first_seed, episodes))
    print(f"its curve      {python()} -m sb3_tbc.train {again}")


def train_arguments(settings: StudySettings, path: Path, seed: int, own: PlainMapping) -> list[str]:
    """Arguments of the training command that trains on a trial's settings.

    :param own: those of :data:`TRAINING` that are not to be the search's
    """
    arguments = ["--algo", settings.algo, "--env", settings.env, "--config", str(path), "--seed", str(seed)]
    counts = {"eval_freq": settings.eval_freq, "n_eval_episodes": settings.n_eval_episodes, **own}
    for name, count in counts.items():
        arguments += [f"--{name.replace('_', '-')}", str(count)]
    return [*arguments, "--variant", path.stem]


def train_from(args: argparse.Namespace, study: Study, settings: StudySettings, folder: Path) -> int:
    """Write a trial's configuration and train on it."""
    from sb3_tbc import train
    from sb3_tbc.tune.results import find_trial, write_trial

    trial = find_trial(study, args.trial)
    path = write_trial(settings, trial, study.study_name, folder / f"trial_{trial.number:04d}.yml")
    print(f"settings       {path}   (trial {trial.number})", flush=True)
    seed = settings.seeds.stop if args.seed is None else args.seed
    if seed in settings.seeds:
        print(f"note           seed {seed} is one of those on which the trials were chosen; results on it are biased")
    root = folder / "train"
    run = RunFolder.for_run(root, settings.task, settings.algo, path.stem, seed)
    if run.exists and not args.overwrite:  # here, as training would name options of its own
        state = "finished" if run.finished else "unfinished"
        cure = "use --overwrite or another --seed" + ("" if run.finished else ", or continue it with: ")
        cure += "" if run.finished else f"{python()} -m sb3_tbc.train --resume {shlex.quote(str(run.path))}"
        raise ConfigError(f"{run.path} holds the {state} run of this trial and seed; nothing was changed: {cure}")
    own = {name: value for name, value in asked(args).items() if name in TRAINING}
    arguments = train_arguments(settings, path, seed, own)
    arguments += ["--log-folder", str(root), "--device", args.device]
    return train.command([*arguments, *(["--overwrite"] if args.overwrite else [])])


def main(argv: Sequence[str] | None = None) -> int:
    """Entry point."""
    return run_command(command, "sb3_tbc.tune", argv)
