"""``python -m sb3_tbc.evaluate``: measure a saved agent's success rate, film it, or watch it in a window."""

from __future__ import annotations

import sys
from collections.abc import Sequence
from pathlib import Path

import torch as th

from sb3_tbc.aliases import Plain, PlainMapping
from sb3_tbc.commands import (
    STANDARD_OUTPUT,
    Parser,
    add_trust,
    file_or_standard_output,
    output_file,
    positive_int,
    run_command,
    seed_number,
    thread_count,
)
from sb3_tbc.errors import ConfigError
from sb3_tbc.files import write_atomic
from sb3_tbc.pretrained import model_path
from sb3_tbc.tasks.layouts import layout_of
from sb3_tbc.tbc_hrl.evaluation import evaluate_agent
from sb3_tbc.zoo.algorithms import RUN_INFO, algorithm_of, environment_of, load_model, observation_size, read_zip
from sb3_tbc.zoo.environments import NAMESPACE, make_env, resolve_env
from sb3_tbc.zoo.ledger import summarise, to_json
from sb3_tbc.zoo.runner import HELD_OUT, evaluation_envs

EXAMPLES = {
    "sb3_tbc.evaluate runs/Pendulum/tbc-hrl/full/seed_0/model.zip": "100 episodes, and a summary of them",
    "sb3_tbc.evaluate model.zip --video film.mp4 --video-episodes 5": "film five episodes as well",
    "sb3_tbc.evaluate model.zip --json - > result.json": "figures for a program, nothing else on standard output",
    "sb3_tbc.evaluate model.zip --render --n-episodes 3": "watch three episodes in a window, then count them",
}


def build_parser() -> Parser:
    """The command's arguments."""
    parser = Parser("sb3_tbc.evaluate", EXAMPLES, description=__doc__)
    parser.add_argument("model", type=model_path, metavar="MODEL.zip", help="the agent, as train and model.save write "
                        "it; pretrained:TASK is one that comes with the package")  # fmt: skip
    parser.add_argument("--env", help="task or goal environment id; by default the one the agent was trained on")
    parser.add_argument("--n-episodes", type=positive_int, default=100, help="episodes to count")
    parser.add_argument("--seed", type=seed_number, default=HELD_OUT, help="seed of the episodes; by default one that "
                        "no training and none of its evaluations has used")  # fmt: skip
    parser.add_argument("--stochastic", action="store_true", help="sample actions as in training, instead of the means")
    parser.add_argument("--json", type=file_or_standard_output, metavar="OUT", help="write the figures as JSON to this "
                        "file and to standard output, the summary to standard error; with - there alone")  # fmt: skip
    parser.add_argument(
        "--video", type=output_file, metavar="OUT.mp4", help="film episodes with subgoal and remaining time"
    )
    parser.add_argument("--video-episodes", type=positive_int, default=3, help="episodes in the film")
    parser.add_argument("--render", action="store_true", help="show episodes in a window before they are counted")
    add_trust(parser)
    parser.add_argument("--device", default="cpu", help="torch device")
    parser.add_argument("--num-threads", type=thread_count, default=1, help="torch threads")
    return parser


def identify(path: Path, env: str | None, trust: bool = False) -> Plain:
    """What an agent's ``.zip`` records about the agent, and the environment to evaluate it on.

    :param path: the agent
    :param env: environment asked for, or ``None`` for the agent's own
    :param trust: whether a module that the agent names may be imported
    :raises ConfigError: for a broken or foreign ``.zip``, and when no environment is known
    """
    data = read_zip(path)
    saved = data[RUN_INFO] if isinstance(data.get(RUN_INFO), dict) else {}
    info = {"algo": algorithm_of(path, data), "variant": "full", "config": "custom", "seed": data.get("seed"), **saved}
    if env is not None:
        task, env_id = resolve_env(env)
        # Our own tasks take the same arguments, so a policy sees the layout it was trained with in another engine, too.
        own = all(str(i).startswith(NAMESPACE) for i in (env_id, info.get("env_id")))
        keep = own or env_id == info.get("env_id")
        kept = info.get("env_kwargs")
        info.update(task=task, env_id=env_id, env_kwargs=kept if keep and isinstance(kept, dict) else {})
        layout = layout_of(task, observation_size(data) or 0)
        if layout is not None and "observation" not in info["env_kwargs"]:  # saved by model.save, without arguments
            info["env_kwargs"] = {**info["env_kwargs"], "observation": layout}
        return info
    env_id, env_kwargs = environment_of(path, data, trust)
    return {"task": env_id, **info, "env_id": env_id, "env_kwargs": env_kwargs}


