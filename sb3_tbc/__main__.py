"""Console script ``sb3-tbc <command>``: the same as ``python -m sb3_tbc.<command>``."""

from __future__ import annotations

import sys
from collections.abc import Sequence
from importlib import import_module

from sb3_tbc.commands import COMMANDS, USER_MISTAKE, run_command
from sb3_tbc.errors import nearest


def main(argv: Sequence[str] | None = None) -> int:
    """Run a command; exit status 2 for an unknown one."""
    arguments = list(sys.argv[1:] if argv is None else argv)
    if not arguments or arguments[0] in ("-h", "--help"):
        return run_command(_list_commands, "sb3-tbc", arguments)
    name = arguments[0]
    if name not in COMMANDS:
        print(f"sb3-tbc: error: unknown command {name!r}; {nearest(name, COMMANDS)}", file=sys.stderr)
        return USER_MISTAKE
    status: int = import_module(COMMANDS[name].module).main(arguments[1:])
    return status


def _list_commands(arguments: Sequence[str]) -> int:
    """Print what commands there are; not to name one is a mistake, unless help was asked for."""
    print("usage: sb3-tbc <command> [--help]\n")
    print("\n".join(f"  {name:<10} {command.text}" for name, command in COMMANDS.items()))
    return 0 if arguments else USER_MISTAKE


if __name__ == "__main__":
    sys.exit(main())
