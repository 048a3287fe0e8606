"""Measurements of ``python -m sb3_tbc.benchmark train``: training speed beside SAC of SB3 and SBX, and its parts."""

from __future__ import annotations

import argparse
import gc
import os
import resource
import statistics
import subprocess
import sys
import time
from collections.abc import Callable, Sequence
from functools import partial
from importlib import import_module
from importlib.util import find_spec
from pathlib import Path
from typing import Any, NamedTuple

import gymnasium as gym
import numpy as np
import torch as th
from stable_baselines3.common.base_class import BaseAlgorithm

from sb3_tbc.aliases import Env, Plain, Space
from sb3_tbc.benchmark.floor import gemm_rate, products
from sb3_tbc.benchmark.profile import OUTSIDE, PARTS, profile
from sb3_tbc.errors import ConfigError
from sb3_tbc.level.compilation import compiler_problem
from sb3_tbc.ndbc.network import SYNAPSES
from sb3_tbc.tbc_hrl import TBCHRL
from sb3_tbc.tbc_hrl.config import TBCConfig
from sb3_tbc.zoo.algorithms import build_model
from sb3_tbc.zoo.config import RunConfig, load_config
from sb3_tbc.zoo.environments import make_envs, resolve_env

WHAT = ("speed", "split", "floor", "update", "growth", "n-envs", "memory", "budget")
BUDGET_MINUTES = {
    "Pendulum": 5,
    "UR5Reacher": 12,
    "Drawbridge": 12,
    "AntFourRooms": 45,
    "Platforms": 90,
    "Tennis2D": 360,
}
"""How long a full budget of table 1 may take on one core."""
ROW_LIMIT = 50_000
"""Rows written at once when buffers are filled artificially."""

Figures = Plain
Result = tuple[list[str], Figures]


def one_core() -> None:
    """Keep this process, and what it starts, on one core and one thread."""
    th.set_num_threads(1)
    if hasattr(os, "sched_setaffinity"):
        os.sched_setaffinity(0, {max(os.sched_getaffinity(0))})


def ours(task: str, n_envs: int | None = 1, config: str | None = None, **settings: object) -> TBCHRL:
    """TBC-HRL with the shipped settings of a task, compiled from the first update on if possible.

    :param n_envs: parallel environments; None for the configuration's number
    """
    task, env_id = resolve_env(task)
    run = load_config("tbc-hrl", task, config)
    model = {**run.model, "compile": compiler_problem() is None, **settings}
    n_envs = run.n_envs if n_envs is None else n_envs
    run = RunConfig("tbc-hrl", task, run.config, run.n_timesteps, n_envs, run.env_kwargs, model)
    agent = build_model(run, make_envs(env_id, n_envs, 0, run.env_kwargs), 0)
    assert isinstance(agent, TBCHRL)
    return agent


def contenders(task: str, config: str | None = None) -> dict[str, BaseAlgorithm]:
    """TBC-HRL, SB3's SAC and, if installed, SBX's SAC, on the same task.

    The flat agents get the low level's network sizes and batch size, as many updates as it does, and the observation as
    one flat vector, with which they are fastest.
    """
    model = ours(task, config=config)
    warm_up(model, 1000)
    found: dict[str, BaseAlgorithm] = {"TBC-HRL": model}
    from stable_baselines3 import SAC

    kinds: Plain = {"SB3 SAC": SAC}
    if find_spec("sbx") is not None:
        kinds["SBX SAC"] = import_module("sbx").SAC
    task, env_id = resolve_env(task)
    env_kwargs = load_config("tbc-hrl", task, config).env_kwargs
    for name, kind in kinds.items():
        env = gym.wrappers.FlattenObservation(gym.make(env_id, **env_kwargs))
        found[name] = _flat(kind, env, model.config)
    return found


def _flat(kind: type[BaseAlgorithm], env: Env, config: TBCConfig) -> BaseAlgorithm:
    settings, ratio = config.low.to_dict(), config.updates_per_step(config.low)
    arguments: Plain = dict(
        batch_size=settings["batch_size"],
        learning_starts=settings["batch_size"],
        buffer_size=settings["buffer_size"],
        train_freq=max(1, round(1 / ratio)),
        gradient_steps=max(1, round(ratio)),
        policy_kwargs={"net_arch": list(settings["policy_kwargs"]["net_arch"])},
        seed=0,
    )
    return kind("MlpPolicy", env, **arguments)


def warm_up(model: TBCHRL, steps: int) -> None:
    """Train until both levels update: a level begins after an episode, when its buffer holds a batch."""
    model.learn(max(steps, 1000), reset_num_timesteps=False)
    while not (model.high._n_updates and model.low._n_updates):
        model.learn(steps, reset_num_timesteps=False)