def evaluate(
    path: Path, info: Plain, n_episodes: int, seed: int, stochastic: bool, device: str, trust: bool = False
) -> Plain:
    """Evaluate an agent and return what is printed and written.

    :raises ConfigError: if agent and environment do not fit
    """
    env = evaluation_envs(info["env_id"], n_episodes, seed, info["env_kwargs"])
    try:
        model = load_model(path, env, device, trust)
        result = evaluate_agent(model, env, n_episodes, seed=seed, deterministic=not stochastic)
    finally:
        env.close()
    identity = {key: info[key] for key in ("task", "algo", "variant", "config", "seed")}
    return {**identity, "n_timesteps": int(model.num_timesteps), **summarise(result), "eval_seed": seed}


FIGURES = {
    "mean_length": "episode length   {:.1f} steps on average",
    "mean_length_success": "  of successes   {:.1f} steps",
    "subgoal_success": "subgoals reached {:.2f}  (share of options, mean over episodes)",
    "mean_window": "option length    {:.1f} steps on average",
}
"""Figure of the result -> its line of the summary."""


def describe(result: PlainMapping) -> str:
    """A few lines for a person; figures that an agent does not have (a flat one has no subgoals) are left out."""
    low, high = result["success_ci95"]
    count = round(result["success_rate"] * result["n_episodes"])
    lines = [
        f"agent            {result['algo']} ({result['variant']}), {result['n_timesteps']:,} training steps on "
        f"{result['task']}",
        f"success rate     {result['success_rate']:.2f}  ({count} of {result['n_episodes']} episodes; 95 % Wilson "
        f"interval {low:.2f} to {high:.2f})",
    ]
    for key, text in FIGURES.items():
        if result[key] is not None:
            lines.append(text.format(result[key]))
    return "\n".join(lines)


def command(argv: Sequence[str]) -> int:
    """Evaluate; see ``--help``."""
    args = build_parser().parse_args(argv)
    if args.video is not None:  # checked first, since counting the episodes may take minutes
        from sb3_tbc.zoo.video import record_video, require_film

        require_film(args.video)
    th.set_num_threads(args.num_threads)
    info = identify(args.model, args.env, args.trust)
    if args.render:
        _watch(args.model, info, args.n_episodes, args.seed, args.stochastic, args.device, args.trust)
    result = evaluate(args.model, info, args.n_episodes, args.seed, args.stochastic, args.device, args.trust)
    _tell(result, args.json)
    if args.video is not None:
        env = make_env(info["env_id"], **info["env_kwargs"])
        record_video(
            load_model(args.model, device=args.device, trust=args.trust),
            env,
            args.video,
            args.video_episodes,
            args.seed,
            not args.stochastic,
        )
        env.close()
        print(f"video            {args.video}", file=sys.stderr)
    return 0


def _tell(result: PlainMapping, json_out: Path | None) -> None:
    """Print the summary; with ``--json``, standard output has the JSON alone, the summary goes to standard error."""
    if json_out is None:
        print(describe(result))
        return
    text = to_json(result)
    if json_out != STANDARD_OUTPUT:
        write_atomic(json_out, text)
        print(describe(result), file=sys.stderr)
    print(text, end="")


def _watch(
    path: Path, info: PlainMapping, n_episodes: int, seed: int, stochastic: bool, device: str, trust: bool
) -> None:
    """Play episodes in a window; episode ``i`` starts from ``seed + i``.

    :raises ConfigError: if the environment cannot be drawn, or there is no display
    """
    from sb3_tbc.tasks.window import Window
    from sb3_tbc.zoo.video import episode_frames, frames_per_second

    model, env = load_model(path, device=device, trust=trust), make_env(info["env_id"], **info["env_kwargs"])
    try:
        window = Window(f"{info['task']}, {info['algo']}", frames_per_second(env))
        for episode in range(n_episodes):
            for frame in episode_frames(model, env, seed + episode, not stochastic):
                window.show(frame)
        window.close()
    except RuntimeError as error:
        raise ConfigError(f"--render cannot open a window: {error}") from error
    finally:
        env.close()


def main(argv: Sequence[str] | None = None) -> int:
    """Entry point."""
    return run_command(command, "sb3_tbc.evaluate", argv)


if __name__ == "__main__":
    sys.exit(main())
