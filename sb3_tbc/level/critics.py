"""Critics of one level: SB3's, evaluated all at once, on request with normalised layers."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from typing import Any

import torch as th
from stable_baselines3.common.policies import ContinuousCritic
from torch import nn
from torch.nn import functional

from sb3_tbc.errors import ConfigError
from sb3_tbc.level.storage import Block, linear_layers

NORMS = ("none", "layer", "batch")
NORM_EPSILON = 1e-5
"""Added to variances before their root is taken, as torch's normalisations do."""
BATCH_MOMENTUM = 0.01
"""Share of the newest batch in the running statistics of batch normalisation, as in CrossQ (arXiv 1902.05605)."""
ACTOR_Q = {"min": 0.0, "max": 1.0, "mean": None}
"""Values of ``actor_q`` that have a name; the mean is over all critics, even if there are more than two."""


def optimism_of(actor_q: str | float) -> float | None:
    """Where between the smallest (0) and the largest (1) critic the actor's value lies; None for the mean.

    :raises ValueError: for another value of ``actor_q``
    """
    if isinstance(actor_q, str) and actor_q in ACTOR_Q:
        return ACTOR_Q[actor_q]
    if isinstance(actor_q, int | float) and not isinstance(actor_q, bool) and 0.0 <= actor_q <= 1.0:
        return float(actor_q)
    raise ValueError(
        f"actor_q must be 'min', 'mean', 'max' or a number from 0 (the smallest critic) to 1 (the largest), got "
        f"{actor_q!r}"
    )


