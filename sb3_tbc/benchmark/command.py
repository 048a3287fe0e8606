"""``python -m sb3_tbc.benchmark <what>``: timings of this package beside others, taken in turns in one run."""

from __future__ import annotations

import argparse
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from sb3_tbc.commands import Parser, positive_int, run_command
from sb3_tbc.extras import require
from sb3_tbc.files import write_atomic
from sb3_tbc.zoo.config import CONFIGS
from sb3_tbc.zoo.ledger import to_json

EXAMPLES = {
    "sb3_tbc.benchmark train Pendulum": "training speed beside SB3's SAC, and where the time goes",
    "sb3_tbc.benchmark cells --json cells.json": "the circuit beside LTC, CfC and GRU",
    "sb3_tbc.benchmark parameters": "sizes of the circuits of table A1",
}
JSON_HELP = "write the figures to this file, too"


def build_parser() -> Parser:
    """The command's arguments, one sub-command per thing to measure."""
    text = "Measure speed with one torch thread. Machines are noisy: compare figures of one run only."
    parser = Parser("sb3_tbc.benchmark", EXAMPLES, description=text)
    commands = parser.add_subparsers(dest="subject", required=True, parser_class=Parser)
    _add_cells(commands)
    parameters = commands.add_parser("parameters", help="parameter counts of table A1's circuits beside their MLPs")
    parameters.add_argument("--json", metavar="OUT", help=JSON_HELP)
    _add_train(commands)
    return parser


def _add_cells(commands: Any) -> None:
    cells = commands.add_parser("cells", help="NDBCNet beside LTC, CfC and GRU: sequences, single steps, growth")
    cells.add_argument("--rounds", type=positive_int, default=20, help="rounds over all cells")
    cells.add_argument("--batch", type=positive_int, default=256, help="sequences in a batch")
    cells.add_argument("--time", type=positive_int, default=16, help="steps of a sequence")
    cells.add_argument("--compile", action="store_true", help="also the compiled network (takes minutes to compile)")
    cells.add_argument("--no-growth", action="store_true", help="skip the curves over synapses, time and K")
    cells.add_argument("--json", metavar="OUT", help=JSON_HELP)


def _add_train(commands: Any) -> None:
    train = commands.add_parser("train", help="training speed beside SB3's SAC and SBX's, and where the time goes")
    train.add_argument("tasks", nargs="*", default=["Pendulum", "Drawbridge"], metavar="TASK",
                       help="tasks to measure; by default Pendulum and Drawbridge")  # fmt: skip
    train.add_argument("--what", nargs="+", default=["speed", "split", "update"], metavar="WHAT",
                       help="any of speed, split, floor, update, growth, n-envs, memory, budget; by default speed, "
                       "split and update")  # fmt: skip
    train.add_argument("--config", choices=CONFIGS, help="values of the task's settings; by default tuned where there "
                       "are such")  # fmt: skip
    train.add_argument("--n-envs", type=positive_int, help="environments side by side in split; by default the "
                       "configuration's")  # fmt: skip
    train.add_argument("--steps", type=positive_int, default=2000, help="environment steps of a stretch of learning")
    train.add_argument("--rounds", type=positive_int, default=5, help="stretches of each contender, in turns")
    train.add_argument("--json", metavar="OUT", help=JSON_HELP)


def benchmark(argv: Sequence[str]) -> int:
    """Measure what the arguments ask for and print it."""
    arguments = build_parser().parse_args(argv)
    lines, figures = _measure(arguments)
    print("\n".join(lines))
    if arguments.json:
        write_atomic(Path(arguments.json), to_json(figures))
    return 0


def _measure(arguments: argparse.Namespace) -> tuple[list[str], dict[str, Any]]:
    from sb3_tbc.benchmark import cells as benchmark_cells

    if arguments.subject == "cells":
        return benchmark_cells.cells(arguments)
    if arguments.subject == "train":
        from sb3_tbc.benchmark import training as benchmark_train

        return benchmark_train.train(arguments)
    require("Box2D", extra="box2d", what="benchmark parameters")  # for the sizes of Platforms and Tennis2D
    return benchmark_cells.parameters()


def main(argv: Sequence[str] | None = None) -> int:
    """Entry point."""
    return run_command(benchmark, "sb3_tbc.benchmark", argv)
