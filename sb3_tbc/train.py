"""``python -m sb3_tbc.train``: train an agent on a task and keep the run in a folder."""

from __future__ import annotations

import argparse
import shlex
import sys
from collections.abc import Callable, Iterator, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import torch as th

from sb3_tbc.aliases import Plain
from sb3_tbc.commands import (
    INTERRUPTED,
    Parser,
    Several,
    add_trust,
    env_count,
    given_path,
    not_negative,
    positive_int,
    python,
    run_command,
    seed_number,
    step_count,
    thread_count,
)
from sb3_tbc.errors import ConfigError
from sb3_tbc.extras import require
from sb3_tbc.stopping import StopRequest, stop_request
from sb3_tbc.zoo.ablations import match_parameters
from sb3_tbc.zoo.algorithms import algorithm
from sb3_tbc.zoo.config import (
    ABLATIONS,
    CONFIGS,
    N_EVAL_EPISODES,
    OF_PAPER,
    RunConfig,
    default_eval_freq,
    load_config,
    parse_overrides,
)
from sb3_tbc.zoo.environments import resolve_env
from sb3_tbc.zoo.ledger import RunFolder
from sb3_tbc.zoo.run_spec import RunOptions, RunSpec
from sb3_tbc.zoo.runner import Interrupted, resume_run, start_run
from sb3_tbc.zoo.settings_page import settings_text

NOT_RESUMED = (
    *("algo", "env", "seed", "n_envs", "config", "config_file", "ablation", "hyperparams", "on_bad_step"),
    *("eval_freq", "n_eval_episodes", "n_final_episodes", "log_folder", "variant", "overwrite"),
)
"""Options that say what a new run is; a resumed one has them from its ``config.yml``."""
NOT_REMEMBERED = ("ledger", "trace", "tensorboard", "checkpoint_minutes", "device", "num_threads", "trust")
"""Options of how a run is carried out; to continue alike, they are given again."""
EXAMPLES = {
    "sb3_tbc.train": "TBC-HRL on Pendulum; the run is kept in runs/Pendulum/tbc-hrl/full/seed_0",
    "sb3_tbc.train --list": "which tasks and algorithms there are, and how long a run takes",
    "sb3_tbc.train --algo hits --env UR5Reacher --seed 3": "another method, task and seed",
    "sb3_tbc.train --hyperparams low.learning_rate:1e-3 max_options:10": "settings of your own",
    "sb3_tbc.train --resume runs/Pendulum/tbc-hrl/full/seed_0": "continue a run that was stopped",
}


def build_parser() -> Parser:
    """The command's arguments."""
    parser = Parser("sb3_tbc.train", EXAMPLES, description=__doc__)
    what = parser.add_argument_group("what to train")
    what.add_argument("--list", action=ListAction, help="print tasks, steps, minutes, extras and algorithms, and stop")
    what.add_argument("--help-settings", action="store_true", help="print every setting of --algo that --hyperparams "
                      "and configuration files take, and stop")  # fmt: skip
    what.add_argument("--algo", default="tbc-hrl", help="tbc-hrl, hits, hac or sac")
    what.add_argument("--env", default="Pendulum", help="a task's name or the id of any registered goal environment")
    what.add_argument("--seed", type=seed_number, default=0, help="seed of everything random in the run")
    what.add_argument("--n-timesteps", type=step_count, help="environment steps; by default the task's, see --list")
    what.add_argument("--n-envs", type=env_count, help="environments side by side; by default the configuration's")
    what.add_argument("--config", metavar="{paper,tuned,FILE.yml}", help="paper: the values of the paper's tables; "
                      "tuned: values that did better in measurements, the default for tasks that have them; or a file "
                      "with sections like those of zoo_configs")  # fmt: skip
    what.add_argument("--config-file", type=given_path, metavar="FILE.yml", help="a configuration file of your "
                      "own; --config says which of its values to use, paper or tuned")  # fmt: skip
    what.add_argument("--ablation", metavar="NAME", help="leave a part of the method out (no-ts: timed windows, "
                      f"no-ndbc: the circuit), or put one in (with-...): {', '.join(ABLATIONS)}")  # fmt: skip
    what.add_argument("--hyperparams", action=Several, default=[], metavar="NAME:VALUE", help="single settings, which "
                      "win over the configuration; dots lead into a level, e.g. low.learning_rate:1e-3")  # fmt: skip
    what.add_argument("--on-bad-step", choices=["stop", "end-episode"], help="what follows where the environment "
                      "gives a value that is not finite, or of a wrong shape: stop the run, saved (default), or end "
                      "the episode with the step before; short for the setting on_bad_step")  # fmt: skip
    watch = parser.add_argument_group("how it is evaluated")
    watch.add_argument("--eval-freq", type=positive_int, help="environment steps between evaluations; by default a "
                       "fortieth of the run, at least 500")  # fmt: skip
    watch.add_argument("--n-eval-episodes", type=positive_int, default=N_EVAL_EPISODES,
                       help="episodes of each evaluation")  # fmt: skip
    watch.add_argument("--n-final-episodes", type=positive_int, default=100, help="episodes of the last evaluation")
    where = parser.add_argument_group("where it is kept")
    where.add_argument("--log-folder", type=given_path, default=Path("runs"),
                       help="the run goes to <log-folder>/<task>/<algo>/<variant>/seed_<n>")  # fmt: skip
    where.add_argument("--variant", help="name of the run's folder; by default full (the shipped settings), "
                       "custom (others) or the ablation; --config paper adds -paper")  # fmt: skip
    where.add_argument("--overwrite", action="store_true", help="replace an earlier run in the same folder")
    where.add_argument("--resume", type=given_path, metavar="RUN", help="continue the run in this folder as it "
                       "was begun; --n-timesteps may extend it")  # fmt: skip
    where.add_argument(
        "--ledger", type=given_path, metavar="FOLDER", help="also copy the small result files here at the end"
    )
    where.add_argument("--trace", action="store_true", help="write every option of training to options.csv, which the "
                       "report draws")  # fmt: skip
    where.add_argument("--tensorboard", action="store_true", help="write TensorBoard files into the run's folder")
    where.add_argument("--checkpoint-minutes", type=not_negative, default=10.0, help="time between "
                       "checkpoints for --resume; 0: after every rollout, inf: only where it is stopped")  # fmt: skip
    where.add_argument("--keep-checkpoint", action="store_true", help="keep the last checkpoint of a finished run, so "
                       "that --resume can extend it; remembered")  # fmt: skip
    machine = parser.add_argument_group("machine")
    machine.add_argument("--device", default="cpu", help="torch device; agents of two levels learn on the CPU alone")
    machine.add_argument("--num-threads", type=thread_count, default=1,
                         help="torch threads; more than one is slower on networks this small")  # fmt: skip
    machine.add_argument("--progress", action=argparse.BooleanOptionalAction,
                         help="progress bar; by default on a terminal")  # fmt: skip
    add_trust(parser)
    return parser


