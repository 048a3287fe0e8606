"""Checks and counts outside the hot path: where a value stopped being finite, and how small a network is."""

from __future__ import annotations

import itertools
from collections.abc import Sequence
from typing import TYPE_CHECKING, NamedTuple

import numpy as np
import torch as th

from sb3_tbc.arrays import AnyArray
from sb3_tbc.errors import NonFiniteError
from sb3_tbc.ndbc.wiring import NDBCWiring

if TYPE_CHECKING:
    from sb3_tbc.ndbc.network import NDBCNet

Values = th.Tensor | AnyArray


def check_finite(
    wiring: NDBCWiring,
    inputs: Values | None = None,
    state: Values | None = None,
    outputs: Values | None = None,
    level: str = "low",
    step: int = 0,
) -> None:
    """Raise if anything is NaN or infinite, naming level, layer, neuron and step.

    :param wiring: says which layer a neuron belongs to
    :param inputs: ``(batch, n_inputs)`` or ``(batch, time, n_inputs)``
    :param state: potentials, ``(batch, N)`` or ``(batch, time, N)``
    :param outputs: ``(batch, n_outputs)`` or ``(batch, time, n_outputs)``
    :param level: ``"low"`` or ``"high"``, for the message
    :param step: number of the first step, for the message
    :raises NonFiniteError: at the earliest step, and there in the layer nearest to the inputs
    """
    named = {"sensory": inputs, "neurons": state, "readout": outputs}
    found = []
    for order, (name, values) in enumerate(named.items()):
        if values is None:
            continue
        array = values.detach().cpu().numpy() if isinstance(values, th.Tensor) else np.asarray(values)
        array = array[:, None] if array.ndim == 2 else array
        for sample, time, index in np.argwhere(~np.isfinite(array)).tolist():
            layer = wiring.layer_of(index) if name == "neurons" else name
            found.append((time, order, index, sample, layer, array[sample, time, index]))
    if found:
        time, _, index, sample, layer, value = min(found)
        start = 0 if layer in ("sensory", "readout") else wiring.layer(layer).start
        raise NonFiniteError(
            f"{level} level, {layer} layer, step {step + time}: unit {index - start} of sample {sample} is {value} "
            f"({len(found)} non-finite values in all); check the inputs' scales and the learning rate"
        )


class ParameterCount(NamedTuple):
    """Parameters of a network beside those of an MLP with the same inputs and outputs."""

    ndbc: int
    mlp: int
    synapses: int
    neurons: int

    @property
    def ratio(self) -> float:
        """NDBC parameters as a share of the MLP's."""
        return self.ndbc / self.mlp


def mlp_parameters(sizes: Sequence[int]) -> int:
    """Weights and biases of an MLP with these layer sizes, input and output included."""
    return sum((before + 1) * after for before, after in itertools.pairwise(sizes))


def count_parameters(net: NDBCNet, hidden: Sequence[int] = (64, 64)) -> ParameterCount:
    """Count trained parameters; what the wiring leaves out has none.

    :param net: the network
    :param hidden: widths of the MLP it replaces
    """
    mlp = mlp_parameters([net.n_inputs, *hidden, net.n_outputs])
    return ParameterCount(
        sum(p.numel() for p in net.parameters()), mlp, net.wiring.n_synapses, net.wiring.n_inputs + net.state_dim
    )
