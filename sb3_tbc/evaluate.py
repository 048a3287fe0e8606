"""``python -m sb3_tbc.evaluate``: success rate of a saved agent with its interval, subgoals, windows; video too."""

from __future__ import annotations

import sys
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import torch as th

from sb3_tbc.commands import Parser, positive_int, run_command
from sb3_tbc.errors import ConfigError
from sb3_tbc.files import write_atomic
from sb3_tbc.tbc_hrl.evaluation import evaluate_agent
from sb3_tbc.zoo.algorithms import RUN_INFO, algorithm_of, load_model, read_zip
from sb3_tbc.zoo.environments import NAMESPACE, make_env, resolve_env
from sb3_tbc.zoo.ledger import summarise, to_json
from sb3_tbc.zoo.runner import evaluation_envs


def build_parser() -> Parser:
    """The command's arguments."""
    parser = Parser("sb3_tbc.evaluate", description=__doc__)
    parser.add_argument("model", type=Path, metavar="MODEL.zip")
    parser.add_argument("--env", help="task or goal environment id; by default the one the agent was trained on")
    parser.add_argument("--n-episodes", type=positive_int, default=100)
    parser.add_argument("--seed", type=int, default=0, help="of the episodes")
    parser.add_argument("--stochastic", action="store_true", help="sample actions as in training")
    parser.add_argument("--json", type=Path, metavar="OUT", help="write exactly what is printed")
    parser.add_argument("--video", type=Path, metavar="OUT.mp4", help="record episodes with subgoal and remaining time")
    parser.add_argument("--video-episodes", type=positive_int, default=3)
    parser.add_argument("--device", default="cpu")
    parser.add_argument("--num-threads", type=positive_int, default=1)
    return parser


def identify(path: Path, env: str | None) -> dict[str, Any]:
    """What the ``.zip`` says of itself, and the environment to evaluate it on.

    :param path: the agent
    :param env: environment asked for, or ``None`` for the agent's own
    :raises ConfigError: for a broken or foreign ``.zip``, and when no environment is known
    """
    data = read_zip(path)
    saved = data.get(RUN_INFO) or {}
    info = {"algo": algorithm_of(path, data), "variant": "full", "config": "custom", "seed": data.get("seed"), **saved}
    if env is not None:
        task, env_id = resolve_env(env)
        # Our own tasks take the same arguments, so a policy sees the layout it was trained with in another engine, too.
        own = all(str(i).startswith(NAMESPACE) for i in (env_id, info.get("env_id")))
        keep = own or env_id == info.get("env_id")
        info.update(task=task, env_id=env_id, env_kwargs=info["env_kwargs"] if keep else {})
    if "env_id" not in info:
        raise ConfigError(f"{path} does not say what environment it was trained on; pass --env")
    return info


def evaluate(
    path: Path, info: dict[str, Any], n_episodes: int, seed: int, stochastic: bool, device: str
) -> dict[str, Any]:
    """Evaluate an agent and return what is printed and written.

    :raises ConfigError: if agent and environment do not fit
    """
    env = evaluation_envs(info["env_id"], n_episodes, seed, info["env_kwargs"])
    try:
        model = load_model(path, env, device)
        result = evaluate_agent(model, env, n_episodes, seed=seed, deterministic=not stochastic)
    finally:
        env.close()
    identity = {key: info[key] for key in ("task", "algo", "variant", "config", "seed")}
    return {**identity, "n_timesteps": int(model.num_timesteps), **summarise(result), "eval_seed": seed}


def command(argv: Sequence[str]) -> int:
    """Evaluate; see ``--help``."""
    args = build_parser().parse_args(argv)
    th.set_num_threads(args.num_threads)
    info = identify(args.model, args.env)
    text = to_json(evaluate(args.model, info, args.n_episodes, args.seed, args.stochastic, args.device))
    print(text, end="")
    if args.json is not None:
        write_atomic(args.json, text)
    if args.video is not None:
        from sb3_tbc.zoo.video import record_video

        env = make_env(info["env_id"], **info["env_kwargs"])
        record_video(load_model(args.model, device=args.device), env, args.video, args.video_episodes, args.seed)
        env.close()
        print(f"video: {args.video}", file=sys.stderr)
    return 0


def main(argv: Sequence[str] | None = None) -> int:
    """Entry point."""
    return run_command(command, "sb3_tbc.evaluate", argv)


if __name__ == "__main__":
    sys.exit(main())
