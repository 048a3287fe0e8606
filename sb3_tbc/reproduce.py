"""``python -m sb3_tbc.reproduce``: the paper's experiments, on this machine, as jobs of Slurm, or on a Ray cluster.

Results go to the ledger, a folder of small result files. The same command continues what was stopped: finished runs are
never repeated; failed ones are recorded in the ledger, counted, and tried again. A run in the log folder that was made
with other settings is neither continued nor copied; if the ledger has such a run, nothing begins.
"""

from __future__ import annotations

import argparse
import sys
from collections.abc import Iterator, Sequence
from dataclasses import replace
from pathlib import Path

from sb3_tbc.campaign.campaign import Campaign
from sb3_tbc.campaign.executors import Executor, LocalExecutor, RayExecutor, SlurmExecutor
from sb3_tbc.campaign.hours import plan, read_speeds
from sb3_tbc.campaign.jobs import Job
from sb3_tbc.campaign.progress import Board
from sb3_tbc.commands import (
    FAILED,
    INTERRUPTED,
    Parser,
    Several,
    given_path,
    positive_int,
    run_command,
    seed_count,
    seed_number,
    step_count,
    stop_like_ctrl_c,
)
from sb3_tbc.errors import ConfigError
from sb3_tbc.reading import parse_yaml
from sb3_tbc.train import build_parser as build_train_parser
from sb3_tbc.train import build_spec, variant_name
from sb3_tbc.zoo.algorithms import ALGORITHMS, algorithm
from sb3_tbc.zoo.config import (
    ABLATIONS,
    CONFIGS,
    N_EVAL_EPISODES,
    RunConfig,
    ablations_of,
    default_eval_freq,
    load_config,
    parse_overrides,
)
from sb3_tbc.zoo.environments import resolve_env, task_names
from sb3_tbc.zoo.ledger import RunFolder
from sb3_tbc.zoo.run_spec import RunSpec

EXAMPLES = {
    "sb3_tbc.reproduce --dry-run": "what would run, and how many hours it takes",
    "sb3_tbc.reproduce --tasks Pendulum --seeds 3 --workers 2": "three seeds of every method, two runs at a time",
    "sb3_tbc.reproduce --algos tbc-hrl --ablation no-ts --first-seed 100": "an ablation, on fresh seeds",
    "sb3_tbc.reproduce --tasks Pendulum UR5Reacher --algos tbc-hrl --ablations --seeds 3": "what each part is worth",
    "sb3_tbc.reproduce --executor slurm --workers 40 --slurm slurm_partition:short": "as jobs of Slurm",
    "sb3_tbc.reproduce --executor ray --workers 40 --address auto": "on the Ray cluster that this machine belongs to",
}


