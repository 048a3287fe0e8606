"""Acting from the current weights in NumPy: at batch 1 a torch forward pass is mostly overhead."""

from __future__ import annotations

from collections.abc import Callable
from typing import Protocol

import numpy as np
import torch as th
from stable_baselines3.common.preprocessing import get_action_dim
from torch import nn

from sb3_tbc.arrays import BoolArray, FloatArray, FloatType
from sb3_tbc.level.actors import GaussianHead, GRUActor, GRUNet, MLPActor, NDBCActor
from sb3_tbc.level.policies import LevelActor, LevelPolicy
from sb3_tbc.level.storage import Block, in_one_piece
from sb3_tbc.ndbc.frozen import FrozenNDBC


def _relu(x: FloatArray) -> FloatArray:
    np.maximum(x, 0.0, out=x)
    return x


def _silu(x: FloatArray) -> FloatArray:
    return np.asarray(x * (0.5 + 0.5 * np.tanh(0.5 * x)))


def _elu(x: FloatArray) -> FloatArray:
    return np.where(x > 0, x, np.expm1(np.minimum(x, 0)))


ACTIVATIONS: dict[type[nn.Module], Callable[[FloatArray], FloatArray]] = {
    nn.ReLU: _relu,
    nn.Tanh: np.tanh,
    nn.SiLU: _silu,
    nn.ELU: _elu,
}


class FrozenNet(Protocol):
    """A network's outputs and next state for one control step, in NumPy."""

    def __call__(self, inputs: FloatArray, state: FloatArray, /) -> tuple[FloatArray, FloatArray]:
        """Outputs ``(n, 2 * action_dim)`` and next states ``(n, state_dim)``."""

    def refresh(self) -> None:
        """Read the weights again after they changed."""


