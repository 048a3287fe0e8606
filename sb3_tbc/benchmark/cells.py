"""Measurements of ``python -m sb3_tbc.benchmark cells``."""

from __future__ import annotations

import argparse
import shutil
import tempfile
import time
from collections.abc import Callable, Mapping, Sequence
from importlib.util import find_spec
from pathlib import Path
from typing import NamedTuple

import numpy as np
import torch as th
from torch import nn

from sb3_tbc.aliases import Env, Plain, PlainMapping
from sb3_tbc.benchmark.circuits import WIRING_NUMBERS
from sb3_tbc.level.actors import NDBCActor
from sb3_tbc.ndbc.closed_form import ClosedFormNDBC
from sb3_tbc.ndbc.frozen import FrozenNDBC
from sb3_tbc.ndbc.network import NDBCNet
from sb3_tbc.ndbc.wiring import NDBCWiring
from sb3_tbc.tbc_hrl import TBCHRL

N_INPUTS, N_OUTPUTS = 10, 4
ANT_FOUR_ROOMS = (12, 10, 8, 5, 8, 2, 6)  # table A1: the largest circuit, 30 neurons

Job = Callable[[], object]

Network = Callable[[th.Tensor], tuple[th.Tensor, object]]
"""A recurrent network: outputs and state from a sequence."""


class Candidate(NamedTuple):
    """A cell to time: its parameters, one pass over a sequence, and one step at batch 1 (None: not timed)."""

    name: str
    parameters: int
    forward: Callable[[th.Tensor], th.Tensor] | None
    step: Job | None
    trained: Sequence[nn.Parameter]