class ListAction(argparse.Action):
    """``--list``: print what can be trained and stop, as ``--help`` does."""

    def __init__(self, **settings: Any) -> None:
        super().__init__(nargs=0, **settings)

    def __call__(self, parser: argparse.ArgumentParser, *_: object) -> None:
        """Print and stop."""
        from sb3_tbc.zoo.catalogue import catalogue

        print(catalogue())
        parser.exit()


def build_spec(args: argparse.Namespace, tell: Callable[[str], object] = print) -> RunSpec:
    """From arguments to a run.

    :param tell: called with a line about an ablation's parameters
    :raises ConfigError: for unknown names and wrong values
    """
    args.algo = args.algo.lower()
    algorithm(args.algo)
    task, env_id = resolve_env(args.env)
    overrides = parse_overrides(args.hyperparams)
    overrides |= {"on_bad_step": args.on_bad_step} if args.on_bad_step else {}
    config, file = config_and_file(args)
    run = load_config(args.algo, task, config, overrides, args.ablation, file)
    run = replace(run, n_timesteps=args.n_timesteps or run.n_timesteps, n_envs=args.n_envs or run.n_envs)
    variant = args.variant or variant_name(run, args.ablation, config)
    if args.ablation is not None:
        matched = match_parameters(run, load_config(args.algo, task, config, overrides, None, file), env_id)
        tell(f"{args.ablation}: {matched}")
        run = matched.run
    return RunSpec(
        run,
        env_id,
        variant=variant,
        seed=args.seed,
        eval_freq=args.eval_freq or default_eval_freq(run.n_timesteps),
        n_eval_episodes=args.n_eval_episodes,
        n_final_episodes=args.n_final_episodes,
    )


def config_and_file(args: argparse.Namespace) -> tuple[str | None, Path | None]:
    """Which values (``paper`` or ``tuned``) of which file; ``--config`` may name either.

    :raises ConfigError: if it is neither, or if two files are named
    """
    if args.config is None or args.config in CONFIGS:
        return args.config, args.config_file
    path = Path(args.config)
    if path.suffix not in (".yml", ".yaml"):
        raise ConfigError(f"--config is {', '.join(CONFIGS)} or a .yml file, got {args.config!r}")
    if args.config_file is not None:
        raise ConfigError(f"--config {path} and --config-file {args.config_file} name two files; give one")
    return None, path


def variant_name(run: RunConfig, ablation: str | None, config: str | None) -> str:
    """Folder name of a variant, with ``-paper`` when the tables' values were asked for.

    ``full`` has the shipped settings, ``custom`` others; an ablation with others ends with ``-custom``. The number of
    steps makes no other variant.

    :param run: with all settings that the user gave, before an ablation's networks are given their widths
    """
    shipped = load_config(run.algo, run.task, config, ablation=ablation)
    own = replace(run, n_timesteps=shipped.n_timesteps, config=shipped.config) != shipped
    parts = [ablation or "", "custom" if own else ""]
    return ("-".join(filter(None, parts)) or "full") + (OF_PAPER if config == "paper" else "")