class Speed(NamedTuple):
    """Seconds of a stretch of learning."""

    cpu: float
    wall: float
    steps: int


def stretch(model: BaseAlgorithm, steps: int) -> Speed:
    """Learn on for some steps."""
    before, cpu, wall = model.num_timesteps, time.process_time(), time.perf_counter()
    model.learn(steps, reset_num_timesteps=False)
    return Speed(time.process_time() - cpu, time.perf_counter() - wall, int(model.num_timesteps - before))


def speed(task: str, steps: int, rounds: int, config: str | None = None) -> Result:
    """Environment steps per second while learning, in turns; the first stretch of each is not counted."""
    found = contenders(task, config)
    for model in found.values():
        stretch(model, max(steps, 1000))
    runs: dict[str, list[Speed]] = {name: [] for name in found}
    for _ in range(rounds):
        for name, model in found.items():
            runs[name].append(stretch(model, steps))
    rows = {
        name: {
            "steps_per_cpu_second": statistics.median(s.steps / s.cpu for s in stretches),
            "steps_per_second": statistics.median(s.steps / s.wall for s in stretches),
        }
        for name, stretches in runs.items()
    }
    lines = [f"| {task}, learning | steps per CPU second | steps per second | times SB3 (CPU) |", "|---|---|---|---|"]
    for name, row in rows.items():
        row["times_sb3"] = row["steps_per_cpu_second"] / rows["SB3 SAC"]["steps_per_cpu_second"]
        cells = f"{row['steps_per_cpu_second']:.0f} | {row['steps_per_second']:.0f} | {row['times_sb3']:.2f}"
        lines.append(f"| {name} | {cells} |")
    return lines, rows


def split(task: str, steps: int, rounds: int, config: str | None = None, n_envs: int | None = None) -> Result:
    """Microseconds of an environment step in each part; medians over the rounds."""
    model = ours(task, n_envs, config)
    warm_up(model, steps)
    runs = [profile(model, steps) for _ in range(rounds)]
    parts = {part: statistics.median(run[part] for run in runs) for part in PARTS}
    outside = sum(parts[part] for part in OUTSIDE)
    share = outside / parts["environment"]  # of the row's own figures: a median of shares would contradict them
    lines = [
        f"| {task}, {model.n_envs} at once, microseconds per step | {' | '.join(PARTS)} |"
        " all but environment, batches, updates |",
        "|---" * (len(PARTS) + 2) + "|",
        f"| | {' | '.join(f'{parts[p]:.1f}' for p in PARTS)} | {outside:.1f} = {share:.0%} of the environment's |",
    ]
    return lines, {"parts": parts, "outside": outside, "share_of_environment": share}


def floor(task: str, steps: int, rounds: int, config: str | None = None) -> Result:
    """A step beside what it cannot do without: the environment's own step and the updates' matrix products."""
    model = ours(task, config=config)
    warm_up(model, steps)
    runs = [profile(model, steps) for _ in range(rounds)]
    step = statistics.median(sum(run.values()) for run in runs)
    environment = statistics.median(run["environment"] for run in runs)
    levels = {"high": model.config.high, "low": model.config.low}
    ratios = {name: model.config.updates_per_step(level) for name, level in levels.items()}
    done = {name: products(getattr(model, name), level.batch_size, 10 * rounds) for name, level in levels.items()}
    rate = gemm_rate(10 * rounds)
    own = sum(ratios[name] * level.microseconds for name, level in done.items())
    best = 1e6 * sum(ratios[name] * level.flops for name, level in done.items()) / rate
    figures: Figures = {
        "step": step, "environment": environment, "products": own, "products_at_best_rate": best,
        "gflops_per_second": rate / 1e9, "levels": {name: level._asdict() for name, level in done.items()},
    }  # fmt: skip
    counts = [f"{v.number} of {v.flops / 1e6:.1f} MFLOP on the {k} level" for k, v in done.items()]
    often = " and ".join(f"{ratio:g} of the {name} level" for name, ratio in ratios.items())
    lines = [
        f"| {task}, microseconds per step | environment | products, as fast as their shapes allow |"
        f" the same at {rate / 1e9:.0f} GFLOP/s | floor | a step | times the floor |",
        "|---" * 7 + "|",
        f"| | {environment:.1f} | {own:.1f} | {best:.1f} | {environment + own:.1f} | {step:.1f} |"
        f" {step / (environment + own):.2f} |",
        "",
        f"Products of an update: {', '.join(counts)}; updates per step: {often}.",
    ]
    return lines, figures


