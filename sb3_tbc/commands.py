"""The commands: which there are, and what they share. A user's mistake is one line and exit status 2."""

from __future__ import annotations

import argparse
import signal
import sys
from collections.abc import Callable, Sequence
from typing import NamedTuple, NoReturn

from sb3_tbc.errors import ConfigError

USER_MISTAKE = 2
INTERRUPTED = 130


class Command(NamedTuple):
    """A command of ``sb3-tbc`` and of ``python -m sb3_tbc.<name>``."""

    module: str  # its ``main(argv)`` returns the exit status
    text: str


COMMANDS = {
    "train": Command("sb3_tbc.train", "train an agent on a task"),
    "evaluate": Command("sb3_tbc.evaluate", "success rate of a saved agent, and a film of it"),
    "tune": Command("sb3_tbc.tune.command", "search settings for a task"),
    "reproduce": Command("sb3_tbc.reproduce", "run the paper's experiments; stopped ones go on"),
    "report": Command("sb3_tbc.report.command", "tables and learning curves of finished runs"),
    "export": Command("sb3_tbc.export.command", "write an agent as C, ONNX or NumPy code for a robot"),
    "benchmark": Command("sb3_tbc.benchmark.command", "measure speed beside other packages"),
}
"""Every command by name: the console script, the tests and the docs are made from this table."""


class Parser(argparse.ArgumentParser):
    """An argument parser whose errors are one line on standard error, without the usage text."""

    def error(self, message: str) -> NoReturn:
        """Say what is wrong and exit with status 2."""
        self.exit(USER_MISTAKE, f"{self.prog}: error: {message} (see {self.prog} --help)\n")


def run_command(command: Callable[[Sequence[str]], int], name: str, argv: Sequence[str] | None = None) -> int:
    """Run a command and turn a user's mistake into one line on standard error.

    :param command: takes the arguments, returns the exit status
    :param name: for messages
    :param argv: arguments, by default those of the process
    :return: exit status
    """
    try:
        return command(sys.argv[1:] if argv is None else argv)
    except ConfigError as error:
        line = " ".join(str(error).split())
        print(f"{name}: error: {line}", file=sys.stderr)
        return USER_MISTAKE
    except KeyboardInterrupt:
        print(f"{name}: interrupted", file=sys.stderr)
        return INTERRUPTED


def stop_like_ctrl_c() -> None:
    """Let a termination signal save the run as Ctrl-C does."""
    signal.signal(signal.SIGTERM, signal.default_int_handler)


def positive_int(text: str) -> int:
    """A whole number above zero, ``1e5`` allowed.

    :raises argparse.ArgumentTypeError: otherwise
    """
    try:
        value = float(text)
    except ValueError as error:
        raise argparse.ArgumentTypeError(f"{text!r} is not a number") from error
    if not value.is_integer() or value <= 0:
        raise argparse.ArgumentTypeError(f"{text!r} is not a whole number above zero")
    return int(value)
