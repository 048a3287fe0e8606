"""Compares an exported policy with its agent, and measures its size on a microcontroller."""

from __future__ import annotations

import ctypes
import importlib.util
import re
import shutil
import subprocess
import tempfile
import time
from collections.abc import Mapping
from pathlib import Path
from typing import Any, NamedTuple, Protocol

import numpy as np

from sb3_tbc.aliases import Env, PlainMapping
from sb3_tbc.arrays import AnyArray
from sb3_tbc.errors import ConfigError
from sb3_tbc.export.policy import Circuit, ExportedPolicy, action_box
from sb3_tbc.extras import require
from sb3_tbc.outside import one_line
from sb3_tbc.smdp.goal_spaces import GOAL_KEYS
from sb3_tbc.tbc_hrl import TBCHRL
from sb3_tbc.zoo.environments import make_env, refuse_other_spaces

STRICT = ("-std=c99", "-pedantic", "-Wall", "-Wextra", "-Werror")
CORTEX_M4 = ("-mcpu=cortex-m4", "-mthumb", "-mfloat-abi=hard", "-mfpu=fpv4-sp-d16", "-Os", "-std=c99")
SMALLEST = ("-DTBC_SINGLE", "-DTBC_LOW_LEVEL_ONLY", "-DTBC_INTEGRATED_ONLY")
TOLERANCE = 0.05
"""Difference of actions, as a share of half their range, above which a warning is printed."""

Observation = Mapping[str, AnyArray]


class Player(Protocol):
    """An exported policy in use."""

    def reset(self) -> None:
        """Begin an episode."""

    def step(self, observation: Observation) -> AnyArray:
        """The action for an observation."""


class NumpyPlayer:
    """Plays an exported NumPy module.

    :param path: the module
    """

    def __init__(self, path: Path) -> None:
        spec = importlib.util.spec_from_file_location(f"exported_{path.stem.replace('-', '_')}", path)
        if spec is None or spec.loader is None:
            raise ConfigError(f"{path} is not a Python module")
        self.module: Any = importlib.util.module_from_spec(spec)
        spec.loader.exec_module(self.module)
        self.closed_form = False
        self.reset()

    def reset(self) -> None:
        """Begin an episode."""
        self.state = self.module.initial_state()

    def step(self, observation: Observation) -> AnyArray:
        """The action for an observation."""
        self.module.CLOSED_FORM = self.closed_form
        action, self.state = self.module.step(*(observation[key] for key in GOAL_KEYS), self.state)
        return np.asarray(action)


class OnnxPlayer:
    """Plays an exported ONNX graph in onnxruntime.

    :param path: the graph
    :raises ConfigError: if onnxruntime is not installed
    """

    def __init__(self, path: Path) -> None:
        onnxruntime = require("onnxruntime", extra="export", what="--check with --format onnx")
        options = onnxruntime.SessionOptions()
        options.intra_op_num_threads = 1
        # its content, as onnxruntime takes only names that are UTF-8
        self.session = onnxruntime.InferenceSession(path.read_bytes(), options, providers=["CPUExecutionProvider"])
        self.inputs = [i for i in self.session.get_inputs() if i.name not in GOAL_KEYS]
        self.outputs = [o.name for o in self.session.get_outputs()]
        self.reset()

    def reset(self) -> None:
        """Begin an episode."""
        kinds = {"tensor(float)": np.float32, "tensor(double)": np.float64}
        self.state = {i.name: np.zeros((1, i.shape[1]), kinds[i.type]) for i in self.inputs}
        self.state["elapsed"] -= 1.0

    def step(self, observation: Observation) -> AnyArray:
        """The action for an observation."""
        goal = {key: np.asarray(observation[key], np.float32)[None] for key in GOAL_KEYS}
        results = dict(zip(self.outputs, self.session.run(None, {**goal, **self.state}), strict=True))
        self.state = {name: results[f"next_{name}"] for name in self.state}
        return np.asarray(results["action"][0])