def build_parser() -> Parser:
    """The command's arguments."""
    parser = Parser("sb3_tbc.reproduce", EXAMPLES, description=__doc__)
    add = parser.add_argument_group("which runs").add_argument
    add("--tasks", action=Several, default=sorted(task_names()), help="by default all of them")
    add("--algos", action=Several, default=sorted(ALGORITHMS), help="by default all of them: hac, hits, sac, tbc-hrl")
    add("--seeds", type=seed_count, default=10, help="seeds of each task and method; the paper has 10")
    add("--first-seed", type=seed_number, default=0, help="the first seed; the others are the numbers that follow it")
    add(
        "--config",
        choices=CONFIGS,
        help="which values to use; by default tuned, for tasks that have them",
    )
    add(
        "--ablation",
        choices=sorted(ABLATIONS),
        help="a part of the method to leave out (no-...) or to put in (with-...); needs --algos tbc-hrl",
    )
    add("--ablations", action="store_true", help="every ablation that changes something in a task's settings; "
        "needs --algos tbc-hrl")  # fmt: skip
    add("--variant", help="name of the runs' folder; by default as in sb3_tbc.train")
    add("--hyperparams", action=Several, default=[], metavar="NAME:VALUE", help="single settings, as in sb3_tbc.train")
    add("--n-timesteps", type=step_count, help="environment steps of each run; by default the task's")
    add("--eval-freq", type=positive_int, help="steps between evaluations; by default a fortieth of the run")
    add("--n-eval-episodes", type=positive_int, help=f"episodes of each evaluation (default: {N_EVAL_EPISODES})")
    add("--n-final-episodes", type=positive_int, default=100, help="episodes of the evaluation after training")
    add = parser.add_argument_group("how the runs are carried out").add_argument
    add("--workers", type=positive_int, default=1, help="runs at the same time, one thread each")
    add("--executor", choices=["local", "slurm", "ray"], default="local", help="local: processes on this machine; "
        "slurm, ray: a cluster whose machines all see the folders below (extra cluster)")  # fmt: skip
    add("--slurm", action=Several, default=[], metavar="NAME:VALUE", help="settings of the Slurm jobs, as submitit "
        "names them, e.g. slurm_partition:short timeout_min:600")  # fmt: skip
    add("--address", help="address of the Ray cluster; by default RAY_ADDRESS, or a new cluster on this machine")
    add("--dry-run", action="store_true", help="print what would be run and how long it takes, and stop")
    add("--log-folder", type=given_path, default=Path("runs"), help="folder of the runs")
    add("--ledger", type=given_path, default=Path("results"), help="folder that the small result files are copied to")
    return parser


def jobs(argv: Sequence[str]) -> Iterator[Job]:
    """The runs of a campaign, each once, seeds in the outer loop: every task and method has a first seed early.

    :raises ConfigError: for unknown names, before anything runs
    """
    args = build_parser().parse_args(argv)
    overrides = parse_overrides(args.hyperparams)
    if args.ablations and (args.ablation or args.variant):
        raise ConfigError("--ablations names the runs' folders itself: leave --ablation and --variant out")
    seen: set[RunFolder] = set()
    for seed in range(args.first_seed, args.first_seed + args.seeds):
        for name in args.tasks:
            task, _ = resolve_env(name)
            for algo in (name.lower() for name in args.algos):
                algorithm(algo)
                for ablation in ablations_of(task, args.config) if args.ablations else [args.ablation]:
                    run = load_config(algo, task, args.config, overrides, ablation)
                    run = replace(run, n_timesteps=args.n_timesteps or run.n_timesteps)
                    job = _job(args, run, name, seed, ablation)
                    if job.folder not in seen:  # a name may be given twice, e.g. Pendulum pendulum
                        seen.add(job.folder)
                        yield job


def _job(args: argparse.Namespace, run: RunConfig, env: str, seed: int, ablation: str | None) -> Job:
    variant = args.variant or variant_name(run, ablation, args.config)
    arguments = ["--algo", run.algo, "--env", env, "--seed", str(seed), "--variant", variant, *_shared(args)]
    arguments += ["--ablation", ablation] if ablation else []
    folder, target = (
        RunFolder.for_run(root.absolute(), run.task, run.algo, variant, seed) for root in (args.log_folder, args.ledger)
    )
    episodes = evaluated_episodes(args, run.n_timesteps)
    final = args.n_final_episodes
    return Job(run.algo, env, seed, folder, target, tuple(arguments), run.n_timesteps, episodes, final)


def wanted_run(job: Job) -> RunSpec:
    """The run that a job's training command makes.

    :raises ConfigError: for wrong values
    """
    return build_spec(build_train_parser().parse_args(job.arguments), tell=lambda line: None)


def evaluated_episodes(args: argparse.Namespace, n_timesteps: int) -> int:
    """Episodes of all evaluations of a run of ``n_timesteps``."""
    along = n_timesteps // (args.eval_freq or default_eval_freq(n_timesteps))
    return int(along * (args.n_eval_episodes or N_EVAL_EPISODES) + args.n_final_episodes)


