"""``python -m sb3_tbc.benchmark <what>``: timings of this package and of others, measured in turns in one run."""

from __future__ import annotations

import argparse
from collections.abc import Sequence
from typing import TYPE_CHECKING

from sb3_tbc.aliases import Plain
from sb3_tbc.commands import (
    Parser,
    Several,
    add_trust,
    env_count,
    output_file,
    positive_int,
    run_command,
    seed_number,
)
from sb3_tbc.extras import require
from sb3_tbc.files import write_atomic
from sb3_tbc.pretrained import model_path
from sb3_tbc.zoo.config import CONFIGS
from sb3_tbc.zoo.ledger import to_json

if TYPE_CHECKING:
    Commands = argparse._SubParsersAction[Parser]

EXAMPLES = {
    "sb3_tbc.benchmark train Pendulum": "training speed beside SB3's SAC, and where the time goes",
    "sb3_tbc.benchmark cells --json cells.json": "the circuit beside LTC, CfC and GRU",
    "sb3_tbc.benchmark parameters": "sizes of all circuits and of the MLPs that they replace",
    "sb3_tbc.benchmark fit --tasks Pendulum --actors lean mlp --steps 500 2000": "what actors learn by imitation",
    "sb3_tbc.benchmark robustness pretrained:Pendulum": "a trained agent under noise, late actions and other physics",
}
JSON_HELP = "write the figures to this file, too"
ENV_HELP = "task; by default the one on which the agent was trained"


def build_parser() -> Parser:
    """The command's arguments, one sub-command per thing to measure."""
    text = "Speed, sizes, imitation and robustness, on one thread. Machines are noisy: compare times of one run only."
    parser = Parser("sb3_tbc.benchmark", EXAMPLES, description=text)
    commands = parser.add_subparsers(dest="subject", required=True, parser_class=Parser)
    _add_cells(commands)
    parameters = commands.add_parser("parameters", help="sizes of table A1's and the shipped circuits, beside MLPs")
    parameters.add_argument("--json", type=output_file, metavar="OUT", help=JSON_HELP)
    _add_train(commands)
    _add_fit(commands)
    _add_robustness(commands)
    return parser


def _add_cells(commands: Commands) -> None:
    cells = commands.add_parser("cells", help="NDBCNet beside LTC, CfC and GRU: sequences, single steps, growth")
    cells.add_argument("--rounds", type=positive_int, default=20, help="rounds over all cells")
    cells.add_argument("--batch", type=positive_int, default=256, help="sequences in a batch")
    cells.add_argument("--time", type=positive_int, default=16, help="steps of a sequence")
    cells.add_argument("--compile", action="store_true", help="also the compiled network (takes minutes to compile)")
    cells.add_argument("--no-growth", action="store_true", help="skip the curves over synapses, time and K")
    cells.add_argument("--json", type=output_file, metavar="OUT", help=JSON_HELP)


def _add_fit(commands: Commands) -> None:
    fit = commands.add_parser("fit", help="how fast and how well actors learn recorded skills and delays by imitation")
    fit.add_argument("--tasks", action=Several, metavar="SKILL", help="tasks that have a recording, and delay3, "
                     "delay10, delay30 or another delay; by default all of these")  # fmt: skip
    fit.add_argument("--actors", action=Several, metavar="ACTOR", default=["paper", "lean", "lean,reflex", "mlp"],
                     help="paper: table A1's circuit; lean: the same with lean synapses; either with options after "
                     "commas: reflex; full (fans); equal (neurons added, for as many parameters as paper has); "
                     "slow (command neurons); gains (of 6 to 12); centred (logistics half open at the start); standard "
                     "(inputs standardised); relative (positive quantities learnt by factors); unshunted (weak sensory "
                     "synapses); inter=48, sub_steps=6, ...; rate_gains=3, rate_synapses=3, rate_readout=0.3 (factors "
                     "of the rate). mlp: an MLP of as many parameters as table A1's circuit, mlp:64x64x64: these "
                     "widths, mlp:1300: about 1300 parameters; gru:16: a GRU of 16 units. All with optimizer=nadam or "
                     "radam, and with a single learning rate as in lean,rate=3e-2. By default paper, lean, lean,reflex "
                     "and mlp")  # fmt: skip
    fit.add_argument("--steps", action=Several, type=positive_int, default=[500, 1000, 2000, 8000], metavar="N",
                     help="Adam steps after which to measure the fit; by default 500, 1000, 2000 and 8000")  # fmt: skip
    fit.add_argument(
        "--seeds", type=positive_int, default=1, help="number of seeds per actor; figures are means over them"
    )
    fit.add_argument("--json", type=output_file, metavar="OUT", help=JSON_HELP)
    record = commands.add_parser("record", help="record the low level of a trained agent as a skill for fit")
    record.add_argument("model", type=model_path, metavar="MODEL.zip", help="an agent whose low level has no memory; "
                        "pretrained:TASK is one that comes with the package")  # fmt: skip
    record.add_argument(
        "--out", type=output_file, metavar="OUT.npz", help="by default the task's file among the package's skills"
    )
    record.add_argument("--env", help=ENV_HELP)
    record.add_argument("--every", type=positive_int, default=3, help="record every N-th step", metavar="N")
    record.add_argument("--json", type=output_file, metavar="OUT", help=JSON_HELP)
    add_trust(record)