class CPlayer:
    """Compiles an exported C file with all warnings as errors, and plays it.

    :param path: the C file
    :param policy: the exported policy, for the sizes
    :param flags: further compiler options
    :raises ConfigError: if there is no C compiler, or if it fails
    """

    def __init__(self, path: Path, policy: ExportedPolicy, flags: tuple[str, ...] = ("-O2",)) -> None:
        compiler = shutil.which("cc") or shutil.which("gcc")
        if compiler is None:
            raise ConfigError("checking a C policy needs a C compiler (cc or gcc)")
        self._folder = tempfile.TemporaryDirectory()
        library = Path(self._folder.name) / "policy.so"
        command = [compiler, *STRICT, *flags, "-shared", "-fPIC", str(path), "-o", str(library), "-lm"]
        built = subprocess.run(command, capture_output=True, text=True)
        if built.returncode != 0:
            raise ConfigError(f"{compiler} could not compile {path}: {one_line(built.stderr, 1000)}")
        self.library = ctypes.CDLL(str(library))
        self.policy, self.closed_form = policy, False
        self._state = ctypes.create_string_buffer(64 + 8 * (policy.subgoal_dim + policy.state_dim))
        self._action = np.zeros(len(policy.action_low), np.float32)
        self.reset()

    def reset(self) -> None:
        """Begin an episode."""
        self.library.tbc_reset(self._state)

    def step(self, observation: Observation) -> AnyArray:
        """The action for an observation."""
        goal = [np.ascontiguousarray(observation[key], np.float32) for key in GOAL_KEYS]
        pointers = [part.ctypes.data_as(ctypes.c_void_p) for part in (*goal, self._action)]
        self.library.tbc_step(self._state, *pointers[:3], int(self.closed_form), pointers[3])
        return self._action.copy()

    def low_step_seconds(self, closed_form: bool = False, calls: int = 200) -> float:
        """Shortest time of a low-level step, seconds, without the call from Python."""
        membrane = np.zeros(self.policy.state_dim + 1, np.float32)
        seen, mean = np.full(self.policy.n_low_inputs, 0.3, np.float32), np.zeros_like(self._action)
        pointers = [part.ctypes.data_as(ctypes.c_void_p) for part in (membrane, seen, mean)]
        step, reset = self.library.tbc_low_mean, self.library.tbc_reset
        best = [np.inf, np.inf]
        for _ in range(300):
            start = time.perf_counter()
            for _ in range(calls):
                step(pointers[0], pointers[1], int(closed_form), pointers[2])
            middle = time.perf_counter()
            for _ in range(calls):
                reset(self._state)
            end = time.perf_counter()
            best = [min(best[0], middle - start), min(best[1], end - middle)]
        return float(best[0] - best[1]) / calls


class Score(NamedTuple):
    """Finished episodes and how many of them succeeded."""

    finished: int
    successes: int

    def __str__(self) -> str:
        return f"{self.successes} of {self.finished} episodes"


class CheckResult(NamedTuple):
    """Result of a comparison."""

    steps: int
    episodes: int
    windows: int
    max_difference: float
    rms_difference: float
    score: Score

    def __str__(self) -> str:
        return (
            f"checked: {self.steps} steps, {self.episodes} episodes, {self.windows} windows; largest difference from "
            f"predict(deterministic=True): {self.max_difference:.2g}"
        )


class Departure(NamedTuple):
    """A policy that computes otherwise than its agent: actions on the agent's states, and success when each acts alone.

    It takes the closed form or has rounded weights.
    """

    name: str
    beside: CheckResult
    alone: Score
    half_range: float  # of the widest action
    advice: str

    @property
    def share(self) -> float:
        """Root mean square difference of actions as a share of half their range."""
        return self.beside.rms_difference / self.half_range

    def __str__(self) -> str:
        text = (
            f"{self.name}: actions differ from predict's by {self.beside.rms_difference:.2g} rms and "
            f"{self.beside.max_difference:.2g} at most; acting alone for {self.beside.steps} steps it succeeds in "
            f"{self.alone}, the agent in {self.beside.score}"
        )
        if self.share <= TOLERANCE:
            return text
        return (
            f"{text}\nWARNING: with {self.name} it does not act as this agent does (rms {self.share:.0%} of half the "
            f"range of actions): {self.advice}"
        )


