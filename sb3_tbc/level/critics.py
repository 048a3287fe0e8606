"""Critics of one level: SB3's, evaluated all at once."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import torch as th
from stable_baselines3.common.policies import ContinuousCritic
from torch import nn
from torch.nn import functional

from sb3_tbc.level.storage import Block, linear_layers


class LevelCritic(ContinuousCritic):
    """SB3's critics, stored so that one batched product evaluates them all.

    :param negative: ``Q = logsigmoid(linear output)``, i.e. below zero, for levels whose rewards are never positive
        (HiTS's ``force_negative``)
    :param kwargs: arguments of SB3's ``ContinuousCritic``
    """

    def __init__(self, *, negative: bool = False, **kwargs: Any) -> None:
        super().__init__(**kwargs)
        self.negative = negative
        self.activation = kwargs.get("activation_fn", nn.ReLU)()

    def forward(self, obs: th.Tensor, actions: th.Tensor) -> tuple[th.Tensor, ...]:
        """Q-values ``(batch, 1)`` of every critic."""
        values = super().forward(obs, actions)
        return tuple(functional.logsigmoid(q) for q in values) if self.negative else values

    def q1_forward(self, obs: th.Tensor, actions: th.Tensor) -> th.Tensor:
        """Q-value ``(batch, 1)`` of the first critic, without gradient."""
        value = super().q1_forward(obs, actions)
        return functional.logsigmoid(value) if self.negative else value

    def blocks(self) -> list[Block]:
        """Per layer, all critics' weights ``(n_critics, out, in)`` and biases ``(n_critics, 1, out)``."""
        blocks = []
        for layers in zip(*(linear_layers(net) for net in self.q_networks), strict=True):
            weights, biases = tuple(layer.weight for layer in layers), tuple(layer.bias for layer in layers)
            blocks.append(Block((len(layers), *weights[0].shape), weights))
            blocks.append(Block((len(layers), 1, *biases[0].shape), biases))
        return blocks

    def q_blocks(self, blocks: Sequence[th.Tensor], obs: th.Tensor, actions: th.Tensor) -> th.Tensor:
        """All critics' values ``(n_critics, batch, 1)`` as a function of the parameter blocks."""
        # The first layer sees the same inputs in every critic, so all critics' rows are one (batch, in) x (in, n * out)
        # product; from then on one batched product (n, batch, in) x (n, in, out) per layer.
        inputs = th.cat((obs, actions), dim=-1)
        weight, bias = blocks[0], blocks[1]
        first = functional.linear(inputs, weight.flatten(0, 1), bias.flatten())
        values = first.view(-1, len(weight), weight.shape[1]).transpose(0, 1)
        for weight, bias in zip(blocks[2::2], blocks[3::2], strict=True):
            values = th.baddbmm(bias, self.activation(values), weight.transpose(1, 2))
        return functional.logsigmoid(values) if self.negative else values
