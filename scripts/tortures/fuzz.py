"""Nonsense for every reader: one clear error or a reading, within moments, and nothing run or written meanwhile."""

from __future__ import annotations

import contextlib
import io
import json
import os
import random
import signal
import sys
import zipfile
from collections.abc import Callable, Iterator
from importlib import import_module
from pathlib import Path
from typing import Any

import numpy as np
import yaml

from sb3_tbc.commands import COMMANDS
from sb3_tbc.errors import ConfigError
from sb3_tbc.ndbc.wiring import NDBCWiring
from sb3_tbc.reading import parse_yaml
from sb3_tbc.report.command import command as report
from sb3_tbc.tune.search_space import load_space
from sb3_tbc.zoo.algorithms import load_model
from sb3_tbc.zoo.checkpoints import find_checkpoint
from sb3_tbc.zoo.config import load_config, parse_overrides, read_file
from sb3_tbc.zoo.ledger import RunFolder
from sb3_tbc.zoo.runner import RunSpec
from tortures.runs import Undisturbed

MOST_SECONDS = 20
"""Longer than this is a hang."""
WORDS = [
    *(
        "null",
        "true",
        ".nan",
        ".inf",
        "-1",
        "1e300",
        "9" * 20,
        "''",
        "[]",
        "{}",
        "&a",
        "*a",
        "<<: *a",
        "- ",
    ),
    *(": ", "? ", "| ", "!!python/object:os.system", "\x00", "\ud800", "\u202e", "é", "\t", "2020-99-99", "0x", "0o9"),
    *(
        "1:2:3",
        "low.",
        "high.",
        "gamma",
        "policy_kwargs",
        "ndbc",
        "inter",
        "../..",
        "/etc/passwd",
        "$(touch x)",
        "<script>",
    ),
]
SMALL_VALUES: list[Any] = [
    None,
    True,
    0,
    -1,
    1,
    2**70,
    1e300,
    float("nan"),
    float("inf"),
    "",
    "x",
    "\x00",
    [],
    {},
    [[]],
    {"a": 1},
]


class Hang(Exception):
    """A reader took too long."""


class Touched(BaseException):
    """A reader ran something, or wrote outside of its folder."""


_watching: list[str] = []
RUNS = (
    "os.system",
    "subprocess.Popen",
    "os.exec",
    "os.posix_spawn",
    "os.spawn",
    "os.startfile",
    "pty.spawn",
    "ctypes.dlopen",
)
CHANGES = (
    "os.remove",
    "os.rename",
    "os.rmdir",
    "os.mkdir",
    "shutil.rmtree",
    "os.chmod",
    "os.link",
    "os.symlink",
    "os.truncate",
)


def _audit(event: str, arguments: tuple[Any, ...]) -> None:
    if not _watching:
        return
    if event in RUNS:
        raise Touched(f"{event}{arguments!r:.100}")
    writes = event == "open" and bool((arguments[2] or 0) & (os.O_WRONLY | os.O_RDWR | os.O_CREAT))
    if (event in CHANGES or writes) and isinstance(arguments[0], str | bytes | os.PathLike):
        path = os.path.abspath(os.fsdecode(arguments[0]))
        if not path.startswith((_watching[0], "/dev/null", "/tmp/torch", "/proc/")):
            raise Touched(f"{event} {path}")


