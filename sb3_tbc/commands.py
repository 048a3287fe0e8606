"""The table of commands, and what all commands share: a user's mistake is one line of text and exit status 2."""

from __future__ import annotations

import argparse
import contextlib
import io
import math
import os
import shlex
import shutil
import signal
import sys
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple, NoReturn

from sb3_tbc.errors import ConfigError, EnvironmentFault, NonFiniteError, TrainingError, WriteError
from sb3_tbc.files import FULL, require_writable

FAILED = 1
USER_MISTAKE = 2
INTERRUPTED = 130
STANDARD_OUTPUT = Path("-")
MOST_THREADS = 1024
"""More threads than any machine for this package has cores; torch crashes when it cannot make them all."""
MOST_ENVS = 4096
MOST_SEEDS = 10_000
MOST_STEPS = 10**12
TOLD = (ConfigError, WriteError, TrainingError, EnvironmentFault, NonFiniteError)
"""Errors whose message is all that a user needs; of others the traceback is shown."""


class Command(NamedTuple):
    """A command of ``sb3-tbc`` and of ``python -m sb3_tbc.<name>``."""

    module: str  # its ``main(argv)`` returns the exit status
    text: str


COMMANDS = {
    "train": Command("sb3_tbc.train", "train an agent on a task"),
    "evaluate": Command("sb3_tbc.evaluate", "measure a saved agent's success rate, film it or watch it"),
    "tune": Command("sb3_tbc.tune.command", "search settings for a task"),
    "reproduce": Command("sb3_tbc.reproduce", "run the paper's experiments, on this machine or a cluster"),
    "report": Command("sb3_tbc.report.command", "tables, statistics and learning curves of finished runs"),
    "export": Command("sb3_tbc.export.command", "write an agent as C, ONNX or NumPy code for a robot"),
    "interpret": Command("sb3_tbc.interpret.command", "what the neurons of an agent do, and a page that shows them"),
    "benchmark": Command("sb3_tbc.benchmark.command", "measure speed beside other packages"),
}
"""Every command by name: the console script, the tests and the docs are made from this table."""


class HelpFormatter(argparse.RawDescriptionHelpFormatter):
    """Adds the default value to each help text that does not name it already."""

    def __init__(self, prog: str) -> None:
        super().__init__(prog, max_help_position=30, width=min(shutil.get_terminal_size().columns, 110))

    def _get_help_string(self, action: argparse.Action) -> str | None:
        text = action.help
        nothing = any(action.default is value for value in (None, False, argparse.SUPPRESS)) or action.default == []
        unsaid = nothing or not action.option_strings
        if text is None or unsaid or "default" in text:
            return text
        return f"{text} (default: %(default)s)"


class Several(argparse.Action):
    """An option of several values that may be given more than once; the first values replace the default."""

    def __init__(self, **settings: Any) -> None:
        super().__init__(nargs="+", **settings)

    def __call__(
        self, parser: argparse.ArgumentParser, namespace: argparse.Namespace, values: Any, option: str | None = None
    ) -> None:
        """Add the values to those given before."""
        given = getattr(namespace, self.dest)
        earlier = [] if given is None or given is self.default else given
        setattr(namespace, self.dest, [*earlier, *values])


class Parser(argparse.ArgumentParser):
    """An argument parser whose help ends with examples and whose errors are one line, without the usage text.

    :param prog: name of the command in messages
    :param examples: command lines (without ``python -m``) and what each is for
    :param description: what the command does, e.g. its module's docstring
    :param settings: as for :class:`argparse.ArgumentParser`
    """

    def __init__(
        self, prog: str, examples: Mapping[str, str] | None = None, description: str | None = None, **settings: Any
    ) -> None:
        lines = [f"  # {purpose}\n  python -m {line}" for line, purpose in (examples or {}).items()]
        epilog = "examples:\n" + "\n".join(lines) if lines else None
        text = (description or "").replace("``", "")
        # without abbreviations: --seed would be taken for --seeds
        settings = {"allow_abbrev": False, **settings}
        super().__init__(prog, description=text, formatter_class=HelpFormatter, epilog=epilog, **settings)

    def parse_known_args(self, args: Any = None, namespace: Any = None) -> Any:
        """Parse, and refuse a file that the command is to write and that another argument names, too."""
        parsed, rest = super().parse_known_args(args, namespace)
        paths: dict[Path, argparse.Action] = {}
        for action in sorted(self._actions, key=self._writes):
            value = getattr(parsed, action.dest, None)
            if not isinstance(value, Path):
                continue
            other = paths.setdefault(Path(os.path.realpath(value)), action)
            if other is not action and self._writes(action):
                self.error(f"{_named(other)} and {_named(action)} name the same file, {value}; give each its own")
        return parsed, rest

    @staticmethod
    def _writes(action: argparse.Action) -> bool:
        return action.type in (output_file, file_or_standard_output)

    def error(self, message: str) -> NoReturn:
        """Say what is wrong and exit with status 2."""
        self.exit(USER_MISTAKE, f"{self.prog}: error: {message} (see {self.prog} --help)\n")


