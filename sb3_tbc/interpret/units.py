"""The units of a low level, circuit neurons or an MLP's hidden units, acting one step at a time with lesions."""

from __future__ import annotations

import copy
from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np
import torch as th
from numpy.typing import NDArray
from torch import nn

from sb3_tbc.arrays import FloatArray
from sb3_tbc.errors import ConfigError
from sb3_tbc.level.actors import GaussianHead, MLPActor, NDBCActor
from sb3_tbc.ndbc.dissipative import DissipativeCell
from sb3_tbc.ndbc.network import NDBCNet
from sb3_tbc.ndbc.wiring import LAYERS
from sb3_tbc.tbc_hrl import TBCHRL

Mask = NDArray[np.bool_]


class Lesion(NamedTuple):
    """What is done to the units, for one episode ``(N,)`` or for a row of episodes ``(n, N)``."""

    held: Mask  # clamped to ``value``: neither read nor passed on
    unread: Mask  # the readout sees ``value`` instead; the other units still hear the true potential
    value: FloatArray
    wiped: Mask  # () or (n, 1): the memory is set to zero before every step


def no_lesion(units: Units) -> Lesion:
    """Nothing is done."""
    nowhere = np.zeros(len(units.names), dtype=bool)
    return Lesion(nowhere, nowhere, units.rest, np.zeros(1, dtype=bool))


def clamp(units: Units, which: Sequence[int], value: FloatArray) -> Lesion:
    """Clamp some units.

    :param which: their indices
    :param value: the value of every unit ``(N,)``, of which those of the clamped ones count
    """
    held = np.zeros(len(units.names), dtype=bool)
    held[list(which)] = True
    return no_lesion(units)._replace(held=held, value=value)


def stack(lesions: Sequence[Lesion]) -> Lesion:
    """One row per lesion."""
    return Lesion(*(np.stack(part) for part in zip(*lesions, strict=True)))


def units_of(model: TBCHRL) -> Units:
    """The units of an agent's deployed (averaged) low level.

    :param model: a trained agent
    :raises ConfigError: for an agent whose low level is a GRU, or an MLP without hidden layers
    """
    actor = model.low.policy.average_actor
    if isinstance(actor, NDBCActor):
        return CircuitUnits(actor)
    if not isinstance(actor, MLPActor):
        raise ConfigError("only circuits and MLPs can be interpreted; this agent's low level is a GRU")
    if len(actor.latent_pi) == 0:
        raise ConfigError("this agent's low level is an MLP without hidden layers: it has no units to interpret")
    return MLPUnits(actor)


class CircuitUnits:
    """Neurons of an NDBC circuit, of either dynamics, in double precision.

    A clamped neuron keeps its value through all sub-steps, so no other neuron ever hears it move. ``read`` says which
    neurons the readout hears, ``rest`` is the potential of a neuron that nothing acts on; both ``(N,)``.

    :param actor: the low level's actor
    """

    def __init__(self, actor: NDBCActor) -> None:
        self.net: NDBCNet = copy.deepcopy(actor.net).double()
        self._decide = _Decision(actor.head, int(np.prod(actor.action_space.shape)))
        wiring = self.net.wiring
        self.names = wiring.neuron_names()
        self.layers = {name: wiring.layer(name) for name in LAYERS}
        self.state_dim = wiring.n_neurons
        self.read = np.arange(self.state_dim) >= self.net.read_from
        leak = None if isinstance(self.net.cell, DissipativeCell) else self.net.cell.leak_potential
        self.rest = np.zeros(self.state_dim) if leak is None else leak.detach().numpy().copy()

    @th.no_grad()
    def step(self, inputs: FloatArray, state: FloatArray, lesion: Lesion) -> tuple[FloatArray, FloatArray, FloatArray]:
        """Unit actions ``(n, actions)``, next memory ``(n, N)`` and activations ``(n, N)``.

        :param inputs: what the low level sees, ``(n, inputs)``
        :param state: memory, ``(n, N)``
        :param lesion: one for all rows, or a row for each of the n
        """
        net, cell = self.net, self.net.cell
        held, value = th.as_tensor(lesion.held), th.as_tensor(lesion.value).double()
        seen = th.as_tensor(np.asarray(inputs)).double() * net.input_gain
        potentials = th.as_tensor(np.where(lesion.wiped, 0.0, state)).double()
        potentials = th.where(held, value, potentials)
        arrays: Any = cell.arrays()
        step_terms = cell.step_terms(arrays, 1.0 / net.sub_steps)
        input_terms = cell.input_terms(seen, arrays, step_terms)
        for _ in range(net.sub_steps):
            potentials = th.where(held, value, cell.step(potentials, input_terms, arrays, step_terms))
        heard = th.where(th.as_tensor(lesion.unread), value, potentials)
        activations = potentials.numpy()
        return self._decide(net.read(heard).numpy()), activations.astype(np.float32), activations

    def synapses(self) -> list[tuple[str, str, int]]:
        """Presynaptic and postsynaptic neuron and present polarity of every synapse, sensory ones first."""
        wiring = self.net.signed_wiring()
        sensory = [(f"sensory{i}", self.names[j], int(wiring.sensory[i, j])) for i, j in np.argwhere(wiring.sensory)]
        among = [(self.names[i], self.names[j], int(wiring.recurrent[i, j])) for i, j in np.argwhere(wiring.recurrent)]
        return sensory + among

    def without_synapse(self, index: int) -> CircuitUnits:
        """A copy in which one synapse, of the order of :meth:`synapses`, conducts nothing."""
        cut = copy.copy(self)
        cut.net = copy.deepcopy(self.net)
        n_sensory = int(np.count_nonzero(self.net.wiring.sensory))
        cell: Any = cut.net.cell
        with th.no_grad():
            if isinstance(cell, DissipativeCell):
                raw = cell.raw_input_weight if index < n_sensory else cell.raw_weight
                raw[index if index < n_sensory else index - n_sensory] = -th.inf  # softplus gives zero
            else:
                cell.cut(index)
        return cut


