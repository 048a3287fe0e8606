"""Flat storage: a network's parameters side by side in one vector, and Adam on that vector.

A network names its parameters as :class:`Block` objects; :class:`FlatParameters` lays them out and gives the blocks
back as views, which is what an update differentiates.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import NamedTuple

import torch as th
from torch import nn


class Block(NamedTuple):
    """Parameters that lie one after the other in flat storage, and the shape in which they are used together."""

    shape: tuple[int, ...]
    parameters: tuple[th.Tensor, ...]


def linear_layers(module: nn.Module) -> list[nn.Linear]:
    """The linear layers of an MLP, input side first."""
    return [layer for layer in module.modules() if isinstance(layer, nn.Linear)]


def in_one_piece(parameters: Sequence[th.Tensor]) -> th.Tensor | None:
    """Parameters that lie one after another as one tensor ``(n,)`` that shares their memory; None if they do not."""
    first = parameters[0].detach()
    end = first.data_ptr()
    for parameter in parameters:
        if parameter.data_ptr() != end:
            return None
        end += parameter.numel() * parameter.element_size()
    return first.as_strided(((end - first.data_ptr()) // first.element_size(),), (1,))


class FlatParameters:
    """One vector that holds a network's parameters; the network's modules are made to share its memory.

    :param blocks: which parameters, in which order and shapes
    :raises ValueError: if a parameter is not float32 on the CPU
    """

    def __init__(self, blocks: Sequence[Block]) -> None:
        self.shapes = [block.shape for block in blocks]
        self.sizes = [math.prod(shape) for shape in self.shapes]
        parameters = [p for block in blocks for p in block.parameters]
        for p in parameters:
            if p.dtype != th.float32 or p.device.type != "cpu":
                raise ValueError(
                    f"levels are trained in float32 on the CPU, got {p.dtype} on {p.device}; use device='cpu'"
                )
        self.vector = nn.Parameter(th.cat([p.detach().flatten() for p in parameters]))
        self._parameters = parameters
        self.alias()

    def alias(self) -> None:
        """Point the modules' parameters at their slices of the vector."""
        start = 0
        for p in self._parameters:
            p.data = self.vector.data[start : start + p.numel()].view(p.shape)
            start += p.numel()

    def is_aliased(self) -> bool:
        """Whether the modules still share the vector's memory; copying or moving a policy ends that."""
        flat = in_one_piece(self._parameters)
        return flat is not None and flat.data_ptr() == self.vector.data_ptr()

    def sync(self) -> None:
        """Copy the modules' values if they no longer share the vector's memory, and share it again."""
        if not self.is_aliased():
            self.vector.data.copy_(th.cat([p.detach().flatten() for p in self._parameters]))
            self.alias()

    def unflatten(self, vector: th.Tensor) -> list[th.Tensor]:
        """Views of a vector in the blocks' shapes; differentiable."""
        return [part.view(shape) for part, shape in zip(th.split(vector, self.sizes), self.shapes, strict=True)]


def flat_adam(parameter: th.Tensor, template: th.optim.Optimizer) -> th.optim.Adam:
    """An Adam over one flat tensor, with the options of ``template`` and its moments allocated at once.

    :raises ValueError: for an option of Adam that the flat update does not have
    """
    options = template.param_groups[0]
    if type(template) is not th.optim.Adam or options["weight_decay"] or options["amsgrad"] or options["maximize"]:
        raise ValueError(f"levels are trained by plain Adam, got {template}; leave optimizer_class at its default")
    adam = th.optim.Adam([parameter], lr=options["lr"], betas=options["betas"], eps=options["eps"])
    zeros = {"exp_avg": th.zeros_like(parameter.data), "exp_avg_sq": th.zeros_like(parameter.data)}
    adam.state[parameter] = {"step": th.tensor(0.0), **zeros}
    return adam
