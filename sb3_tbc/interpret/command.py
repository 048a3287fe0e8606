"""``python -m sb3_tbc.interpret``: what the neurons of an agent do, with controls, and a page that shows them."""

from __future__ import annotations

import argparse
import sys
from collections.abc import Sequence
from pathlib import Path

import torch as th

from sb3_tbc.aliases import Plain
from sb3_tbc.commands import Parser, add_trust, output_file, positive_int, run_command, seed_number, thread_count
from sb3_tbc.errors import ConfigError
from sb3_tbc.evaluate import identify
from sb3_tbc.export.policy import extract
from sb3_tbc.files import save_atomic, write_atomic
from sb3_tbc.interpret.drawing import picture_of
from sb3_tbc.interpret.episodes import HeldOutEpisodes
from sb3_tbc.interpret.features import TaskSpace, space_of
from sb3_tbc.interpret.findings import Effort, Findings, investigate, to_plain
from sb3_tbc.interpret.page import live_page
from sb3_tbc.interpret.picture import activation_in_space, units_shown
from sb3_tbc.interpret.text import describe
from sb3_tbc.interpret.units import CircuitUnits, units_of
from sb3_tbc.pretrained import model_path
from sb3_tbc.tbc_hrl import TBCHRL
from sb3_tbc.zoo.algorithms import load_two_levels
from sb3_tbc.zoo.environments import make_env
from sb3_tbc.zoo.ledger import to_json
from sb3_tbc.zoo.runner import HELD_OUT

EXAMPLES = {
    "sb3_tbc.interpret pretrained:Pendulum": "all measures, on 20 held-out episodes",
    "sb3_tbc.interpret model.zip --json inside.json --png inside.png": "every figure, and activation in space",
    "sb3_tbc.interpret pretrained:Drawbridge --html inside.html": "a page in which the circuit runs; open it offline",
    "sb3_tbc.interpret model.zip --n-episodes 100 --synapses": "narrower intervals, and every synapse cut",
}
MOST_IN_PICTURE = 8
"""Episodes in the picture; more would cover each other."""


def build_parser() -> Parser:
    """The command's arguments."""
    parser = Parser("sb3_tbc.interpret", EXAMPLES, description=__doc__)
    parser.add_argument("model", type=model_path, metavar="MODEL.zip", help="the agent, with two levels, or "
                        "pretrained:TASK")  # fmt: skip
    parser.add_argument("--env", help="task or goal environment id; by default the one the agent was trained on")
    parser.add_argument("--n-episodes", type=positive_int, default=20, help="held-out episodes")
    parser.add_argument("--seed", type=seed_number, default=HELD_OUT, help="seed of the first episode")
    parser.add_argument("--json", type=output_file, metavar="OUT.json", help="write every figure")
    parser.add_argument(
        "--png", type=output_file, metavar="OUT.png", help="draw activation in space, as the paper's figure 5"
    )
    parser.add_argument("--wiring", type=output_file, metavar="OUT.png", help="draw the circuit: its readout, dead "
                        "ends, and synapses as thick as they are used")  # fmt: skip
    parser.add_argument("--html", type=output_file, metavar="OUT.html", help="write a page in which the circuit runs, "
                        "in one file")  # fmt: skip
    parser.add_argument("--n-random", type=positive_int, default=5, help="random lesions of each size")
    parser.add_argument("--max-alone", type=positive_int, default=24, help="units lesioned one by one, the most "
                        "active ones first")  # fmt: skip
    parser.add_argument("--synapses", action="store_true", help="also remove each synapse, one at a time (slow)")
    parser.add_argument("--device", default="cpu", help="torch device")
    parser.add_argument("--num-threads", type=thread_count, default=1, help="torch threads")
    add_trust(parser)
    return parser


def command(argv: Sequence[str]) -> int:
    """Interpret; see ``--help``."""
    args = build_parser().parse_args(argv)
    th.set_num_threads(args.num_threads)
    info = identify(args.model, args.env, args.trust)
    model = load_two_levels(args.model, device=args.device, trust=args.trust)
    units, space = units_of(model), _space_of(model, info)
    if not isinstance(units, CircuitUnits) and (args.synapses or args.wiring):
        asked = "--synapses" if args.synapses else "--wiring"
        raise ConfigError(f"{asked} is about the synapses of a circuit; this agent's low level is an MLP")
    if args.html is not None:
        _try_numbers(model)
    episodes = HeldOutEpisodes(model, info["env_id"], info["env_kwargs"], args.n_episodes, args.seed)
    try:
        effort = Effort(args.n_random, args.max_alone, args.synapses)
        found = investigate(model, units, space, info["task"], episodes, effort)
        _write(args, found, model, info, space, episodes)
        print(describe(found), end="")
    finally:
        episodes.close()
    return 0


def _try_numbers(model: TBCHRL) -> None:
    """Say before the episodes, which take minutes, that an agent can have no page.

    :raises ConfigError: if so
    """
    try:
        extract(model)
    except ConfigError as error:
        raise ConfigError(f"--html: the page computes both levels from an export, but {error}") from error


def _space_of(model: TBCHRL, info: Plain) -> TaskSpace:
    """The task's own space if the agent's subgoals are the task's."""
    env = make_env(info["env_id"], **info["env_kwargs"])
    own = env.get_wrapper_attr("subgoals").names == model.views.subgoals.names
    env.close()
    return space_of(info["task"] if own else "", model.views.subgoals)


def _write(
    args: argparse.Namespace,
    found: Findings,
    model: TBCHRL,
    info: Plain,
    space: TaskSpace,
    episodes: HeldOutEpisodes,
) -> None:
    """Write the files that were asked for."""
    subgoals = model.views.subgoals
    identity = {key: info[key] for key in ("task", "algo", "variant", "config", "seed")}
    if args.json is not None:
        about = {**identity, "n_timesteps": int(model.num_timesteps), "first_episode_seed": args.seed}
        write_atomic(args.json, to_json(to_plain(found, about)))
    if args.wiring is not None and isinstance(found.units, CircuitUnits):
        circuit = picture_of(model, info["task"], found.units, found.traces)
        save_atomic(lambda path: Path(path).write_bytes(circuit), args.wiring)
    if args.png is None and args.html is None:
        return
    which = units_shown(found.units, found.activity)
    layer = "command neurons" if found.kind == "circuit" else "units of the last hidden layer"
    title = f"{found.task}: potential of {layer} along the trajectory"
    picture = activation_in_space(found.traces[:MOST_IN_PICTURE], found.units, which, space, subgoals, title)
    if args.png is not None:
        save_atomic(lambda path: Path(path).write_bytes(picture), args.png)
    if args.html is not None:
        write_atomic(args.html, live_page(model, found, space, episodes, info, picture))


def main(argv: Sequence[str] | None = None) -> int:
    """Entry point."""
    return run_command(command, "sb3_tbc.interpret", argv)


if __name__ == "__main__":
    sys.exit(main())