class MLPUnits:
    """Hidden units of an MLP actor; only the last hidden layer is read, and nothing is remembered.

    :param actor: the low level's actor
    """

    def __init__(self, actor: MLPActor) -> None:
        self._layers = [copy.deepcopy(m).double() for m in actor.latent_pi.modules() if isinstance(m, nn.Linear)]
        self._out = copy.deepcopy(actor.mu).double()
        self._activation = actor.activation_fn()
        self._decide = _Decision(actor.head, int(np.prod(actor.action_space.shape)))
        widths = [layer.out_features for layer in self._layers]
        ends = np.cumsum(widths).tolist()
        slices = [slice(end - width, end) for end, width in zip(ends, widths, strict=True)]
        self.layers = {f"hidden{k}": part for k, part in enumerate(slices)}
        self.names = tuple(f"hidden{k}.{i}" for k, width in enumerate(widths) for i in range(width))
        self.rest = np.zeros(len(self.names))
        self.read = np.arange(len(self.names)) >= slices[-1].start
        self.state_dim = 0

    @th.no_grad()
    def step(self, inputs: FloatArray, state: FloatArray, lesion: Lesion) -> tuple[FloatArray, FloatArray, FloatArray]:
        """As :meth:`CircuitUnits.step`; the memory ``(n, 0)`` is passed on."""
        hidden = th.as_tensor(np.asarray(inputs)).double()
        held, value = th.as_tensor(lesion.held), th.as_tensor(lesion.value).double()
        activations = []
        for layer, part in zip(self._layers, self.layers.values(), strict=True):
            hidden = th.where(held[..., part], value[..., part], self._activation(layer(hidden)))
            activations.append(hidden)
        last = list(self.layers.values())[-1]
        heard = th.where(th.as_tensor(lesion.unread)[..., last], value[..., last], hidden)
        return self._decide(self._out(heard).numpy()), state, th.cat(activations, dim=-1).numpy()


Units = CircuitUnits | MLPUnits
"""What the measures look into: names, layers, which units are read, their value at rest, and a step with lesions."""


class _Decision:
    """From a network's outputs to the unit action that a deployed low level takes.

    :param head: bounds of the mean
    :param dim: number of actions; the means are the first outputs
    """

    def __init__(self, head: GaussianHead, dim: int) -> None:
        self.bound, self.dim = np.inf if head.mean_bound is None else head.mean_bound, dim

    def __call__(self, outputs: FloatArray) -> FloatArray:
        mean = np.clip(outputs[:, : self.dim].astype(np.float32), -self.bound, self.bound)
        return np.tanh(mean.astype(np.float64)).astype(np.float32)