class LevelCritic(ContinuousCritic):
    """SB3's critics, stored so that one batched product evaluates them all.

    :param negative: ``Q = logsigmoid(linear output)``, i.e. below zero, for levels whose rewards are never positive
        (HiTS's ``force_negative``)
    :param norm: ``"none"``; ``"layer"``: each hidden layer is normalised before its activation (with scale and shift);
        ``"batch"``: each layer's input is normalised by the batch's mean and variance, as in CrossQ (arXiv 1902.05605).
        Batch normalisation has neither scale nor shift here, since the linear layer that follows has both
    :param kwargs: arguments of SB3's ``ContinuousCritic``
    :raises ConfigError: for another ``norm``
    """

    def __init__(self, *, negative: bool = False, norm: str = "none", **kwargs: Any) -> None:
        if norm not in NORMS:
            raise ConfigError(f"critic_norm must be one of {', '.join(map(repr, NORMS))}, got {norm!r}")
        super().__init__(**kwargs)
        self.negative, self.norm = negative, norm
        self.activation = kwargs.get("activation_fn", nn.ReLU)()
        for index, net in enumerate(self.q_networks):
            self.q_networks[index] = nn.Sequential(*self._normalised(net))
            self.add_module(f"qf{index}", self.q_networks[index])

    def _normalised(self, net: nn.Module) -> Iterator[nn.Module]:
        """The modules of a network with the normalisations between them."""
        *_, last = linear_layers(net)
        for module in net.children():
            linear = module if isinstance(module, nn.Linear) else None
            if linear and self.norm == "batch":
                yield nn.BatchNorm1d(linear.in_features, NORM_EPSILON, BATCH_MOMENTUM, affine=False)
            yield module
            if linear and self.norm == "layer" and module is not last:
                yield nn.LayerNorm(linear.out_features, NORM_EPSILON)

    def train(self, mode: bool = True) -> LevelCritic:
        """As torch's, but batch normalisation always uses its running statistics: the level's update keeps them."""
        super().train(mode)
        for module in self.modules():
            if isinstance(module, nn.BatchNorm1d):
                module.eval()
        return self

    def forward(self, obs: th.Tensor, actions: th.Tensor) -> tuple[th.Tensor, ...]:
        """Q-values ``(batch, 1)`` of every critic."""
        values = super().forward(obs, actions)
        return tuple(functional.logsigmoid(q) for q in values) if self.negative else values

    def q1_forward(self, obs: th.Tensor, actions: th.Tensor) -> th.Tensor:
        """Q-value ``(batch, 1)`` of the first critic, without gradient."""
        value = super().q1_forward(obs, actions)
        return functional.logsigmoid(value) if self.negative else value

    def blocks(self) -> list[Block]:
        """Per layer, all critics' weights ``(n_critics, out, in)`` and biases ``(n_critics, 1, out)``.

        With layer normalisation, scales and shifts ``(n_critics, 1, out)`` follow those of each hidden layer.
        """
        trained = [
            [module for module in net.modules() if isinstance(module, nn.Linear | nn.LayerNorm)]
            for net in self.q_networks
        ]
        blocks = []
        for layers in zip(*trained, strict=True):
            weights, biases = (tuple(getattr(layer, name) for layer in layers) for name in ("weight", "bias"))
            rows = tuple(weights[0].shape) if isinstance(layers[0], nn.Linear) else (1, *weights[0].shape)
            blocks += [Block((len(layers), *rows), weights), Block((len(layers), 1, *biases[0].shape), biases)]
        return blocks

    def statistics(self) -> list[Block]:
        """Per layer, all critics' running means and variances ``(n_critics, 1, in)``; none without batch norm."""
        norms = [[m for m in net.modules() if isinstance(m, nn.BatchNorm1d)] for net in self.q_networks]
        blocks = []
        for layers in zip(*norms, strict=True):
            for name in ("running_mean", "running_var"):
                values = tuple(getattr(layer, name) for layer in layers)
                blocks.append(Block((len(layers), 1, *values[0].shape), values))
        return blocks

    def q_blocks(
        self, blocks: Sequence[th.Tensor], obs: th.Tensor, actions: th.Tensor, statistics: Sequence[th.Tensor] = ()
    ) -> th.Tensor:
        """All critics' values ``(n_critics, batch, 1)`` as a function of the parameter blocks.

        :param statistics: tensors of the blocks of :meth:`statistics`
        """
        inputs = th.cat((obs, actions), dim=-1)
        if self.norm == "batch":
            pairs = iter(zip(statistics[0::2], statistics[1::2], strict=True))
            return self._batch_normalised(blocks, inputs, lambda values: next(pairs))
        # The first layer sees the same inputs in every critic, so all critics' rows are one (batch, in) x (in, n * out)
        # product; from then on one batched product (n, batch, in) x (n, in, out) per layer.
        weight, bias, *rest = blocks
        first = functional.linear(inputs, weight.flatten(0, 1), bias.flatten())
        values = first.view(-1, len(weight), weight.shape[1]).transpose(0, 1)
        while rest:
            if self.norm == "layer":
                scale, shift, *rest = rest
                values = functional.layer_norm(values, values.shape[-1:], eps=NORM_EPSILON) * scale + shift
            weight, bias, *rest = rest
            values = th.baddbmm(bias, self.activation(values), weight.transpose(1, 2))
        return functional.logsigmoid(values) if self.negative else values

    def q_blocks_of_batch(
        self, blocks: Sequence[th.Tensor], obs: th.Tensor, actions: th.Tensor
    ) -> tuple[th.Tensor, list[th.Tensor]]:
        """:meth:`q_blocks`, normalised by the batch's own statistics, and these, as :meth:`statistics` orders them."""
        seen: list[th.Tensor] = []

        def measure(values: th.Tensor) -> tuple[th.Tensor, th.Tensor]:
            variance, mean = th.var_mean(values, dim=1, correction=0, keepdim=True)
            seen.extend((mean.detach(), variance.detach()))
            return mean, variance

        return self._batch_normalised(blocks, th.cat((obs, actions), dim=-1), measure), seen

    def _batch_normalised(
        self,
        blocks: Sequence[th.Tensor],
        inputs: th.Tensor,
        statistics_of: Callable[[th.Tensor], tuple[th.Tensor, th.Tensor]],
    ) -> th.Tensor:
        """Values ``(n_critics, batch, 1)`` with every layer's input normalised.

        :param statistics_of: mean and variance ``(n_critics, 1, width)`` to normalise a layer's input with
        """
        values = inputs.expand(len(blocks[0]), -1, -1)
        for layer, (weight, bias) in enumerate(zip(blocks[0::2], blocks[1::2], strict=True)):
            values = self.activation(values) if layer else values
            mean, variance = statistics_of(values)
            values = th.baddbmm(bias, (values - mean) * th.rsqrt(variance + NORM_EPSILON), weight.transpose(1, 2))
        return functional.logsigmoid(values) if self.negative else values