class Fuzzer:
    """Makes inputs of every kind from a finished run and gives them to the readers.

    :param root: scratch folder
    :param run: the folder of the run
    """

    def __init__(self, root: Path, run: Path) -> None:
        self.root, self.run = root, run
        self.model = (run / "model.zip").read_bytes()
        self.checkpoint = {path.name: path.read_bytes() for path in (run / "checkpoint").iterdir()}
        self.config = (run / "config.yml").read_text()
        self.ledger = {p.name: p.read_bytes() for p in run.iterdir() if p.suffix in (".json", ".csv", ".yml", ".txt")}
        self.agent = load_model(run / "model.zip")
        self.wiring = NDBCWiring(5, 4, 3, 2, 2, 2, 2, 2, seed=0).to_dict()
        self.space = {"Pendulum": {"low.gamma": {"kind": "float", "low": 0.9, "high": 0.99}}}
        self.kinds: dict[str, Callable[[random.Random], object]] = {
            "agent": self.an_agent,
            "replay": self.a_replay_file,
            "yaml": self.a_configuration,
            "hyperparams": self.a_setting,
            "search": self.a_search_space,
            "wiring": self.a_wiring,
            "resume": self.a_run_folder,
            "ledger": self.a_ledger,
            "command": self.a_command_line,
        }

    def an_agent(self, rng: random.Random) -> None:
        """A damaged ``.zip``; half of them whole as a file, with a changed table within."""
        path = self.root / "model.zip"
        if rng.random() < 0.5:
            path.write_bytes(damaged(self.model, rng))
        else:
            rezipped(self.model, path, lambda name, content: _changed_member(name, content, rng))
        load_model(path)

    def a_replay_file(self, rng: random.Random) -> None:
        """Damaged bytes, or whole arrays of other shapes and types."""
        path = self.root / "replay.npz"
        content = self.checkpoint["replay_buffer.pkl"]
        if rng.random() < 0.5:
            path.write_bytes(damaged(content, rng))
        else:
            with np.load(io.BytesIO(content)) as arrays:
                held = {name: arrays[name] for name in arrays.files}
            for name in rng.sample(sorted(held), rng.randint(1, 3)):
                held[name] = _changed_array(held[name], rng)
            np.savez(path, **held)
        with contextlib.suppress(ValueError):
            self.agent.load_replay_buffer(path)

    def a_configuration(self, rng: random.Random) -> None:
        """A configuration file, read, and the run that it describes."""
        path = self.root / "config.yml"
        text = mangled(self.config, rng).encode("utf-8", "surrogatepass")
        path.write_bytes(damaged(text, rng) if rng.random() < 0.5 else text)
        parse_yaml(path.read_text(errors="replace"), "it")
        read_file(path)

    def a_setting(self, rng: random.Random) -> None:
        """``--hyperparams``, merged into a configuration."""
        name = rng.choice(
            ["low.gamma", "high.policy_kwargs", "low.policy_kwargs.ndbc", "max_options", "compile", "env_kwargs"]
        )
        text = mangled(f"{name}:{rng.choice(WORDS)}", rng) if rng.random() < 0.7 else f"{name}:{rng.choice(WORDS)}"
        load_config("tbc-hrl", "Pendulum", None, parse_overrides([text]))

    def a_search_space(self, rng: random.Random) -> None:
        """A file of ranges."""
        path = self.root / "space.yml"
        path.write_text(mangled(yaml.safe_dump(changed(self.space, rng)), rng), errors="replace")
        load_space("tbc-hrl", "Pendulum", path)

    def a_wiring(self, rng: random.Random) -> None:
        """A wiring's plain data."""
        with contextlib.suppress(ValueError, TypeError):
            NDBCWiring.from_dict(changed(self.wiring, rng))

    def a_run_folder(self, rng: random.Random) -> None:
        """What ``--resume`` reads."""
        folder = self.root / "run"
        (folder / "checkpoint").mkdir(parents=True, exist_ok=True)
        for name, content in self.checkpoint.items():
            (folder / "checkpoint" / name).write_bytes(content)
        victim = rng.choice(["config.yml", "evaluations.csv", *(f"checkpoint/{name}" for name in self.checkpoint)])
        for name in ("config.yml", "evaluations.csv"):
            (folder / name).write_bytes(self.ledger[name])
        (folder / victim).write_bytes(damaged((folder / victim).read_bytes(), rng))
        run = RunFolder(folder)
        RunSpec.from_dict(run.read_config())
        run.read_evaluations()
        find_checkpoint(folder)
        if victim.startswith("checkpoint/") and not victim.endswith("state.json"):  # in it, blanks do not matter
            raise RuntimeError(f"damage of {victim} was not noticed")

    def a_ledger(self, rng: random.Random) -> None:
        """A folder of results, as ``report --html`` reads it."""
        folder = self.root / "ledger" / "Pendulum" / "tbc-hrl" / "full" / "seed_0"
        folder.mkdir(parents=True, exist_ok=True)
        for name, content in self.ledger.items():
            (folder / name).write_bytes(content)
        name = rng.choice(
            sorted({"final.json", "config.yml", "evaluations.csv", "versions.json", "options.csv", "command.txt"})
        )
        content = self.ledger[name]
        if name == "final.json" and rng.random() < 0.7:
            content = json.dumps(changed(json.loads(content), rng)).encode()
        (folder / name).write_bytes(content if rng.random() < 0.1 else damaged(content, rng))
        report([str(self.root / "ledger"), *(["--html", str(self.root / "page.html")] if rng.random() < 0.1 else [])])

    def a_command_line(self, rng: random.Random) -> None:
        """Arguments of every command; those that could begin a long run are only parsed."""
        name = rng.choice(sorted(COMMANDS))
        module = import_module(COMMANDS[name].module)
        known = [option for action in module.build_parser()._actions for option in action.option_strings]
        words = [rng.choice([*known, *WORDS, "1", "0", "Pendulum", "x.zip"]) for _ in range(rng.randint(0, 6))]
        with contextlib.suppress(SystemExit):
            arguments = module.build_parser().parse_args(words)
            if name == "train":
                module.build_spec(arguments)


def torture_fuzz(root: Path, number: int, first: int) -> tuple[int, int]:
    """``number`` inputs of each kind, 10,000 by default."""
    whole, _ = Undisturbed(root).get("tbc-hrl", 1)
    sys.addaudithook(_audit)
    fuzzer, good, number = Fuzzer(root, whole), 0, number or 10_000
    chosen = os.environ.get("FUZZ_KINDS", ",".join(fuzzer.kinds)).split(",")
    for kind in chosen:
        bad = 0
        for k in range(first, first + number):
            problem = _try(fuzzer.kinds[kind], random.Random(f"{kind} {k}"), root)
            if problem:
                bad += 1
                if bad <= 20:
                    print(f"   {kind} {k}: {problem}", flush=True)
        good += number - bad
        print(f"   {kind}: {number} tried, {number - bad} read or refused in one line", flush=True)
    return len(chosen) * number, good