def _shared(args: argparse.Namespace) -> list[str]:
    """Arguments of the training command that are the same for all runs."""
    shared = ["--log-folder", str(args.log_folder), "--n-final-episodes", str(args.n_final_episodes)]
    names = ("config", "n_timesteps", "eval_freq", "n_eval_episodes")
    for name, value in ((name, getattr(args, name)) for name in names):
        shared += [f"--{name.replace('_', '-')}", str(value)] if value else []
    return [*shared, "--hyperparams", *args.hyperparams] if args.hyperparams else shared


def make_executor(args: argparse.Namespace) -> Executor:
    """Where the runs are carried out.

    :raises ConfigError: without the package that is needed, or for a malformed setting
    """
    if args.executor == "slurm":
        return SlurmExecutor(args.log_folder.absolute() / "slurm", _slurm_settings(args.slurm))
    return RayExecutor(args.address) if args.executor == "ray" else LocalExecutor()


def _slurm_settings(items: Sequence[str]) -> dict[str, object]:
    pairs = [item.partition(":") for item in items]
    if wrong := [item for item, (name, colon, _) in zip(items, pairs, strict=True) if not name or not colon]:
        raise ConfigError(f"--slurm takes name:value, e.g. timeout_min:600; got {wrong[0]!r}")
    return {name: parse_yaml(value, f"--slurm {name}") for name, _, value in pairs}


def look_up(planned: Sequence[Job]) -> tuple[list[Job], dict[Job, str]]:
    """Runs without a result in the ledger, and those whose result there is another run's or damaged, with what is said.

    :raises ConfigError: for a run that cannot be made
    """
    todo: list[Job] = []
    others: dict[Job, str] = {}
    for job in planned:
        if not job.target.finished:
            todo.append(job)
            continue
        wanted = wanted_run(job)
        try:
            job.require_kept(wanted)
        except ConfigError as error:
            others[job] = str(error)
    return todo, others


def command(argv: Sequence[str]) -> int:
    """Reproduce; see ``--help``."""
    args = build_parser().parse_args(argv)
    planned = list(jobs(argv))
    todo, others = look_up(planned)
    if others and not args.dry_run:
        rest = f" ({len(others) - 1} more of this kind; --dry-run lists them)" if len(others) > 1 else ""
        raise ConfigError(next(iter(others.values())) + rest)
    there = f", {len(others)} there are not the runs asked for" if others else ""
    done = len(planned) - len(todo) - len(others)
    print(f"{len(planned)} runs, {done} of them in {args.ledger}{there}, {len(todo)} to do", flush=True)
    if args.dry_run:
        print("\n".join(f"refused {job.name}   {said}" for job, said in others.items()), end="\n" if others else "")
        print("\n".join(plan(todo, args.workers, read_speeds(args.ledger))))
        if others:
            print(f"without --dry-run nothing begins before the {len(others)} refused runs are dealt with")
        return 0
    if not todo:
        return 0
    stop_like_ctrl_c()
    executor = make_executor(args)
    try:
        with Board(len(todo)) as board:
            campaign = Campaign(executor, args.workers, board, wanted_run)
            campaign.run(todo)
    except KeyboardInterrupt:
        print("stopped; the same command continues", file=sys.stderr)
        return INTERRUPTED
    finally:
        executor.close()
    if campaign.stopped:
        ended = f"{len(campaign.stopped)} of {len(todo)} runs were stopped from outside"
        print(f"{ended}; the same command continues them", file=sys.stderr)
    if campaign.failed:
        print(f"{len(campaign.failed)} of {len(todo)} runs failed; the same command tries them again", file=sys.stderr)
    return FAILED if campaign.failed or campaign.stopped else 0


def main(argv: Sequence[str] | None = None) -> int:
    """Entry point."""
    return run_command(command, "sb3_tbc.reproduce", argv)


if __name__ == "__main__":
    sys.exit(main())