def in_turns(jobs: Mapping[str, Job], rounds: int, calls: int = 1) -> dict[str, list[float]]:
    """CPU seconds per call of every job in every round; each round runs all jobs, so that load affects all alike."""
    for job in jobs.values():
        for _ in range(max(2, calls // 10)):
            job()
    seconds: dict[str, list[float]] = {name: [] for name in jobs}
    for _ in range(rounds):
        for name, job in jobs.items():
            start = time.thread_time()
            for _ in range(calls):
                job()
            seconds[name].append((time.thread_time() - start) / calls)
    return seconds


def ratio(seconds: Mapping[str, list[float]], name: str, reference: str) -> float:
    """Best round of ``name`` against the best of ``reference``."""
    return min(seconds[name]) / min(seconds[reference])


def ndbc_candidate(sub_steps: int, dynamics: str = "conductance", compiled: bool = False) -> Candidate:
    """The 30-neuron circuit of table A1's AntFourRooms."""
    wiring = NDBCWiring(N_INPUTS, *ANT_FOUR_ROOMS)
    net = NDBCNet(N_INPUTS, N_OUTPUTS, wiring, sub_steps=sub_steps, dynamics=dynamics, seed=0)
    frozen = FrozenNDBC(net)
    x, state = np.zeros((1, N_INPUTS), np.float32), np.zeros((1, net.state_dim), np.float32)
    run: Network = th.compile(net, fullgraph=True, dynamic=False) if compiled else net
    label = f"NDBC K={sub_steps}" + (" dissipative" if dynamics != "conductance" else "")
    return Candidate(
        label + (" compiled" if compiled else ""), _count(net), _first(run),
        None if compiled else lambda: frozen(x, state), list(net.parameters()),
    )  # fmt: skip


def closed_form_candidate() -> Candidate:
    """The closed form of the same circuit, in NumPy, only for acting."""
    net = NDBCNet(N_INPUTS, N_OUTPUTS, NDBCWiring(N_INPUTS, *ANT_FOUR_ROOMS), seed=0)
    closed = ClosedFormNDBC(net)
    x, state = np.zeros((1, N_INPUTS), np.float32), np.zeros((1, net.state_dim), np.float32)
    return Candidate("NDBC closed form", _count(net), None, lambda: closed(x, state), [])


def gru_candidate() -> Candidate:
    """A GRU of torch with 32 units and a linear readout."""
    gru, readout = nn.GRU(N_INPUTS, 32, batch_first=True), nn.Linear(32, N_OUTPUTS)
    x, state = th.zeros(1, 1, N_INPUTS), th.zeros(1, 1, 32)

    @th.no_grad()
    def step() -> th.Tensor:
        result: th.Tensor = readout(gru(x, state)[0])
        return result

    return Candidate(
        "GRU(32)", _count(gru) + _count(readout), lambda inputs: readout(gru(inputs)[0]), step,
        [*gru.parameters(), *readout.parameters()],
    )  # fmt: skip


def ncps_candidates() -> list[Candidate]:
    """Wired LTC of ncps (6 unfolds) and CfC with 30 units; empty if ncps is not installed."""
    if find_spec("ncps") is None:
        return []
    from ncps.torch import LTC, CfC
    from ncps.wirings import AutoNCP

    candidates = []
    for name, cell in (("ncps LTC, 6 unfolds", LTC), ("ncps CfC, wired", CfC)):
        net = cell(N_INPUTS, AutoNCP(30, N_OUTPUTS, seed=0), batch_first=True)
        x, state = th.zeros(1, 1, N_INPUTS), th.zeros(1, 30)

        @th.no_grad()
        def step(net: nn.Module = net, x: th.Tensor = x, state: th.Tensor = state) -> object:
            return net(x, state)

        trained = [p for p in net.parameters() if p.requires_grad]
        candidates.append(Candidate(name, sum(p.numel() for p in trained), _first(net), step, trained))
    return candidates


def cells(arguments: argparse.Namespace) -> tuple[list[str], Plain]:
    """Time all cells; lines to print, and the figures."""
    th.set_num_threads(1)
    candidates = [ndbc_candidate(k) for k in (1, 3, 6)]
    candidates += [ndbc_candidate(3, "dissipative"), closed_form_candidate(), gru_candidate(), *ncps_candidates()]
    if arguments.compile:
        candidates.append(ndbc_candidate(3, compiled=True))
    inputs = th.randn(arguments.batch, arguments.time, N_INPUTS)
    trainable = [c for c in candidates if c.forward]
    forward = in_turns({c.name: _forward(c, inputs) for c in trainable}, arguments.rounds)
    both = in_turns({c.name: _forward_backward(c, inputs) for c in trainable}, arguments.rounds)
    step = in_turns({c.name: c.step for c in candidates if c.step}, arguments.rounds, calls=200)
    rows = [_row(c, forward, both, step) for c in candidates]
    lines = [
        f"batch {arguments.batch}, {arguments.time} steps, {N_INPUTS} inputs, {N_OUTPUTS} outputs, one torch thread; "
        f"CPU time, best of {arguments.rounds} rounds in turns",
        *_table(rows),
    ]
    figures: Plain = {"cells": rows}
    if "ncps LTC, 6 unfolds" in both:
        figures["ltc_against_ndbc_k3"] = ratio(both, "ncps LTC, 6 unfolds", "NDBC K=3")
        lines += ["", f"LTC with 6 unfolds takes {figures['ltc_against_ndbc_k3']:.1f} times as long as NDBC, K = 3."]
    more, figures["acting"] = acting(arguments.rounds)
    lines += ["", more]
    if not arguments.no_growth:
        grown, figures["growth"] = growth(arguments.batch, max(3, arguments.rounds // 4))
        lines += ["", *grown]
    return lines, figures


Seconds = Mapping[str, list[float]]


def _row(candidate: Candidate, forward: Seconds, both: Seconds, step: Seconds) -> Plain:
    name = candidate.name
    row: Plain = {"cell": name, "parameters": candidate.parameters}
    if name in both:
        row["forward_ms"] = 1e3 * min(forward[name])
        row["both_ms"] = 1e3 * min(both[name])
        row["against_gru"] = ratio(both, name, "GRU(32)")
    if name in step:
        row["step_us"] = 1e6 * min(step[name])
    return row


def _table(rows: Sequence[PlainMapping]) -> list[str]:
    """The rows as a Markdown table."""
    columns = {"forward_ms": 2, "both_ms": 2, "against_gru": 2, "step_us": 1}
    lines = [
        "",
        "| cell | parameters | forward, ms | forward + backward, ms | against GRU(32) | one step, batch 1, us |",
        "|---|---|---|---|---|---|",
    ]
    for row in rows:
        figures = [f"{row[name]:.{digits}f}" if name in row else "-" for name, digits in columns.items()]
        lines.append(f"| {row['cell']} | {row['parameters']} | {' | '.join(figures)} |")
    return lines


def growth(batch: int, rounds: int) -> tuple[list[str], Plain]:
    """Forward + backward over K, over time, and over synapses, each with a straight line fitted."""
    eight = th.randn(batch, 8, N_INPUTS)
    jobs: dict[str, dict[int, Job]] = {
        "K": {k: _forward_backward(ndbc_candidate(k), eight) for k in (1, 2, 3, 4, 6, 8)},
        "time": {t: _forward_backward(ndbc_candidate(3), th.randn(batch, t, N_INPUTS)) for t in (4, 8, 16, 32)},
        "synapses": {},
    }
    for size in (1, 2, 4, 8):
        wiring = NDBCWiring(N_INPUTS, 6 * size, 6 * size, size, 3 * size, 4, 1, 4)
        net = NDBCNet(N_INPUTS, N_OUTPUTS, wiring, seed=0)
        candidate = Candidate("", 0, _first(net), None, list(net.parameters()))
        jobs["synapses"][wiring.n_synapses] = _forward_backward(candidate, eight)
    lines = ["Growth of forward + backward, ms (a straight line explains the share R2 of the variance):", ""]
    figures: Plain = {}
    for what, parts in jobs.items():
        seconds = in_turns({str(size): job for size, job in parts.items()}, rounds)
        line, figures[what] = _straight_line(what, {size: 1e3 * min(seconds[str(size)]) for size in parts}, "ms")
        lines.append(line)
    in_c = exported_steps()
    if in_c:
        line, figures["synapses_in_c"] = _straight_line("synapses, one step of the exported C file, us", in_c, "us")
        lines.append(line)
    return lines, figures


def _straight_line(what: str, times: Mapping[int, float], unit: str) -> tuple[str, Plain]:
    """A line of text and the figures of one curve, with the share of variance that a straight line explains."""
    x, y = np.array(list(times), dtype=float), np.array(list(times.values()))
    rest = y - np.polyval(np.polyfit(x, y, 1), x)
    r2 = 1.0 - float((rest**2).sum() / ((y - y.mean()) ** 2).sum())
    pairs = ", ".join(f"{size}: {value:.2f}" for size, value in times.items())
    return f"* {what}: {pairs} (R2 {r2:.3f})", {"sizes": x.tolist(), unit: y.tolist(), "r2": r2}


def _small_agent(task: str, numbers: Sequence[int]) -> tuple[TBCHRL, Env]:
    """An untrained agent of a task with a circuit of these numbers, and the task."""
    import gymnasium as gym

    import sb3_tbc.tasks

    sb3_tbc.tasks.register_tasks()
    env: Env = gym.make(f"sb3_tbc/{task}-v0")
    circuit = {"policy_kwargs": {"ndbc": dict(zip(WIRING_NUMBERS, numbers, strict=True))}}
    return TBCHRL("MultiInputPolicy", env, seed=0, compile=False, low=circuit), env


def _circuit(model: TBCHRL) -> NDBCNet:
    actor = model.low.policy.average_actor
    if not isinstance(actor, NDBCActor):
        raise TypeError(f"expected a circuit as low level, got {type(actor).__name__}")
    return actor.net


def exported_steps() -> dict[int, float]:
    """Microseconds of one low-level step in C by number of synapses; empty without a C compiler."""
    if shutil.which("cc") is None:
        return {}
    from sb3_tbc.export.c99 import to_c
    from sb3_tbc.export.check import CPlayer
    from sb3_tbc.export.policy import extract

    times = {}
    with tempfile.TemporaryDirectory() as folder:
        for size in (1, 2, 4, 8):
            model, _ = _small_agent("Pendulum", (6 * size, 6 * size, size, 3 * size, 4, 1, 4))
            policy, path = extract(model), Path(folder) / f"policy{size}.c"
            path.write_text(to_c(policy), encoding="utf-8")
            net = _circuit(model)
            times[net.wiring.n_synapses] = 1e6 * CPlayer(path, policy).low_step_seconds()
    return times


def acting(rounds: int) -> tuple[str, dict[str, float]]:
    """Single deterministic steps of AntFourRooms' agent: the circuit, the low level around it, and ``predict``."""
    model, env = _small_agent("AntFourRooms", ANT_FOUR_ROOMS)
    circuit, rng = FrozenNDBC(_circuit(model)), np.random.default_rng(0)
    observation, _ = env.reset(seed=0)
    _, state = model.predict(observation, None, deterministic=True)
    x, potentials = np.zeros((1, circuit.net.n_inputs), np.float32), np.zeros((1, circuit.state_dim), np.float32)
    jobs: dict[str, Job] = {
        "circuit": lambda: circuit(x, potentials),
        "low level": lambda: model.low.acting.act(x, potentials, True, rng, average=True),
        "predict": lambda: model.predict(observation, state, deterministic=True),
    }
    figures = {name: 1e6 * min(times) for name, times in in_turns(jobs, rounds, calls=200).items()}
    text = (
        f"AntFourRooms, K = 3, one step: circuit {figures['circuit']:.1f} us, low level with bounds and squashing "
        f"{figures['low level']:.1f} us, predict with options and checks {figures['predict']:.1f} us."
    )
    return text, figures


def _first(network: Network) -> Callable[[th.Tensor], th.Tensor]:
    """The network without the state it returns."""

    def run(inputs: th.Tensor) -> th.Tensor:
        outputs: th.Tensor = network(inputs)[0]
        return outputs

    return run


def _count(module: nn.Module) -> int:
    return sum(p.numel() for p in module.parameters())


def _forward(candidate: Candidate, inputs: th.Tensor) -> Job:
    @th.no_grad()
    def job() -> None:
        candidate.forward(inputs)  # type: ignore[misc]

    return job


def _forward_backward(candidate: Candidate, inputs: th.Tensor) -> Job:
    def job() -> None:
        for parameter in candidate.trained:
            parameter.grad = None
        candidate.forward(inputs).square().mean().backward()  # type: ignore[misc]

    return job