def _named(action: argparse.Action) -> str:
    return action.option_strings[0] if action.option_strings else str(action.metavar or action.dest)


def run_command(command: Callable[[Sequence[str]], int], name: str, argv: Sequence[str] | None = None) -> int:
    """Run a command and turn a user's mistake into one line on standard error.

    :param command: takes the arguments, returns the exit status
    :param name: for messages
    :param argv: arguments, by default those of the process
    :return: exit status
    """
    _open_closed_streams()
    for stream in (sys.stdout, sys.stderr):
        if isinstance(stream, io.TextIOWrapper):
            stream.reconfigure(errors="backslashreplace")  # a path that the terminal cannot show is no reason to fail
    try:
        try:
            return command(sys.argv[1:] if argv is None else argv)
        finally:
            sys.stdout.flush()
    except BrokenPipeError:
        _drop_output()
        print(f"{name}: error: broken pipe: what reads the output has ended", file=sys.stderr)
        return FAILED
    except TOLD as error:
        return tell(error, name)
    except UnicodeEncodeError as error:  # other packages take such names for text
        cure = "rename it, or set LC_ALL=C.UTF-8 if this locale is the reason"
        return tell(ConfigError(f"{error.object!r} is no text, perhaps the name of a file; {cure}"), name)
    except PermissionError as error:
        return tell(WriteError(f"no permission for {error.filename}; is it yours, or open to you?"), name)
    except OSError as error:
        if error.errno not in FULL or error.filename is not None:
            raise
        _drop_output()
        return tell(WriteError(f"cannot write the output: {error.strerror}; make room, then go on"), name)
    except KeyboardInterrupt:
        print(f"{name}: interrupted", file=sys.stderr)
        return INTERRUPTED


def _open_closed_streams() -> None:
    """Lead streams that the shell has closed (``>&-``) to nowhere; the next file opened would take their place."""
    handle = os.open(os.devnull, os.O_RDWR)
    while handle <= 2:
        os.set_inheritable(handle, True)
        handle = os.open(os.devnull, os.O_RDWR)
    os.close(handle)
    for stream in ("stdout", "stderr"):
        if getattr(sys, stream) is None:
            setattr(sys, stream, open(os.devnull, "w", encoding="utf-8"))  # noqa: SIM115 it stays open


def _drop_output() -> None:
    """Lead standard output to nowhere, as Python writes what is left of it again at its end."""
    with contextlib.suppress(OSError, ValueError):  # a stream without a file
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())


def tell(error: Exception, name: str) -> int:
    """Print an error of :data:`TOLD` as one line on standard error and return the exit status.

    :param name: who says it
    """
    line = " ".join(str(error).split())
    print(f"{name}: error: {line}", file=sys.stderr, flush=True)
    return USER_MISTAKE if isinstance(error, ConfigError | WriteError) else FAILED


def python() -> str:
    """Name this interpreter as the user would type it: short when it lies below the working directory."""
    path = Path(sys.executable)
    return shlex.quote(str(path.relative_to(Path.cwd()))) if path.is_relative_to(Path.cwd()) else "python"


def stop_like_ctrl_c() -> None:
    """Treat a termination signal like Ctrl-C, so that the run is saved."""
    signal.signal(signal.SIGTERM, signal.default_int_handler)