def update(rounds: int, batch_size: int = 256, burst: int = 64) -> Result:
    """One low-level update with a circuit, K = 3, both kinds of synapses, beside SB3's SAC with the same critics."""
    from stable_baselines3 import SAC

    from sb3_tbc.benchmark.cells import in_turns

    circuits = {synapses: ours("Pendulum", low={"batch_size": batch_size, "policy_kwargs": {
        "net_arch": [32, 32], "mean_bound": 3.0, "ndbc": {"inter": 6, "command": 6, "motor": 1, "sensory_fanout": 3,
        "inter_fanout": 4, "recurrent_command_synapses": 1, "motor_fanin": 4, "sub_steps": 3, "synapses": synapses}}})
        for synapses in SYNAPSES}  # fmt: skip
    for circuit in circuits.values():
        circuit.learn(600)
    sac = SAC("MlpPolicy", _level_env(circuits["paper"]), policy_kwargs={"net_arch": [32, 32]}, batch_size=batch_size,
              learning_starts=10**9, seed=0).learn(600)  # fmt: skip
    jobs = {
        "TBC-HRL, low level, NDBC K=3": lambda: circuits["paper"].low.train(burst, batch_size),
        "the same, lean synapses": lambda: circuits["lean"].low.train(burst, batch_size),
        "SB3 SAC, MLP": lambda: sac.train(burst, batch_size),
    }
    seconds = in_turns(jobs, rounds)
    rows = {name: 1e3 * statistics.median(values) / burst for name, values in seconds.items()}
    mine, *_, theirs = rows.values()
    lines = [f"| one update, batch {batch_size}, critics 32x32 | ms |", "|---|---|"]
    lines += [f"| {name} | {milliseconds:.3f} |" for name, milliseconds in rows.items()]
    return [*lines, f"| ratio | {theirs / mine:.2f} |"], {"ms": rows, "ratio": theirs / mine}


class _SpacesEnv(Env):
    """Random observations in the low level's spaces, so that SB3's networks have the circuit's inputs and outputs."""

    def __init__(self, observation_space: Space, action_space: Space) -> None:
        self.observation_space, self.action_space = observation_space, action_space

    def reset(self, *, seed: int | None = None, options: Plain | None = None) -> tuple[Any, Plain]:
        super().reset(seed=seed)
        return self.np_random.standard_normal(self.observation_space.shape or ()).astype(np.float32), {}

    def step(self, action: Any) -> tuple[Any, float, bool, bool, Plain]:
        return self.reset()[0], 0.0, False, False, {}


def _level_env(model: TBCHRL) -> Env:
    return _SpacesEnv(model.low.observation_space, model.low.action_space)


