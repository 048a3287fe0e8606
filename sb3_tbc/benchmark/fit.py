"""``python -m sb3_tbc.benchmark fit``: how fast and how well small actors learn skills by imitation.

Imitation shows in a minute what an actor can represent. Each actor learns each skill with Adam, in batches of 256 rows
(32 sequences for delays), at every learning rate of a grid. R2 on rows of later episodes is reported at the best rate.
As in training, the averaged actor is evaluated.
"""

from __future__ import annotations

import argparse
import copy
import itertools
import sys
from collections.abc import Callable, Sequence
from typing import NamedTuple

import torch as th
from torch import nn

from sb3_tbc.aliases import PlainMapping
from sb3_tbc.benchmark.circuits import WIRING_NUMBERS, paper_numbers
from sb3_tbc.benchmark.skills import Skill, load_skill, skill_names
from sb3_tbc.errors import ConfigError
from sb3_tbc.ndbc.network import NDBCNet
from sb3_tbc.ndbc.wiring import NDBCWiring

CIRCUIT_RATES = (1e-2, 3e-2, 1e-1, 3e-1)
MLP_RATES = (1e-3, 3e-3, 1e-2, 3e-2)
ROWS, SEQUENCES = 256, 32
AVERAGE_DECAY = 0.995
LARGEST_GRADIENT = 1.0
MAX_WIDTH = 512


class Actor(NamedTuple):
    """A kind of network that can learn a skill."""

    name: str
    make: Callable[[Skill, int], nn.Module]  # from skill and seed
    rates: tuple[float, ...]


class Result(NamedTuple):
    """Quality of an actor's fit to a skill."""

    skill: str
    actor: str
    parameters: int
    r2: dict[int, float]  # by Adam steps, each at its best rate
    rates: dict[int, float]  # the best ones


class Plain(nn.Module):
    """A network without a state, with the interface of a circuit; a GRU is unrolled over the sequence."""

    def __init__(self, network: nn.Module, readout: nn.Module | None = None) -> None:
        super().__init__()
        self.network, self.readout = network, readout

    def forward(self, inputs: th.Tensor) -> tuple[th.Tensor, None]:
        """Outputs, and no state."""
        if self.readout is None:
            return self.network(inputs), None
        sequence = inputs if inputs.dim() == 3 else inputs.unsqueeze(1)
        outputs = self.readout(self.network(sequence)[0])
        return outputs if inputs.dim() == 3 else outputs[:, 0], None


def parse_actor(text: str) -> Actor:
    """An actor from its description.

    ``paper`` is table A1's circuit, ``lean`` the same with lean synapses. Options follow after commas: ``reflex``;
    ``full``, every fan as large as it can be; ``slow``, command neurons with time constants of 0.5 to 3 control steps;
    ``gains``, initial gains of 6 to 12; any number of the wiring or option of the network as ``inter=48``; and
    ``rate=3e-2``. ``mlp`` is an MLP of two hidden layers with as many parameters as table A1's circuit, ``mlp:24x14``
    one with these widths, ``mlp:1300`` one with about 1300 parameters, and ``gru:16`` a GRU with 16 units.

    :raises ConfigError: if the description is wrong
    """
    kind, *options = text.split(",")
    name, _, size = kind.partition(":")
    rates = tuple(float(o.partition("=")[2]) for o in options if o.startswith("rate="))
    options = [o for o in options if not o.startswith("rate=")]
    if name in ("paper", "lean") and not size:
        values = {"synapses": name, **dict(_circuit_option(o, text) for o in options)}
        return Actor(text, lambda skill, seed: make_circuit(skill, seed, values), rates or CIRCUIT_RATES)
    if name == "mlp" and not options and all(w.isdigit() and int(w) > 0 for w in size.split("x") if size):
        return Actor(text, lambda skill, seed: _make_mlp(skill, seed, size), rates or MLP_RATES)
    if name == "gru" and not options and size.isdigit():
        return Actor(text, lambda skill, seed: _make_gru(skill, seed, int(size)), rates or MLP_RATES)
    raise ConfigError(f"no actor {text!r}: give paper or lean, mlp, mlp:24x14, mlp:1300 or gru:16, see --help")


def _circuit_option(option: str, text: str) -> tuple[str, object]:
    key, _, value = option.partition("=")
    switches: dict[str, tuple[str, object]] = {
        "reflex": ("sensory_to", ("inter", "command", "motor")),
        "full": ("full", True),
        "slow": ("time_constants", {"command": (0.5, 3.0)}),
        "gains": ("initial_gains", (6.0, 12.0)),
    }
    if option in switches:
        return switches[option]
    if key not in (*WIRING_NUMBERS, "sub_steps", "readout") or not value:
        raise ConfigError(f"unknown option {option!r} of actor {text!r}")
    return key, int(value) if value.isdigit() else value


def make_circuit(skill: Skill, seed: int, values: PlainMapping) -> NDBCNet:
    """A circuit on table A1's wiring for the skill's task (Pendulum's for delays), with some of its numbers changed."""
    given = dict(values)
    numbers = {**paper_numbers(skill.name if not skill.name.startswith("delay") else "Pendulum")}
    numbers["motor"] = max(numbers["motor"], skill.n_outputs)
    numbers |= {key: given.pop(key) for key in WIRING_NUMBERS if key in given}
    if given.pop("full", False):
        fans = {"sensory_fanout": "inter", "inter_fanout": "command", "motor_fanin": "command"}
        numbers |= {fan: numbers[layer] for fan, layer in fans.items()}
    wiring = NDBCWiring(skill.n_inputs, **numbers, seed=seed, sensory_to=given.pop("sensory_to", ("inter",)))
    return NDBCNet(skill.n_inputs, skill.n_outputs, wiring, seed=seed, **given)


