"""Ways to make a circuit learn at an ordinary rate, for trial in :mod:`sb3_tbc.benchmark.fit`.

Each function changes a fresh circuit, or wraps it; none changes what the circuit can represent.
"""

from __future__ import annotations

import numpy as np
import torch as th
from torch import nn
from torch.nn import functional
from torch.nn.utils import parametrize

from sb3_tbc.ndbc.cell import inverse_softplus
from sb3_tbc.ndbc.dissipative import DissipativeCell
from sb3_tbc.ndbc.network import NDBCNet

POSITIVE = ("raw_conductance", "raw_reversal", "raw_input_conductance", "raw_leak", "raw_gain", "raw_sensory_gain")
"""Parameters of a cell whose softplus is a positive quantity; the capacitance has a form of its own."""
GROUPS = {
    "synapses": ("raw_conductance", "raw_reversal", "synapse", "current_weight", "raw_input_conductance"),
    "gains": ("raw_gain", "raw_sensory_gain", "threshold", "sensory_threshold"),
    "readout": ("readout_weight", "readout_bias"),
}
"""Groups of parameters that can learn at a rate of their own."""
CENTRING_ROUNDS = 3
"""A threshold moves the potentials of the neurons behind it, so centring is repeated once per layer."""


class Relative(nn.Module):
    """A positive quantity as the exponential of what is learnt: a step changes it by a factor."""

    def forward(self, free: th.Tensor) -> th.Tensor:
        """What the cell stores, whose softplus is ``exp(free)``."""
        return inverse_softplus(free.exp())

    def right_inverse(self, stored: th.Tensor) -> th.Tensor:
        """What is learnt, from what the cell stores."""
        return functional.softplus(stored).log()


class RelativeSigned(nn.Module):
    """A lean synapse as its first sign times the exponential of what is learnt."""

    sign: th.Tensor

    def __init__(self, synapse: th.Tensor) -> None:
        super().__init__()
        self.register_buffer("sign", synapse.detach().sign())

    def forward(self, free: th.Tensor) -> th.Tensor:
        """The synapse."""
        return self.sign * free.exp()

    def right_inverse(self, synapse: th.Tensor) -> th.Tensor:
        """What is learnt, from the synapse."""
        return synapse.abs().log()


class Standardised(nn.Module):
    """A network whose inputs are standardised by fixed means and standard deviations.

    :param network: any network with the interface of a circuit
    :param rows: inputs whose statistics are taken, ``(..., n_inputs)``
    """

    mean: th.Tensor
    scale: th.Tensor

    def __init__(self, network: nn.Module, rows: th.Tensor) -> None:
        super().__init__()
        flat = rows.flatten(0, -2)
        self.network = network
        self.register_buffer("mean", flat.mean(dim=0))
        self.register_buffer("scale", flat.std(dim=0).clamp(min=1e-3))

    def forward(self, inputs: th.Tensor) -> tuple[th.Tensor, th.Tensor | None]:
        """What the network says to the standardised inputs."""
        outputs: tuple[th.Tensor, th.Tensor | None] = self.network((inputs - self.mean) / self.scale)
        return outputs


def make_relative(net: NDBCNet) -> None:
    """Learn conductances, reversal potentials, leaks, capacitances and gains by factors.

    The paper's form already keeps its polarities; a lean circuit then keeps those that it starts with.

    :param net: a circuit with conductance dynamics
    """
    cell = net.cell
    names = [*POSITIVE, *(["raw_capacitance"] if not getattr(cell, "log_capacitance", False) else [])]
    for name in names:
        if name in dict(cell.named_parameters()):
            parametrize.register_parametrization(cell, name, Relative())
    synapse = getattr(cell, "synapse", None)
    if isinstance(synapse, nn.Parameter):
        parametrize.register_parametrization(cell, "synapse", RelativeSigned(synapse))


@th.no_grad()
def unshunt(net: NDBCNet) -> None:
    """Divide the conductance of each sensory synapse by the number of sensory synapses of its neuron.

    With twenty of them at .35 they hold four fifths of a fresh neuron's conductance, and the input current hardly acts.

    :param net: a circuit in the paper's form
    """
    if isinstance(net.cell, DissipativeCell):
        return
    _, neuron = np.nonzero(net.wiring.sensory)
    number = th.as_tensor(np.count_nonzero(net.wiring.sensory, axis=0)[neuron])
    stored = net.cell.raw_conductance
    stored[: len(neuron)] = inverse_softplus(functional.softplus(stored[: len(neuron)]) / number)


@th.no_grad()
def centre(net: NDBCNet, rows: th.Tensor) -> None:
    """Move thresholds and biases so that every logistic and every input current is half open over ``rows``.

    :param net: a circuit with conductance dynamics
    :param rows: inputs, ``(..., n_inputs)``; the first 256 are used
    """
    inputs = rows.flatten(0, -2)[:256]
    cell = net.cell
    if isinstance(cell, DissipativeCell):
        return
    scaled = inputs * net.input_gain
    arrays = cell.arrays()
    cell.current_bias.sub_((scaled @ arrays.current_weight).mean(dim=0))
    if len(arrays.sensory_gain):
        cell.sensory_threshold.add_((scaled * arrays.sensory_gain).mean(dim=0))
    drawn = cell.threshold.clone()
    for _ in range(CENTRING_ROUNDS):
        potential = net(inputs)[1].mean(dim=0)
        cell.threshold.copy_(drawn + arrays.gain * potential[: cell.n_presynaptic])
    net.readout_bias.sub_(net(inputs)[0].mean(dim=0))


def group_of(name: str) -> str:
    """The group of a parameter, by its name in the network; ``other`` if it is in none.

    :param name: dotted, also that of a parameter learnt by factors
    """
    parts = set(name.split("."))
    return next((group for group, members in GROUPS.items() if parts & set(members)), "other")