class FrozenMLP:
    """NumPy forward pass of an MLP actor.

    In single precision its arrays share memory with the parameters, so it is never stale.

    :param actor: the actor
    :param dtype: precision of the arithmetic; inputs and outputs are float32
    :raises ValueError: for an activation function without a NumPy counterpart
    """

    def __init__(self, actor: MLPActor, dtype: FloatType = np.float32) -> None:
        if actor.activation_fn not in ACTIVATIONS:
            allowed = sorted(f.__name__ for f in ACTIVATIONS)
            raise ValueError(f"activation_fn must be one of {allowed} to act in NumPy, got {actor.activation_fn}")
        self._actor, self._dtype = actor, dtype
        self._activation = ACTIVATIONS[actor.activation_fn]
        self.refresh()

    def refresh(self) -> None:
        """Point the arrays at the parameters again, or copy them in another precision."""
        arrays = [_as_array(block).astype(self._dtype, copy=False) for block in self._actor.blocks()]
        self._hidden = [(w.T, b) for w, b in zip(arrays[:-2:2], arrays[1:-2:2], strict=True)]
        self._out_weight, self._out_bias = arrays[-2].T, arrays[-1]

    def __call__(self, observations: FloatArray, states: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Outputs ``(n, 2 * action_dim)`` before the head's bounds, and the empty states."""
        x = observations
        activation = self._activation
        for weight, bias in self._hidden:
            x = np.dot(x, weight)
            x += bias
            x = activation(x)
        outputs = np.dot(x, self._out_weight) + self._out_bias
        return outputs.astype(np.float32, copy=False), states


class FrozenGRU:
    """NumPy forward pass of a GRU actor, in double precision inside.

    :param net: the network
    """

    def __init__(self, net: GRUNet) -> None:
        self._net = net
        self.refresh()

    def refresh(self) -> None:
        """Copy the weights."""
        cell, readout = self._net.cell, self._net.readout
        names = (cell.weight_ih, cell.bias_ih, cell.weight_hh, cell.bias_hh, readout.weight, readout.bias)
        self._arrays = [tensor.detach().numpy().astype(np.float64).T for tensor in names]
        self._gain = self._net.input_gain.numpy().astype(np.float64)

    def __call__(self, inputs: FloatArray, state: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Outputs ``(n, 2 * action_dim)`` before the head's bounds, and the next states ``(n, hidden_size)``."""
        seen, seen_bias, kept, kept_bias, readout, bias = self._arrays
        # r, z = sigmoid(...), n = tanh(W x + r * (U h)), h' = (1 - z) n + z h (Cho et al. 2014, as torch has it)
        new, old = (inputs * self._gain) @ seen + seen_bias, state @ kept + kept_bias
        width = state.shape[1]
        gates = 0.5 + 0.5 * np.tanh(0.5 * (new[:, : 2 * width] + old[:, : 2 * width]))
        forget, keep = gates[:, :width], gates[:, width:]
        candidate = np.tanh(new[:, 2 * width :] + forget * old[:, 2 * width :])
        state = candidate + keep * (state - candidate)
        return (state @ readout + bias).astype(np.float32), state.astype(np.float32)


def _as_array(block: Block) -> FloatArray:
    """A block of at most two dimensions as one array, without a copy if its parameters lie in flat storage."""
    flat = in_one_piece(block.parameters)
    if flat is None:  # a copied policy, not yet in flat storage
        return np.concatenate([p.detach().numpy() for p in block.parameters])
    return flat.numpy().reshape(block.shape)


def freeze(actor: LevelActor, dtype: FloatType = np.float32) -> FrozenNet:
    """NumPy forward pass of an actor whose parameters lie in flat storage.

    :param dtype: precision of an MLP's arithmetic; with a memory it is double in any case
    :raises TypeError: for another kind of actor
    """
    if isinstance(actor, NDBCActor):
        return FrozenNDBC(actor.net)
    if isinstance(actor, GRUActor):
        return FrozenGRU(actor.net)
    if not isinstance(actor, MLPActor):
        raise TypeError(f"no NumPy forward pass for an actor of type {type(actor).__name__}")
    return FrozenMLP(actor, dtype)


class WeightWatch:
    """Notices that an actor's parameters were changed by hand: in place, or by other tensors in their place.

    :param actor: the actor
    """

    def __init__(self, actor: nn.Module) -> None:
        self._parameters = list(actor.parameters())
        self.note()

    def note(self) -> None:
        """Remember the parameters as they are."""
        self._places = [p.data_ptr() for p in self._parameters]
        flat = in_one_piece(self._parameters)
        self._arrays = [p.detach().numpy() for p in (self._parameters if flat is None else [flat])]
        self._noted = [array.copy() for array in self._arrays]

    def changed(self) -> bool:
        """Whether they are others now; a few microseconds for some thousand weights."""
        if [p.data_ptr() for p in self._parameters] != self._places:
            return True
        return any(bool((now != before).any()) for now, before in zip(self._arrays, self._noted, strict=True))


class FrozenActor:
    """Acts in NumPy from an actor's weights, which it reads again when the policy's ``weights_version`` has changed.

    The averaged actor, which is what gets deployed, acts in double precision inside: what it is given and what it
    returns is rounded to single precision, and an exported policy that does the same gives the same actions.

    :param policy: policy of a level, its parameters in flat storage
    :param average: act from the averaged actor
    """

    def __init__(self, policy: LevelPolicy, average: bool) -> None:
        actor = policy.average_actor if average else policy.actor
        self._policy = policy
        self._version = policy.weights_version
        self._dtype = np.float64 if average else np.float32
        self._net = freeze(actor, self._dtype)
        self._watch = WeightWatch(actor)
        head: GaussianHead = actor.head
        self._dim = get_action_dim(actor.action_space)
        mean_bound = np.inf if head.mean_bound is None else head.mean_bound
        low, high = head.log_std_bounds
        self._lowest, self._highest = (
            np.repeat(np.array(pair, dtype=np.float32), self._dim) for pair in ((-mean_bound, low), (mean_bound, high))
        )

    def act(
        self,
        observations: FloatArray,
        states: FloatArray,
        deterministic: bool | BoolArray,
        rng: np.random.Generator,
    ) -> tuple[FloatArray, FloatArray]:
        """See :meth:`ActingLevel.act`."""
        outputs, next_states = self._current()(observations, states)
        dim = self._dim
        bounded = np.minimum(np.maximum(outputs, self._lowest), self._highest)
        chosen = bounded[:, :dim]
        if deterministic is not True:
            noise = np.exp(bounded[:, dim:])
            noise *= rng.standard_normal(chosen.shape, dtype=np.float32)
            if deterministic is not False:
                noise[deterministic] = 0.0
            noise += chosen
            chosen = noise
        return np.tanh(chosen, dtype=self._dtype).astype(np.float32, copy=False), next_states

    def _current(self) -> FrozenNet:
        if self._version != self._policy.weights_version:
            self._net.refresh()
            self._watch.note()
            self._version = self._policy.weights_version
        return self._net

    def is_stale(self) -> bool:
        """Whether the weights were changed by hand since they were read."""
        return self._version == self._policy.weights_version and self._watch.changed()


_UNUSED = np.random.default_rng(0)
"""Stands where acting by the mean, which draws nothing, is to be given a generator."""


class ActingLevel:
    """A level's policy at work: all that acting needs of a level, without what it learns from.

    :param policy: of the level
    """

    def __init__(self, policy: LevelPolicy) -> None:
        self.policy = policy
        self._frozen = {average: FrozenActor(policy, average) for average in (False, True)}

    @property
    def state_dim(self) -> int:
        """Width of the actor's state, 0 for an MLP."""
        return self.policy.actor.state_dim

    def refresh(self) -> None:
        """Make the next :meth:`act` read the weights again; needed after changing them by hand."""
        self.policy.after_updates(0)

    def notice_changes(self) -> None:
        """Read the weights again if they were changed by hand since they were read."""
        if any(frozen.is_stale() for frozen in self._frozen.values()):
            self.refresh()

    def act(
        self,
        observations: FloatArray,
        states: FloatArray,
        deterministic: bool | BoolArray,
        rng: np.random.Generator,
        average: bool = False,
    ) -> tuple[FloatArray, FloatArray]:
        """Act in NumPy from the current weights.

        :param observations: ``(n, observation_dim)`` float32
        :param states: ``(n, state_dim)`` float32, zeros at the start of a window
        :param deterministic: the squashed mean instead of a sample, for all rows or for those of a mask ``(n,)``
        :param rng: source of the noise
        :param average: act from the averaged actor
        :return: unit actions ``(n, action_dim)`` and next states ``(n, state_dim)``
        """
        return self._frozen[average].act(observations, states, deterministic, rng)

    def means(self, observations: FloatArray, average: bool = False) -> FloatArray:
        """Unit actions ``(n, action_dim)`` without noise, of an actor without memory; parameters as of :meth:`act`."""
        no_memory = np.zeros((len(observations), 0), dtype=np.float32)
        unit, _ = self.act(observations, no_memory, True, _UNUSED, average)
        return unit

    def values(self, observations: FloatArray, unit_actions: FloatArray) -> FloatArray:
        """The lowest of the critics' values of actions, ``(n,)``.

        :param observations: ``(n, observation_dim)``
        :param unit_actions: ``(n, action_dim)`` in [-1, 1]
        """
        with th.no_grad():
            seen, actions = (
                th.as_tensor(x, dtype=th.float32, device=self.policy.device) for x in (observations, unit_actions)
            )
            return np.asarray(th.cat(self.policy.critic(seen, actions), dim=1).min(dim=1).values.cpu().numpy())