def _make_mlp(skill: Skill, seed: int, size: str) -> nn.Module:
    if "x" in size:
        return make_mlp(skill, seed, [int(w) for w in size.split("x")])
    circuit = make_circuit(skill, 0, {"synapses": "paper"})
    return make_mlp(skill, seed, equal_widths(skill, int(size) if size else count(circuit)))


def make_mlp(skill: Skill, seed: int, widths: Sequence[int]) -> nn.Module:
    """An MLP with ReLU and these hidden layers."""
    th.manual_seed(seed)
    sizes = (skill.n_inputs, *widths, skill.n_outputs)
    layers: list[nn.Module] = []
    for n_in, n_out in itertools.pairwise(sizes):
        layers += [nn.Linear(n_in, n_out), nn.ReLU()]
    return Plain(nn.Sequential(*layers[:-1]))


def equal_widths(skill: Skill, parameters: int) -> tuple[int, int]:
    """Two hidden widths that give an MLP about this many parameters, neither more than twice the other."""

    def size(a: int, b: int) -> int:
        return (skill.n_inputs + 1) * a + (a + 1) * b + (b + 1) * skill.n_outputs

    pairs = ((a, b) for a in range(1, MAX_WIDTH) for b in range(max(1, a // 2), 2 * a + 1))
    return min(itertools.takewhile(lambda p: size(p[0], 1) < 2 * parameters + 1000, pairs),
               key=lambda p: abs(size(*p) - parameters))  # fmt: skip


def _make_gru(skill: Skill, seed: int, units: int) -> nn.Module:
    th.manual_seed(seed)
    return Plain(nn.GRU(skill.n_inputs, units, batch_first=True), nn.Linear(units, skill.n_outputs))


def count(network: nn.Module) -> int:
    """Trained parameters."""
    return sum(p.numel() for p in network.parameters() if p.requires_grad)


@th.no_grad()
def judge(network: nn.Module, skill: Skill) -> float:
    """Share of the variance on later episodes that the network explains."""
    error = (network(skill.later_inputs)[0] - skill.later_targets).square().sum()
    around = (skill.later_targets - skill.later_targets.flatten(0, -2).mean(dim=0)).square().sum()
    return float(1.0 - error / around)


def learn(network: nn.Module, skill: Skill, rate: float, steps: Sequence[int], seed: int = 0) -> dict[int, float]:
    """R2 of the averaged network after each of the given numbers of Adam steps, at a constant rate."""
    average = copy.deepcopy(network)
    optimizer = th.optim.Adam(network.parameters(), lr=rate)
    generator = th.Generator().manual_seed(seed)
    batch = SEQUENCES if skill.inputs.dim() == 3 else ROWS
    reached: dict[int, float] = {}
    for step in range(1, max(steps) + 1):
        rows = th.randint(len(skill.inputs), (batch,), generator=generator)
        loss = (network(skill.inputs[rows])[0] - skill.targets[rows]).square().mean()
        optimizer.zero_grad()
        loss.backward()
        nn.utils.clip_grad_norm_(network.parameters(), LARGEST_GRADIENT)
        optimizer.step()
        weight = 1.0 - min(AVERAGE_DECAY, (1 + step) / (10 + step))
        with th.no_grad():
            th._foreach_lerp_(list(average.parameters()), list(network.parameters()), weight)
        if step in steps:
            reached[step] = judge(average, skill)
    return reached


def best_of(actor: Actor, skill: Skill, steps: Sequence[int], seeds: Sequence[int]) -> Result:
    """R2 at the best of the actor's rates, for every number of steps; means over seeds."""
    found: dict[float, dict[int, float]] = {}
    parameters = count(actor.make(skill, seeds[0]))
    for rate in actor.rates:
        runs = [learn(actor.make(skill, seed), skill, rate, steps, seed) for seed in seeds]
        found[rate] = {step: sum(run[step] for run in runs) / len(runs) for step in steps}
    rates = {step: max(found, key=lambda rate: found[rate][step]) for step in steps}
    return Result(skill.name, actor.name, parameters, {step: found[rates[step]][step] for step in steps}, rates)


def fit(arguments: argparse.Namespace) -> tuple[list[str], dict[str, object]]:
    """Lines to print, and the figures of all actors on all skills."""
    th.set_num_threads(1)
    steps = sorted(arguments.steps)
    actors = [parse_actor(text) for text in arguments.actors]
    lines = [
        "R2 on later episodes after Adam steps, at the best rate (in brackets) of each actor's grid",
        "",
        f"| skill | actor | parameters | {' | '.join(str(step) for step in steps)} |",
        "|---" * (3 + len(steps)) + "|",
    ]
    results = []
    for name in arguments.tasks or skill_names():
        skill = load_skill(name)
        for actor in actors:
            result = best_of(actor, skill, steps, range(arguments.seeds))
            figures = " | ".join(f"{result.r2[step]:.3f} ({result.rates[step]:g})" for step in steps)
            lines.append(f"| {name} | {actor.name} | {result.parameters} | {figures} |")
            print(lines[-1], file=sys.stderr, flush=True)  # a table may take an hour
            results.append(result._asdict())
    return lines, {"fit": results}