INTEGRATE = (
    "deploy the integrated form. The closed form fits agents better that keep their potentials (memory window or "
    "episode) than agents that start every step from rest."
)
KEEP_FLOATS = "compare the successes, over more steps, or export with --weights float32."


def player(kind: str, path: Path, policy: ExportedPolicy) -> Player:
    """The player for a format."""
    if kind == "c":
        return CPlayer(path, policy)
    return NumpyPlayer(path) if kind == "numpy" else OnnxPlayer(path)


def check(
    model: TBCHRL, policy: ExportedPolicy, kind: str, path: Path, info: PlainMapping, steps: int, seed: int
) -> str:
    """Compare the exported policy with ``predict(deterministic=True)`` on the observations of the agent's episodes.

    :param model: the agent
    :param policy: the exported policy
    :param kind: ``"onnx"``, ``"c"`` or ``"numpy"``
    :param path: the exported file
    :param info: ``env_id`` and ``env_kwargs`` of the task
    :param steps: environment steps; episodes follow one another
    :param seed: seed of the first episode
    :return: text to print: the comparison, of weights of eight bits or else also of a circuit's closed form, and the
        time of a step in C
    :raises ConfigError: if the environment is none that the agent can act in
    """
    env = make_env(info["env_id"], **(info.get("env_kwargs") or {}))
    exported = player(kind, path, policy)
    try:
        refuse_other_spaces(model, env)
        if policy.weights == "int8":
            lines = [str(compare_rounded(model, exported, env, steps, seed))]
        else:
            lines = [str(compare(model, exported, env, steps, seed))]
            if isinstance(policy.low, Circuit) and isinstance(exported, CPlayer | NumpyPlayer):
                lines.append(str(compare_closed_form(model, exported, env, steps, seed)))
        if isinstance(exported, CPlayer):
            lines.append(f"one low-level step on this machine: {1e6 * exported.low_step_seconds():.2f} us")
        return "\n".join(lines)
    finally:
        env.close()


def compare(model: TBCHRL, exported: Player, env: Env, steps: int, seed: int = 0) -> CheckResult:
    """Compare the actions of an exported policy with the agent's, see :func:`check`."""
    beside = _Beside(model, exported)
    score = play(beside, env, steps, seed)
    difference = np.abs(beside.differences)
    rms = float(np.sqrt(np.mean(difference**2)))
    return CheckResult(steps, beside.episodes, beside.windows, float(difference.max()), rms, score)


def compare_closed_form(
    model: TBCHRL, exported: CPlayer | NumpyPlayer, env: Env, steps: int, seed: int = 0
) -> Departure:
    """Compare the closed form of an exported circuit with the agent, then let it act alone."""
    exported.closed_form = True
    return _departure("the closed form", INTEGRATE, model, exported, env, steps, seed)


def compare_rounded(model: TBCHRL, exported: Player, env: Env, steps: int, seed: int = 0) -> Departure:
    """Compare a policy with weights of eight bits with the agent, then let it act alone."""
    return _departure("weights of eight bits", KEEP_FLOATS, model, exported, env, steps, seed)


def _departure(name: str, advice: str, model: TBCHRL, exported: Player, env: Env, steps: int, seed: int) -> Departure:
    exported.reset()
    beside = compare(model, exported, env, steps, seed)
    exported.reset()
    actions = action_box(model)
    half_range = 0.5 * float(np.max(actions.high - actions.low))
    return Departure(name, beside, play(exported, env, steps, seed), half_range, advice)


def play(who: Player, env: Env, steps: int, seed: int = 0) -> Score:
    """Let a player act for some steps; episodes follow one another, and the last one may be incomplete."""
    observation, _ = env.reset(seed=seed)
    finished = successes = 0
    for _ in range(steps):
        observation, _, terminated, truncated, info = env.step(who.step(observation))
        if terminated or truncated:
            finished, successes = finished + 1, successes + int(info.get("is_success", False))
            observation, _ = env.reset()
            who.reset()
    return Score(finished, successes)


