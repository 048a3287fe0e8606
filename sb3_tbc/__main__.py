"""Console script ``sb3-tbc <command>``: the same as ``python -m sb3_tbc.<command>``."""

from __future__ import annotations

import sys
from collections.abc import Sequence
from importlib import import_module
from importlib.util import find_spec

from sb3_tbc.cli import USER_MISTAKE
from sb3_tbc.zoo.schema import nearest

COMMANDS = {
    "train": "train an agent",
    "evaluate": "success rate of a saved agent",
    "report": "tables and curves from the results",
    "reproduce": "the paper's campaign, resumable",
    "tune": "hyper-parameter search",
    "interpret": "what the circuit's neurons do",
    "export": "the whole policy for a robot",
}


def available() -> dict[str, str]:
    """Commands whose module is there."""
    return {name: text for name, text in COMMANDS.items() if find_spec(f"sb3_tbc.{name}") is not None}


def main(argv: Sequence[str] | None = None) -> int:
    """Run a command; exit status 2 for an unknown one."""
    arguments = list(sys.argv[1:] if argv is None else argv)
    commands = available()
    if not arguments or arguments[0] in ("-h", "--help"):
        print("usage: sb3-tbc <command> [--help]\n")
        print("\n".join(f"  {name:<10} {text}" for name, text in commands.items()))
        return 0 if arguments else USER_MISTAKE
    name = arguments[0]
    if name not in commands:
        print(f"sb3-tbc: error: unknown command {name!r}; {nearest(name, commands)}", file=sys.stderr)
        return USER_MISTAKE
    status: int = import_module(f"sb3_tbc.{name}").main(arguments[1:])
    return status


if __name__ == "__main__":
    sys.exit(main())