def fill(model: TBCHRL, steps: int) -> None:
    """Fill both replay buffers as after this many environment steps, by repeating their content.

    :raises ValueError: if there is nothing to repeat
    """
    for buffer in model.replay_buffer:
        if not buffer.size():
            raise ValueError("a buffer without a finished episode cannot be filled: learn for longer first")
        wanted = min(buffer.buffer_size, round(buffer.size() * steps / model.num_timesteps))
        held = {name: array[: buffer.size()].copy() for name, array in buffer.data.items()}
        rows = len(next(iter(held.values())))
        times = max(1, min(ROW_LIMIT, buffer.buffer_size) // rows)
        block = {name: np.tile(array, (times, 1)) for name, array in held.items()}
        while buffer.size() < wanted:
            room = wanted - buffer.size()
            buffer._extend({name: array[:room] for name, array in block.items()})


def growth(task: str, steps: int, rounds: int, config: str | None = None) -> Result:
    """CPU time per step as the buffers fill: nearly empty, then full."""
    model = ours(task, config=config)
    warm_up(model, steps)
    figures: Figures = {}
    for name in ("empty", "full"):
        if name == "full":
            fill(model, full_budget(task))
            stretch(model, steps)
        stretches = [stretch(model, steps) for _ in range(rounds)]
        figures[name] = {
            "rows": [buffer.size() for buffer in model.replay_buffer],
            "us_per_step": [1e6 * s.cpu / s.steps for s in stretches],
        }
    medians = {name: statistics.median(figure["us_per_step"]) for name, figure in figures.items()}
    figures["ratio"] = medians["full"] / medians["empty"]
    lines = [
        f"| {task}, microseconds per step | " + " | ".join(f"block {i + 1}" for i in range(rounds)) + " | median |"
    ]
    lines.append("|---" * (rounds + 2) + "|")
    for name, median in medians.items():
        rows = " + ".join(f"{n:,}" for n in figures[name]["rows"])
        cells = " | ".join(f"{x:.0f}" for x in figures[name]["us_per_step"])
        lines.append(f"| buffers hold {rows} | {cells} | {median:.0f} |")
    return lines, figures


def n_envs(
    task: str, steps: int, rounds: int, config: str | None = None, counts: Sequence[int] = (1, 2, 4, 8)
) -> Result:
    """CPU time per environment step over the number of environments side by side."""
    figures: Figures = {}
    for count in counts:
        model = ours(task, count, config)
        warm_up(model, steps)
        runs = [stretch(model, steps * count) for _ in range(rounds)]
        figures[str(count)] = statistics.median(1e6 * s.cpu / s.steps for s in runs)
    lines = [f"| {task}, environments | {' | '.join(figures)} |", "|---" * (len(figures) + 1) + "|"]
    lines.append("| microseconds per environment step | " + " | ".join(f"{x:.0f}" for x in figures.values()) + " |")
    return lines, figures


def memory(task: str, config: str | None = None) -> Result:
    """Peak memory of a whole process of its own that learns with full buffers."""
    code = f"import sb3_tbc.benchmark.training as b; print(b.peak_memory({task!r}, {config!r}))"
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    megabytes = float(done.stdout.split()[-1])
    return [f"{task}: {megabytes:.0f} MB, the whole process, buffers of the full budget"], {"megabytes": megabytes}


def peak_memory(task: str, config: str | None = None) -> float:
    """Learn, fill the buffers as the full budget would, learn on; the peak of this process in MB."""
    model = ours(task, config=config, learning_starts=0)
    steps = 3 * round(model.rules.dt_max * model.rules.max_options)  # episodes
    model.learn(steps)
    fill(model, full_budget(task))
    gc.collect()
    model.learn(steps, reset_num_timesteps=False)
    status = Path("/proc/self/status")
    if status.is_file():  # the other way counts what the process was forked from, too
        (line,) = (line for line in status.read_text().splitlines() if line.startswith("VmHWM"))
        return int(line.split()[1]) / 1024
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / (1024 if sys.platform == "linux" else 1024**2)


def full_budget(task: str) -> int:
    """Environment steps of the paper's table 1."""
    return load_config("tbc-hrl", resolve_env(task)[0]).n_timesteps


def budget(task: str, steps: int, rounds: int, config: str | None = None) -> Result:
    """Time of the full budget: CPU time per step with full buffers, times the steps of table 1."""
    model = ours(task, config=config, learning_starts=0)
    total = full_budget(task)
    stretch(model, max(steps, 1000))
    fill(model, total)
    stretch(model, steps)
    runs = [stretch(model, steps) for _ in range(rounds)]
    per_step = statistics.median(s.cpu / s.steps for s in runs)
    minutes = per_step * total / 60
    allowed = BUDGET_MINUTES.get(task)
    limit = "" if allowed is None else f", {allowed} allowed"
    lines = [f"{task}: {1e6 * per_step:.0f} microseconds a step, {total:,} steps in {minutes:.1f} minutes{limit}"]
    return lines, {"us_per_step": 1e6 * per_step, "n_timesteps": total, "minutes": minutes, "allowed": allowed}


def train(arguments: argparse.Namespace) -> Result:
    """Measure what the arguments ask for; lines to print, and the figures."""
    steps, rounds, config = arguments.steps, arguments.rounds, arguments.config
    unknown = [what for what in arguments.what if what not in WHAT]
    if unknown:
        raise ConfigError(f"no measurement {unknown[0]!r}; there are {', '.join(WHAT)}")
    for task in arguments.tasks:  # before the minutes that the first of them may take
        make_envs(resolve_env(task)[1], 1, 0, load_config("tbc-hrl", task, config).env_kwargs).close()
    one_core()
    lines: list[str] = ["one core, one thread, CPU time unless said; medians of rounds in turns"]
    figures: Figures = {}

    def keep(name: str, measure: Callable[[], Result]) -> None:
        print(f"{name} ...", file=sys.stderr, flush=True)
        more, figures[name] = measure()
        lines.extend(["", *more])

    if "update" in arguments.what:
        keep("update", lambda: update(rounds))
    measurements: dict[str, Callable[..., Result]] = {
        "speed": speed, "split": partial(split, n_envs=arguments.n_envs), "floor": floor, "growth": growth,
        "n-envs": n_envs, "budget": budget,
    }  # fmt: skip
    for task in arguments.tasks:
        for what in arguments.what:
            if what in measurements:
                keep(f"{what} {task}", partial(measurements[what], task, steps, rounds, config))
            elif what == "memory":
                keep(f"memory {task}", partial(memory, task, config))
    return lines, figures