def _try(give: Callable[[random.Random], object], rng: random.Random, root: Path) -> str:
    """What went wrong with one input; empty if nothing did."""
    try:
        with _watched(str(root)), contextlib.redirect_stdout(io.StringIO()), contextlib.redirect_stderr(io.StringIO()):
            give(rng)
    except ConfigError as error:
        return "a message of several lines" if "\n" in str(error).strip() else ""
    except (Exception, Touched) as error:
        place = _where(error)
        return f"{type(error).__name__} at {place}: {error}"[:300]
    left = [path.name for path in root.rglob(".tmp*")]
    return f"left {left}" if left else ""


def _where(error: BaseException) -> str:
    trace = error.__traceback__
    while trace is not None and trace.tb_next is not None:
        trace = trace.tb_next
    return "?" if trace is None else f"{Path(trace.tb_frame.f_code.co_filename).name}:{trace.tb_lineno}"


@contextlib.contextmanager
def _watched(root: str) -> Iterator[None]:
    def hang(*_: object) -> None:
        raise Hang(f"no end after {MOST_SECONDS} s")

    before = signal.signal(signal.SIGALRM, hang)
    signal.alarm(MOST_SECONDS)
    _watching.append(root)
    try:
        yield
    finally:
        _watching.clear()
        signal.alarm(0)
        signal.signal(signal.SIGALRM, before)


# --------------------------------------------------------------------------------------------- making nonsense


def damaged(content: bytes, rng: random.Random) -> bytes:
    """A file cut short, with flipped bits, or with a piece of itself in another place; never the file itself."""
    way = rng.randrange(3)
    if way == 0 or len(content) < 2:
        return content[: rng.randrange(max(len(content), 1))]
    made = bytearray(content)
    if way == 1:
        for _ in range(rng.randint(1, 8)):
            made[rng.randrange(len(made))] ^= 1 << rng.randrange(8)
    else:
        begin, place = rng.randrange(len(content)), rng.randrange(len(content))
        made[place:place] = content[begin : begin + rng.randint(1, 200)]
    return bytes(made) if bytes(made) != content else content[:-1]


def mangled(text: str, rng: random.Random) -> str:
    """A text with words put in, taken out, repeated."""
    for _ in range(rng.randint(1, 5)):
        place, length = rng.randrange(len(text) + 1), rng.randint(0, 10)
        text = text[:place] + rng.choice(WORDS) * rng.choice((0, 1, 1, 1, 3)) + text[place + length :]
    return text


def changed(data: Any, rng: random.Random) -> Any:
    """Plain data with one value replaced, one removed or one added, somewhere in it."""
    if isinstance(data, dict) and data and rng.random() < 0.85:
        key, made = rng.choice(sorted(data, key=str)), dict(data)
        way = rng.random()
        if way < 0.1:
            del made[key]
        elif way < 0.2:
            made[rng.choice(WORDS)] = rng.choice(SMALL_VALUES)
        else:
            made[key] = changed(data[key], rng)
        return made
    if isinstance(data, list) and data and rng.random() < 0.85:
        place, made_list = rng.randrange(len(data)), list(data)
        made_list[place] = changed(data[place], rng)
        return made_list[: rng.randint(0, len(data))] if rng.random() < 0.1 else made_list
    return rng.choice(SMALL_VALUES)


def rezipped(content: bytes, path: Path, change: Callable[[str, bytes], bytes]) -> None:
    """The archive with changed members and right checksums."""
    with zipfile.ZipFile(io.BytesIO(content)) as old, zipfile.ZipFile(path, "w") as new:
        for name in old.namelist():
            new.writestr(name, change(name, old.read(name)))


def _changed_member(name: str, content: bytes, rng: random.Random) -> bytes:
    if rng.random() < 0.6:
        return content
    if name.endswith(".pth") or name not in ("data", "plain.json"):
        return damaged(content, rng) if rng.random() < 0.2 else content
    return json.dumps(changed(json.loads(content), rng)).encode()


def _changed_array(array: Any, rng: random.Random) -> Any:
    way = rng.randrange(5)
    if way == 0:
        return array.astype(rng.choice(["<U3", "c16", "i1", "f2", "?"])) if array.dtype.kind in "fiub" else np.zeros(3)
    if way == 1:
        return array.reshape(-1)[: rng.randrange(array.size + 1)]
    if way == 2:
        return np.zeros((rng.randrange(4),) * rng.randrange(4))
    if array.dtype.kind == "U":
        try:
            return np.array(json.dumps(changed(json.loads(str(array)), rng)))
        except ValueError:
            return np.array("{}")
    return np.full_like(array, rng.choice([-1, 0, 1, 127])) if array.dtype.kind in "fiub" else array