def describe(result: Plain, folder: RunFolder) -> str:
    """What to print at the end: the result, where everything lies, and how to evaluate it."""
    low, high = result["success_ci95"]
    env_id = RunSpec.from_dict(folder.read_config()).env_id
    module = ["--env", env_id] if ":" in env_id else []  # no file is trusted to name what is imported
    lines = [
        f"success rate   {result['success_rate']:.2f}  (95 % Wilson interval {low:.2f} to {high:.2f}, "
        f"{result['n_episodes']} episodes, after {result['n_timesteps']:,} steps in {result['wall_time']:.0f} s)",
        f"agent          {folder.model}",
        f"best agent     {folder.best_model}" if folder.best_model.is_file() else "best agent     (not evaluated)",
        f"learning curve {folder.evaluations}",
        f"evaluate       {python()} -m sb3_tbc.evaluate {shlex.join([str(folder.model), *module])}",
    ]
    return "\n".join(lines)


def command(argv: Sequence[str]) -> int:
    """Train; see ``--help``."""
    args = build_parser().parse_args(argv)
    if args.help_settings:
        print(settings_text(args.algo.lower()))
        return 0
    if args.tensorboard:  # checked before the run's folder is made
        require("tensorboard", extra="plots", what="--tensorboard")
    with stop_request() as stop:
        return _train(args, argv, stop)


def _train(args: argparse.Namespace, argv: Sequence[str], stop: StopRequest) -> int:
    th.set_num_threads(args.num_threads)
    options = RunOptions(
        device=args.device,
        progress=sys.stderr.isatty() if args.progress is None else args.progress,
        tensorboard=args.tensorboard,
        trace=args.trace,
        checkpoint_seconds=60.0 * args.checkpoint_minutes,
        keep_checkpoint=args.keep_checkpoint,
        stop=stop,
        trust=args.trust,
        again=tuple(_again(args)),
    )
    try:
        folder, result = _run(args, options, argv)
    except Interrupted as stopped:
        print(f"{stopped}; continue with: {options.resume_line(stopped.folder)}", file=sys.stderr)
        return INTERRUPTED
    lines = [describe(result, folder)]
    if args.ledger is not None:
        target = _ledger_folder(args.ledger, result)
        folder.copy_to(target)
        lines.append(f"ledger         {target.path}")
    print("\n".join(lines))  # last, as nobody may read it any more
    return 0


def _again(args: argparse.Namespace) -> Iterator[str]:
    """Yield the options given that a run does not remember, for the command that continues it."""
    parser = build_parser()
    for name in NOT_REMEMBERED:
        value = getattr(args, name)
        if value != parser.get_default(name):
            yield f"--{name.replace('_', '-')}"
            if value is not True:
                yield str(value)


def _run(args: argparse.Namespace, options: RunOptions, argv: Sequence[str]) -> tuple[RunFolder, Plain]:
    line = shlex.join(["python", "-m", "sb3_tbc.train", *argv])
    if args.resume is not None:
        _refuse_settings(argv)
        folder = RunFolder(args.resume)
        if args.ledger is not None:
            _require_place(args.ledger, folder, RunSpec.from_dict(folder.read_config()))
        return folder, resume_run(folder, options, args.n_timesteps, line)
    spec = build_spec(args)
    folder = RunFolder.for_run(args.log_folder, spec.run.task, spec.run.algo, spec.variant, spec.seed)
    if args.ledger is not None:
        _require_place(args.ledger, folder, spec)
    return folder, start_run(spec, folder, line, options, args.overwrite)


def _require_place(ledger: Path, folder: RunFolder, spec: RunSpec) -> None:
    """Refuse, before anything is trained, a ledger that could not take the result.

    :raises ConfigError: if it is the folder of the runs itself, or holds such a result
    """
    target = _ledger_folder(ledger, spec.identity)
    if target.path.resolve() == folder.path.resolve():
        raise ConfigError(f"--ledger {ledger} is the folder of the runs itself; name another one, e.g. results")
    target.require_empty()


def _refuse_settings(argv: Sequence[str]) -> None:
    """Refuse what a resumed run would ignore.

    :raises ConfigError: naming the first such option
    """
    # argparse gives no default to what a namespace has already, so that None is an option that was not given
    given = build_parser().parse_args(argv, argparse.Namespace(**dict.fromkeys(NOT_RESUMED)))
    if named := [name for name in NOT_RESUMED if getattr(given, name) is not None]:
        option = f"--{named[0].replace('_', '-')}"
        cure = f"leave {option} out, or begin another run without --resume"
        raise ConfigError(f"{option} cannot be changed by --resume, which goes on as the run's config.yml says; {cure}")


def _ledger_folder(ledger: Path, identity: Plain) -> RunFolder:
    return RunFolder.for_run(ledger, identity["task"], identity["algo"], identity["variant"], identity["seed"])


def main(argv: Sequence[str] | None = None) -> int:
    """Entry point."""
    return run_command(command, "sb3_tbc.train", argv)


if __name__ == "__main__":
    sys.exit(main())
