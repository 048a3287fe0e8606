"""Actors by description, for :mod:`sb3_tbc.benchmark.fit`: circuits, MLPs and GRUs of chosen sizes."""

from __future__ import annotations

import itertools
import math
from collections.abc import Callable, Mapping, Sequence
from typing import NamedTuple

import torch as th
from torch import nn

from sb3_tbc.aliases import PlainMapping
from sb3_tbc.benchmark import conditioning
from sb3_tbc.benchmark.circuits import WIRING_NUMBERS, paper_numbers
from sb3_tbc.benchmark.skills import Skill
from sb3_tbc.errors import ConfigError
from sb3_tbc.ndbc.network import NDBCNet
from sb3_tbc.ndbc.wiring import NDBCWiring

CIRCUIT_RATES = (1e-2, 3e-2, 1e-1, 3e-1)
MLP_RATES = (1e-3, 3e-3, 1e-2, 3e-2)
OPTIMIZERS = ("adam", "nadam", "radam")
MAX_WIDTH = 512
SWITCHES: dict[str, tuple[str, object]] = {
    "reflex": ("sensory_to", ("inter", "command", "motor")),
    "full": ("full", True),
    "equal": ("equal", True),
    "slow": ("time_constants", {"command": (0.5, 3.0)}),
    "gains": ("initial_gains", (6.0, 12.0)),
    "relative": ("relative", True),
    "unshunted": ("unshunted", True),
    "centred": ("centred", True),
    "standard": ("standard", True),
}
"""Options of a circuit's description that have no value, and what they set."""