def _add_robustness(commands: Commands) -> None:
    robustness = commands.add_parser("robustness", help="agents under noise, late actions and changed physics")
    robustness.add_argument("models", nargs="+", type=model_path, metavar="MODEL.zip", help="agents of one task, shown "
                            "side by side; pretrained:TASK is one that comes with the package")  # fmt: skip
    robustness.add_argument("--env", help=ENV_HELP)
    robustness.add_argument("--n-episodes", type=positive_int, default=100, help="episodes under each disturbance")
    robustness.add_argument("--seed", type=seed_number, default=0, help="seed of the episodes")
    robustness.add_argument("--json", type=output_file, metavar="OUT", help=JSON_HELP)
    add_trust(robustness)


def _add_train(commands: Commands) -> None:
    train = commands.add_parser("train", help="training speed beside SB3's SAC and SBX's, and where the time goes")
    train.add_argument("tasks", nargs="*", default=["Pendulum", "Drawbridge"], metavar="TASK",
                       help="tasks to measure; by default Pendulum and Drawbridge")  # fmt: skip
    train.add_argument("--what", action=Several, default=["speed", "split", "update"], metavar="WHAT",
                       help="any of speed, split, floor, update, growth, n-envs, memory, budget; by default speed, "
                       "split and update")  # fmt: skip
    train.add_argument("--config", choices=CONFIGS, help="values of the task's settings; by default tuned, for tasks "
                       "that have them")  # fmt: skip
    train.add_argument("--n-envs", type=env_count, help="parallel environments in split; by default the "
                       "configuration's")  # fmt: skip
    train.add_argument("--steps", type=positive_int, default=2000, help="environment steps of one measurement")
    train.add_argument("--rounds", type=positive_int, default=5, help="measurements of each contender, in turns")
    train.add_argument("--json", type=output_file, metavar="OUT", help=JSON_HELP)


def benchmark(argv: Sequence[str]) -> int:
    """Measure what the arguments ask for and print it."""
    arguments = build_parser().parse_args(argv)
    lines, figures = _measure(arguments)
    print("\n".join(lines))
    if arguments.json is not None:
        write_atomic(arguments.json, to_json(figures))
    return 0


def _measure(arguments: argparse.Namespace) -> tuple[list[str], Plain]:
    if arguments.subject == "cells":
        from sb3_tbc.benchmark import cells as benchmark_cells

        return benchmark_cells.cells(arguments)
    if arguments.subject == "fit":
        from sb3_tbc.benchmark import fit as benchmark_fit

        return benchmark_fit.fit(arguments)
    if arguments.subject == "robustness":
        from sb3_tbc.benchmark import robustness as benchmark_robustness

        return benchmark_robustness.robustness(arguments)
    if arguments.subject == "record":
        return _record(arguments)
    if arguments.subject == "train":
        from sb3_tbc.benchmark import training as benchmark_train

        return benchmark_train.train(arguments)
    require("Box2D", extra="box2d", what="benchmark parameters")  # for the sizes of Platforms and Tennis2D
    from sb3_tbc.benchmark.circuits import parameters

    return parameters()


def _record(arguments: argparse.Namespace) -> tuple[list[str], Plain]:
    from sb3_tbc.benchmark.skills import record_file

    written = record_file(arguments.model, arguments.out, arguments.every, arguments.env, arguments.trust)
    return [f"recording      {written} ({written.stat().st_size / 1e6:.2f} MB)"], {"recording": str(written)}


def main(argv: Sequence[str] | None = None) -> int:
    """Entry point."""
    return run_command(benchmark, "sb3_tbc.benchmark", argv)