class _Beside:
    """A player that acts as the agent and records the differences of the exported policy's actions."""

    def __init__(self, model: TBCHRL, exported: Player) -> None:
        self.model, self.exported = model, exported
        self.state: tuple[AnyArray, ...] | None = None
        self.differences: list[AnyArray] = []
        self.episodes, self.windows = 1, 0

    def reset(self) -> None:
        """Begin an episode."""
        self.exported.reset()
        self.state = None
        self.episodes += 1

    def step(self, observation: Observation) -> AnyArray:
        """The agent's action for an observation."""
        action, self.state = self.model.predict(dict(observation), self.state, deterministic=True)
        self.differences.append(action - self.exported.step(observation))
        self.windows += int(self.state is not None and self.state[2][0] == 1)
        return action


class Cortex(NamedTuple):
    """Size of the low level on a Cortex-M4, bytes."""

    flash: int  # code and constants, without the mathematical library
    library: int  # expf and tanhf, as linked
    stack: int
    state: int


def cortex_m4(path: Path) -> Cortex | None:
    """Size of an exported C file's low level, compiled with ``-Os``; None without ``arm-none-eabi-gcc``."""
    compiler = shutil.which("arm-none-eabi-gcc")
    if compiler is None:
        return None
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        source, target = folder / "policy.c", folder / "policy.o"
        source.write_text(path.read_text(encoding="utf-8"), encoding="utf-8")
        run = [compiler, *CORTEX_M4, "-ffunction-sections", "-fdata-sections"]
        flags = [*SMALLEST, "-fstack-usage", "-c", str(source), "-o", str(target)]
        subprocess.run([*run, *flags], check=True, capture_output=True)
        usage = (folder / "policy.su").read_text(encoding="utf-8")
        flash, data, bss = _sections(target)
        library = _linked(run, folder, source) - flash
    state = 4 * (int(_macro(path, "TBC_STATE")) + 1)
    return Cortex(flash + data, library, sum(int(n) for n in re.findall(r"\t(\d+)\t", usage)), state + bss)


def cortex_m4_report(path: Path) -> str:
    """The sizes as one line, or why they were not measured."""
    advice = "Debian: apt install gcc-arm-none-eabi libnewlib-arm-none-eabi"
    try:
        size = cortex_m4(path)
    except (OSError, subprocess.CalledProcessError) as error:  # a compiler without its library, for example
        said = error.stderr.decode(errors="replace") if isinstance(error, subprocess.CalledProcessError) else str(error)
        return f"Cortex-M4 size: not measured (the compiler failed: {one_line(said)}; {advice})"
    if size is None:
        return f"Cortex-M4 size: not measured (arm-none-eabi-gcc not found; {advice})"
    return (
        f"Cortex-M4, low level in single precision, integrated: {size.flash} bytes of flash, {size.library} more for "
        f"the mathematical library; RAM {size.state} bytes of state and at most {size.stack} of stack"
    )


def _linked(run: list[str], folder: Path, source: Path) -> int:
    """Flash of a linked program with the low level, minus that of an empty program."""
    call = "static volatile float m[TBC_STATE + 1], s[TBC_LOW_INPUT], a[TBC_ACTION];\n"
    call += "int main(void) { tbc_low_mean((float *)m, (const float *)s, (int)m[0], (float *)a); return 0; }\n"
    programs = {"full": f'#include "{source.name}"\n{call}', "empty": "int main(void) { return 0; }\n"}
    sizes = {}
    for name, text in programs.items():
        main = folder / f"{name}.c"
        main.write_text(text, encoding="utf-8")
        elf = folder / f"{name}.elf"
        link = ["--specs=nosys.specs", "-Wl,--gc-sections", str(main), "-o", str(elf), "-lm"]
        subprocess.run([*run, *SMALLEST, *link], check=True, capture_output=True)
        sizes[name] = _sections(elf)[0]
    return sizes["full"] - sizes["empty"]


def _sections(path: Path) -> tuple[int, int, int]:
    """Bytes of text, data and bss."""
    output = subprocess.run(["arm-none-eabi-size", str(path)], check=True, capture_output=True).stdout
    text, data, bss = output.decode().splitlines()[1].split()[:3]
    return int(text), int(data), int(bss)


def _macro(path: Path, name: str) -> str:
    found = re.search(rf"#define {name} (\S+)", path.read_text(encoding="utf-8"))
    if found is None:
        raise ConfigError(f"{path} was not written by this version of the exporter: no {name}")
    return found.group(1)