class Actor(NamedTuple):
    """A kind of network that can learn a skill."""

    name: str
    make: Callable[[Skill, int], nn.Module]  # from skill and seed
    rates: tuple[float, ...]
    factors: Mapping[str, float] = {}  # of the rate, for groups of parameters
    optimizer: str = "adam"


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
    ``full``, every fan as large as it can be; ``equal``, more neurons, until it has as many parameters as table A1's
    circuit in the paper's form; ``slow``, command neurons with time constants of 0.5 to 3 control steps; ``gains``,
    initial gains of 6 to 12; ``relative``, positive quantities learnt by factors; ``unshunted``, weak sensory synapses;
    ``centred``, logistics half open at the start; ``standard``, inputs standardised; any number of the wiring or option
    of the network as ``inter=48``; ``rate_synapses=3``, ``rate_gains=3`` and ``rate_readout=0.3``, factors of the rate.
    ``mlp`` is an MLP of two hidden layers with as many parameters as table A1's circuit, ``mlp:24x14`` one with these
    widths, ``mlp:1300`` one with about 1300 parameters, and ``gru:16`` a GRU with 16 units. ``rate=3e-2`` and
    ``optimizer=nadam`` go with every actor.

    :raises ConfigError: if the description is wrong
    """
    kind, *options = text.split(",")
    name, _, size = kind.partition(":")
    given = [(key, value) for key, _, value in (option.partition("=") for option in options)]
    factors = {key.removeprefix("rate_"): _number(value, text) for key, value in given if key.startswith("rate_")}
    rates = tuple(_number(value, text) for key, value in given if key == "rate")
    optimizer = dict(given).get("optimizer", "adam")
    options = [o for o in options if o.partition("=")[0].partition("_")[0] not in ("rate", "optimizer")]
    if optimizer not in OPTIMIZERS or not set(factors) <= set(conditioning.GROUPS):
        raise ConfigError(
            f"actor {text!r}: optimizer is one of {', '.join(OPTIMIZERS)}, and the groups with a rate of their own are "
            f"{', '.join(conditioning.GROUPS)}"
        )
    if name in ("paper", "lean") and not size:
        values = {"synapses": name, **dict(_circuit_option(o, text) for o in options)}
        return Actor(text, lambda skill, seed: conditioned(skill, seed, values), rates or CIRCUIT_RATES, factors,
                     optimizer)  # fmt: skip
    plain = not options and not factors
    if name == "mlp" and plain and all(w.isdecimal() and int(w) > 0 for w in size.split("x") if size):
        return Actor(text, lambda skill, seed: _make_mlp(skill, seed, size), rates or MLP_RATES, {}, optimizer)
    if name == "gru" and plain and size.isdecimal() and int(size) > 0:
        return Actor(text, lambda skill, seed: _make_gru(skill, seed, int(size)), rates or MLP_RATES, {}, optimizer)
    raise ConfigError(f"no actor {text!r}: give paper or lean, mlp, mlp:24x14, mlp:1300 or gru:16, see --help")


def _number(value: str, text: str) -> float:
    try:
        number = float(value)
    except ValueError:
        number = -1.0
    if not 0 < number < math.inf:
        raise ConfigError(f"actor {text!r}: a rate is a finite number above 0, got {value!r}")
    return number


def _circuit_option(option: str, text: str) -> tuple[str, object]:
    key, _, value = option.partition("=")
    if option in SWITCHES:
        return SWITCHES[option]
    if key not in (*WIRING_NUMBERS, "sub_steps", "readout") or not value:
        raise ConfigError(f"unknown option {option!r} of actor {text!r}; there are {', '.join(SWITCHES)}")
    return key, int(value) if value.isdecimal() else value


def conditioned(skill: Skill, seed: int, values: PlainMapping) -> nn.Module:
    """A circuit with the ways to condition it that ``values`` name, see :mod:`sb3_tbc.benchmark.conditioning`.

    :raises ConfigError: if they do not go with the circuit
    """
    given = dict(values)
    relative, unshunted, centred, standard = (
        given.pop(name, False) for name in ("relative", "unshunted", "centred", "standard")
    )
    if unshunted and given["synapses"] != "paper":
        raise ConfigError("an actor with 'unshunted' must be 'paper': lean circuits have no sensory synapses")
    net = make_circuit(skill, seed, grown(skill, given) if given.pop("equal", False) else given)
    if unshunted:
        conditioning.unshunt(net)
    rows = skill.inputs
    wrapped = conditioning.Standardised(net, rows) if standard else net
    if centred:
        conditioning.centre(net, rows if not standard else (rows - wrapped.mean) / wrapped.scale)  # type: ignore[operator]
    if relative:
        conditioning.make_relative(net)
    return wrapped


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


def grown(skill: Skill, values: PlainMapping) -> dict[str, object]:
    """Numbers of inter and command neurons with which a circuit is as large as table A1's in the paper's form."""
    paper = make_circuit(skill, 0, {"synapses": "paper"})
    inter, command, wanted = paper.wiring.inter, paper.wiring.command, count(paper)

    def size(pair: tuple[int, int]) -> int:
        return count(make_circuit(skill, 0, {**values, "inter": pair[0], "command": pair[1]}))

    def about(n: int) -> list[tuple[int, int]]:
        return [(n, max(1, round(n * command / inter) + more)) for more in (-2, -1, 0, 1, 2)]

    enough = next((n for n in range(1, MAX_WIDTH) if size(about(n)[2]) >= wanted), MAX_WIDTH)
    pairs = [pair for n in range(max(1, enough - 2), enough + 2) for pair in about(n)]
    best = min(pairs, key=lambda pair: abs(size(pair) - wanted))
    return {**values, "inter": best[0], "command": best[1]}


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

    if parameters > (most := size(MAX_WIDTH, MAX_WIDTH)):
        raise ConfigError(
            f"an MLP of {parameters} parameters is too large, {most} are possible; give widths, mlp:64x64"
        )
    pairs = ((a, b) for a in range(1, MAX_WIDTH) for b in range(max(1, a // 2), 2 * a + 1))
    return min(itertools.takewhile(lambda p: size(p[0], 1) < 2 * parameters + 1000, pairs),
               key=lambda p: abs(size(*p) - parameters))  # fmt: skip


def _make_gru(skill: Skill, seed: int, units: int) -> nn.Module:
    th.manual_seed(seed)
    return Plain(nn.GRU(skill.n_inputs, units, batch_first=True), nn.Linear(units, skill.n_outputs))


def count(network: nn.Module) -> int:
    """Trained parameters."""
    return sum(p.numel() for p in network.parameters() if p.requires_grad)
