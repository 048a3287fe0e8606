"""``python -m sb3_tbc.reproduce``: the paper's campaign, runs side by side, resumable, into the results ledger."""

from __future__ import annotations

import os
import subprocess
import sys
import threading
from collections.abc import Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from pathlib import Path

from sb3_tbc.commands import INTERRUPTED, Parser, positive_int, run_command
from sb3_tbc.train import variant_name
from sb3_tbc.zoo.algorithms import ALGORITHMS, algorithm
from sb3_tbc.zoo.config import ABLATIONS, CONFIGS, load_config, parse_overrides
from sb3_tbc.zoo.environments import resolve_env, task_names
from sb3_tbc.zoo.ledger import RunFolder


@dataclass(frozen=True)
class Job:
    """One run of the campaign and the folders it goes to."""

    algo: str
    env: str
    seed: int
    folder: RunFolder
    target: RunFolder
    arguments: tuple[str, ...]

    @property
    def name(self) -> str:
        """For messages."""
        return f"{self.env} {self.algo} {self.folder.path.parent.name} seed {self.seed}"

    def command(self) -> list[str]:
        """The training command that begins this run, or goes on where it stopped."""
        train = [sys.executable, "-m", "sb3_tbc.train", "--no-progress"]
        if self.folder.resumable:
            return [*train, "--resume", str(self.folder.path)]
        return [*train, "--overwrite", *self.arguments]


EXAMPLES = {
    "sb3_tbc.reproduce --dry-run": "what would run, and how many hours it takes",
    "sb3_tbc.reproduce --tasks Pendulum --seeds 3 --workers 2": "three seeds of every method, two runs at a time",
    "sb3_tbc.reproduce --algos tbc-hrl --ablation no-ts --first-seed 100": "an ablation, on fresh seeds",
}


def build_parser() -> Parser:
    """The command's arguments."""
    parser = Parser("sb3_tbc.reproduce", EXAMPLES, description=__doc__)
    add = parser.add_argument_group("which runs").add_argument
    add("--tasks", nargs="+", default=sorted(task_names()), help="by default all of them")
    add("--algos", nargs="+", default=sorted(ALGORITHMS), help="by default all of them: hac, hits, sac, tbc-hrl")
    add("--seeds", type=positive_int, default=10, help="seeds of each task and method; the paper has 10")
    add("--first-seed", type=int, default=0, help="the seeds are this one and the next ones")
    add("--config", choices=CONFIGS, help="values of the settings; by default tuned where there are such")
    add("--ablation", choices=sorted(ABLATIONS), help="what to leave out; needs --algos tbc-hrl")
    add("--variant", help="name of the runs' folder; by default from --config and --ablation")
    add("--hyperparams", nargs="+", default=[], metavar="NAME:VALUE", help="single settings, as train takes them")
    add("--n-timesteps", type=positive_int, help="environment steps of each run; by default the task's")
    add("--eval-freq", type=positive_int, help="environment steps between evaluations; by default a fortieth")
    add("--n-eval-episodes", type=positive_int, help="episodes of each evaluation (default: 20)")
    add("--n-final-episodes", type=positive_int, default=100, help="episodes of the evaluation after training")
    add = parser.add_argument_group("how they are run").add_argument
    add("--workers", type=positive_int, default=1, help="runs at the same time, one thread each")
    add("--executor", choices=["local"], default="local", help="where they run")
    add("--dry-run", action="store_true", help="print what would be run, and stop")
    add("--log-folder", type=Path, default=Path("runs"), help="folder of the runs")
    add("--ledger", type=Path, default=Path("results"), help="folder that the small result files are copied to")
    return parser


def jobs(argv: Sequence[str]) -> Iterator[Job]:
    """The runs of a campaign, seeds innermost last, so that every task and method has a first seed early.

    :raises ConfigError: for unknown names, before anything runs
    """
    args = build_parser().parse_args(argv)
    overrides = parse_overrides(args.hyperparams)
    for seed in range(args.first_seed, args.first_seed + args.seeds):
        for name in args.tasks:
            task, _ = resolve_env(name)
            for algo in args.algos:
                algorithm(algo)
                load_config(algo, task, args.config, overrides, args.ablation)  # mistakes are told before anything runs
                variant = args.variant or variant_name(args.ablation, args.config)
                arguments = ["--algo", algo, "--env", name, "--seed", str(seed), "--variant", variant]
                arguments += ["--log-folder", str(args.log_folder), "--n-final-episodes", str(args.n_final_episodes)]
                for flag, value in (("--config", args.config), ("--n-timesteps", args.n_timesteps)):
                    arguments += [flag, str(value)] if value else []
                arguments += ["--ablation", args.ablation] if args.ablation else []
                for flag, value in (("--eval-freq", args.eval_freq), ("--n-eval-episodes", args.n_eval_episodes)):
                    arguments += [flag, str(value)] if value else []
                arguments += ["--hyperparams", *args.hyperparams] if args.hyperparams else []
                folder, target = (RunFolder.of(r, task, algo, variant, seed) for r in (args.log_folder, args.ledger))
                yield Job(algo, name, seed, folder, target, tuple(arguments))


class Campaign:
    """Carries out jobs with a number of workers; stopping it stops the runs, which save themselves."""

    def __init__(self) -> None:
        self._running: set[subprocess.Popen[bytes]] = set()
        self._stopped = threading.Event()

    def run(self, todo: Sequence[Job], workers: int) -> list[Job]:
        """Run jobs; returns those that failed."""
        with ThreadPoolExecutor(workers) as pool:
            try:
                outcome = list(pool.map(self._run_one, todo))
            except KeyboardInterrupt:
                self._stopped.set()
                for process in tuple(self._running):
                    process.terminate()
                raise
        return [job for job, good in zip(todo, outcome, strict=True) if not good]

    def _run_one(self, job: Job) -> bool:
        if self._stopped.is_set():
            return False
        if not job.folder.finished:
            job.folder.path.mkdir(parents=True, exist_ok=True)
            log = job.folder.path / "train.log"
            print(f"begin   {job.name}   (log: {log})", flush=True)
            with log.open("ab") as output:
                environment = {**os.environ, "OMP_NUM_THREADS": "1"}
                process = subprocess.Popen(job.command(), stdout=output, stderr=output, env=environment)
                self._running.add(process)
                status = process.wait()
                self._running.discard(process)
            if status != 0:
                print(f"failed  {job.name}   (exit status {status}, see {log})", flush=True)
                return False
        job.folder.copy_to(job.target)
        final = job.target.read_final()
        print(f"done    {job.name}   success {final['success_rate']:.2f} at {final['n_timesteps']:,} steps", flush=True)
        return True


def command(argv: Sequence[str]) -> int:
    """Reproduce; see ``--help``."""
    args = build_parser().parse_args(argv)
    campaign = list(jobs(argv))
    todo = [job for job in campaign if not job.target.finished]
    print(f"{len(campaign)} runs, {len(campaign) - len(todo)} of them in {args.ledger}, {len(todo)} to do", flush=True)
    if args.dry_run:
        print("\n".join(f"to do   {job.name}" for job in todo))
        return 0
    try:
        failed = Campaign().run(todo, args.workers)
    except KeyboardInterrupt:
        print("stopped; the same command continues", file=sys.stderr)
        return INTERRUPTED
    return 1 if failed else 0


def main(argv: Sequence[str] | None = None) -> int:
    """Entry point."""
    return run_command(command, "sb3_tbc.reproduce", argv)


if __name__ == "__main__":
    sys.exit(main())
