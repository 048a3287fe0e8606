"""``python -m sb3_tbc.export``: the whole two-level policy as ONNX, one C99 file, or a NumPy-only module."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from pathlib import Path

from sb3_tbc.commands import Parser, add_trust, output_file, positive_int, run_command, seed_number
from sb3_tbc.errors import ConfigError
from sb3_tbc.export.policy import MLP, Circuit, ExportedPolicy, extract
from sb3_tbc.export.rounding import rounded
from sb3_tbc.extras import require
from sb3_tbc.files import save_atomic, write_atomic
from sb3_tbc.pretrained import is_pretrained, model_path
from sb3_tbc.zoo.algorithms import load_two_levels

SUFFIXES = {"onnx": ".onnx", "c": ".c", "numpy": ".py"}
HEAD_BYTES = 2000
MARKS = (b", exported from sb3_tbc. ", b"\x12\x07sb3_tbc")
"""One of these is among the first bytes of a file that this command wrote: texts say so, ONNX names its producer."""


EXAMPLES = {
    "sb3_tbc.export model.zip --format c": "model.c: one file of C99 for a microcontroller",
    "sb3_tbc.export model.zip --format c --weights int8 --check 5000": "the same in less flash, and what that costs",
    "sb3_tbc.export model.zip --format onnx --check 1000": "ONNX, compared with the agent over 1000 steps",
    "sb3_tbc.export model.zip --format numpy --output policy.py": "a Python module that needs only NumPy",
}


def build_parser() -> Parser:
    """The command's arguments."""
    parser = Parser("sb3_tbc.export", EXAMPLES, description=__doc__)
    parser.add_argument(
        "model", type=model_path, metavar="MODEL.zip", help="the agent, with two levels, or pretrained:TASK"
    )
    parser.add_argument("--format", choices=sorted(SUFFIXES), required=True, help="what to write")
    parser.add_argument("--weights", choices=["float32", "int8"], default="float32", help="int8 rounds the low level's "
                        "weights to eight bits: C files then need a quarter of the flash for them; the other formats "
                        "compute with the same rounded weights")  # fmt: skip
    parser.add_argument(
        "--output", type=output_file, help="file to write; by default beside the model, with another suffix"
    )
    parser.add_argument("--check", type=positive_int, metavar="STEPS", help="act for this many steps with the agent "
                        "and with the exported policy, and print how much their actions differ")  # fmt: skip
    parser.add_argument("--env", help="environment for --check; by default the task on which the agent was trained")
    parser.add_argument("--seed", type=seed_number, default=0, help="seed of the episodes of --check")
    add_trust(parser)
    return parser


def default_output(model: Path, suffix: str) -> Path:
    """Where an export goes without ``--output``: beside the agent, of the package's own agents the working directory.

    An agent often has the name of the program that trained it: a file that is none of ours is not replaced unasked.

    :raises ConfigError: if there is such a file
    """
    name = model.with_suffix(suffix)
    path = Path(name.name) if is_pretrained(model) else name  # never into the package
    if path.is_file() and not _is_export(path):
        raise ConfigError(f"{path} is no export of an agent and stays as it is; name another file with --output")
    return path


def _is_export(path: Path) -> bool:
    try:
        with path.open("rb") as file:
            head = file.read(HEAD_BYTES)
    except OSError:
        return False
    return any(mark in head for mark in MARKS)


def write_onnx(policy: ExportedPolicy, path: Path) -> None:
    """Write the policy as an ONNX graph.

    :raises MissingExtraError: if onnx is not installed
    """
    onnx = require("onnx", extra="export", what="--format onnx")
    from sb3_tbc.export.onnx_graph import to_onnx

    model = to_onnx(policy)
    save_atomic(lambda temporary: onnx.save(model, temporary), path)


def write_c(policy: ExportedPolicy, path: Path) -> None:
    """Write the policy as one C99 file."""
    from sb3_tbc.export.c99 import to_c

    write_atomic(path, to_c(policy))


def write_numpy(policy: ExportedPolicy, path: Path) -> None:
    """Write the policy as a Python module that needs only NumPy."""
    from sb3_tbc.export.numpy_module import to_numpy_module

    write_atomic(path, to_numpy_module(policy))


WRITERS: dict[str, Callable[[ExportedPolicy, Path], None]] = {"onnx": write_onnx, "c": write_c, "numpy": write_numpy}


def describe(policy: ExportedPolicy) -> str:
    """One line about what was exported."""
    low = policy.low
    kind = "MLP" if isinstance(low, MLP) else f"circuit of {low.n_neurons} neurons, K = {low.sub_steps}"
    return f"{policy.task}: {policy.n_observation} observations, {len(policy.action_low)} actions, low level {kind}"


def command(argv: Sequence[str]) -> int:
    """Export; see ``--help``."""
    args = build_parser().parse_args(argv)
    suffix = SUFFIXES[args.format]
    if args.output is not None and args.output.suffix != suffix:  # compilers and imports go by it
        raise ConfigError(f"--format {args.format} writes a file that ends in {suffix}, got --output {args.output}")
    if args.format == "onnx":  # report it before the agent is loaded
        require("onnx", extra="export", what="--format onnx")
    path = args.output or default_output(args.model, suffix)
    model = load_two_levels(args.model, trust=args.trust)
    policy = extract(model, args.model.stem)
    if args.weights == "int8":
        policy = rounded(policy)
    WRITERS[args.format](policy, path)
    print(f"{describe(policy)}\nwritten: {path}")
    if args.format == "c":
        from sb3_tbc.export.check import cortex_m4_report

        print(cortex_m4_report(path))
    if args.check is not None:
        from sb3_tbc.evaluate import identify
        from sb3_tbc.export.check import check

        info = identify(args.model, args.env, args.trust)
        print(check(model, policy, args.format, path, info, args.check, args.seed))
    elif args.weights == "int8":
        print(
            "weights of eight bits: not compared with the agent; before you use them, compare them with --check STEPS"
        )
    elif isinstance(policy.low, Circuit) and args.format != "onnx":
        print("closed form: not compared with the agent; before you use it, compare it with --check STEPS")
    return 0


def main(argv: Sequence[str] | None = None) -> int:
    """Entry point."""
    return run_command(command, "sb3_tbc.export", argv)