def add_trust(parser: argparse.ArgumentParser) -> None:
    """Add the option that allows a saved agent's file to run code."""
    parser.add_argument(
        "--trust", action="store_true", help="load the agent even if its file can run code on this machine; use it "
        "only for files whose origin you know. Needed for agents saved by development versions of 0.1.0, for policy "
        "classes and subgoal functions of your own, and for environments that a module of your own defines",
    )  # fmt: skip


def given_path(text: str) -> Path:
    """A file or folder that the user names; ``~`` is expanded where the shell leaves it, as in ``--json=~/out.json``.

    :raises argparse.ArgumentTypeError: for an empty text, which would mean the working directory, and for a path that
        the system does not let us look at, or finds too long
    """
    if not text:
        raise argparse.ArgumentTypeError("an empty text names no file or folder; is a variable of the shell unset?")
    path = Path(os.path.expanduser(text))
    try:
        path.stat()
    except (FileNotFoundError, NotADirectoryError):
        return path  # whether it must be there, the command knows
    except OSError as error:
        raise argparse.ArgumentTypeError(f"cannot use {path}: {error.strerror}") from error
    return path


def output_file(text: str) -> Path:
    """A file that the command is to write; what cannot be written is refused before the work begins.

    :raises argparse.ArgumentTypeError: if so, and for ``-``, which means standard output only where a help text says so
    """
    path = given_path(text)
    if text == "-":
        raise argparse.ArgumentTypeError("'-' is no name of a file; here the figures go to a file alone")
    try:
        require_writable(path)
    except WriteError as error:
        raise argparse.ArgumentTypeError(str(error)) from error
    return path


def file_or_standard_output(text: str) -> Path:
    """As :func:`output_file`; ``-`` is :data:`STANDARD_OUTPUT`."""
    return STANDARD_OUTPUT if text == str(STANDARD_OUTPUT) else output_file(text)


def seed_number(text: str) -> int:
    """A seed: a whole number from 0 to 2^32 - 1, as NumPy takes it.

    :raises argparse.ArgumentTypeError: otherwise
    """
    try:
        value = int(text)
    except ValueError as error:
        raise argparse.ArgumentTypeError(f"{text!r} is not a whole number") from error
    if not 0 <= value < 2**32:
        raise argparse.ArgumentTypeError(f"{value} is not between 0 and {2**32 - 1}")
    return value


def positive_int(text: str) -> int:
    """A whole number above zero, ``1e5`` allowed.

    :raises argparse.ArgumentTypeError: otherwise
    """
    value = _number(text)
    if not value.is_integer() or value <= 0:
        raise argparse.ArgumentTypeError(f"{text!r} is not a whole number above zero")
    return int(value)


def at_most(most: int, what: str) -> Callable[[str], int]:
    """Arguments that are whole numbers from 1 to ``most``; more would take all memory, or years, before it fails.

    :param what: what is counted, for the message
    """

    def read(text: str) -> int:
        value = positive_int(text)
        if value > most:
            raise argparse.ArgumentTypeError(f"{text!r} is more than {most} {what}")
        return value

    return read


thread_count = at_most(MOST_THREADS, "threads")
env_count = at_most(MOST_ENVS, "environments")
process_count = at_most(MOST_THREADS, "processes")
seed_count = at_most(MOST_SEEDS, "seeds")
step_count = at_most(MOST_STEPS, "steps")


def not_negative(text: str) -> float:
    """A number of at least zero; ``inf`` is one, ``nan`` is none.

    :raises argparse.ArgumentTypeError: otherwise
    """
    value = _number(text)
    if not value >= 0:
        raise argparse.ArgumentTypeError(f"{text!r} is not a number of at least 0")
    return value


def duration(text: str) -> float:
    """Seconds that a measurement takes: a finite number above zero.

    :raises argparse.ArgumentTypeError: otherwise
    """
    value = _number(text)
    if not 0 < value < math.inf:
        raise argparse.ArgumentTypeError(f"{text!r} is not a finite number above 0")
    return value


def _number(text: str) -> float:
    try:
        return float(text)
    except ValueError as error:
        raise argparse.ArgumentTypeError(f"{text!r} is not a number") from error
