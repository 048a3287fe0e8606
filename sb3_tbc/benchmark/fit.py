"""``python -m sb3_tbc.benchmark fit``: how fast and how well small actors learn skills by imitation.

Imitation shows in a minute what an actor can represent. Each actor learns each skill with Adam, in batches of 256 rows
(32 sequences for delays), at every learning rate of a grid. R2 on rows of later episodes is reported at the best rate.
As in training, the averaged actor is evaluated.
"""

from __future__ import annotations

import argparse
import math
import sys
from collections.abc import Callable, Sequence
from functools import partial
from typing import NamedTuple

import torch as th
from torch import nn
from torch.func import functional_call, grad, vmap
from torch.fx.experimental.proxy_tensor import make_fx

from sb3_tbc.benchmark.actors import Actor, count, parse_actor
from sb3_tbc.benchmark.conditioning import group_of
from sb3_tbc.benchmark.skills import Skill, load_skill, skill_names
from sb3_tbc.errors import ConfigError

ROWS, SEQUENCES = 256, 32
AVERAGE_DECAY = 0.995
LARGEST_GRADIENT = 1.0

Weights = dict[str, th.Tensor]
"""Parameters by name; with a first dimension for rates where there are several networks."""
OPTIMIZERS: dict[str, Callable[..., th.optim.Optimizer]] = {
    "adam": partial(th.optim.Adam, fused=True),
    "nadam": th.optim.NAdam,
    "radam": th.optim.RAdam,
}


class Fit(NamedTuple):
    """R2 on rows of later episodes, and on rows that were learnt from."""

    later: float
    learnt: float


class Result(NamedTuple):
    """Quality of an actor's fit to a skill."""

    skill: str
    actor: str
    parameters: int
    r2: dict[int, float]  # on later episodes, by Adam steps, each at its best rate
    rates: dict[int, float]  # the best ones
    r2_learnt: dict[int, float]  # at the same rates, on rows that were learnt from


def explained(outputs: th.Tensor, targets: th.Tensor) -> float:
    """Share of the targets' variance that the outputs explain."""
    error = (outputs - targets).square().sum()
    around = (targets - targets.flatten(0, -2).mean(dim=0)).square().sum()
    return float(1.0 - error / around)


@th.no_grad()
def judge(network: nn.Module, weights: Weights, skill: Skill) -> Fit:
    """How well a network fits, on as many rows learnt from as there are later ones.

    :param network: gives the structure
    :param weights: its parameters
    """
    rows = th.linspace(0, len(skill.inputs) - 1, len(skill.later_inputs)).long()
    pairs = ((skill.later_inputs, skill.later_targets), (skill.inputs[rows], skill.targets[rows]))
    return Fit(*(explained(functional_call(network, weights, (x,))[0], y) for x, y in pairs))


def learn(actor: Actor, skill: Skill, steps: Sequence[int], seed: int = 0) -> dict[float, dict[int, Fit]]:
    """How well the averaged network fits after the given numbers of steps, at each of the actor's constant rates.

    The networks of all rates start alike, see the same batches, and learn side by side.
    """
    network = actor.make(skill, seed)
    start = {name: p.detach() for name, p in network.named_parameters() if p.requires_grad}
    weights = {name: th.stack([p] * len(actor.rates)) for name, p in start.items()}
    average = {name: p.clone() for name, p in weights.items()}
    update = _updater(actor, weights)
    generator = th.Generator().manual_seed(seed)
    batch = SEQUENCES if skill.inputs.dim() == 3 else ROWS
    gradients = gradients_of(network, weights, skill.inputs[:batch], skill.targets[:batch])
    reached: dict[float, dict[int, Fit]] = {rate: {} for rate in actor.rates}
    for step in range(1, max(steps) + 1):
        rows = th.randint(len(skill.inputs), (batch,), generator=generator)
        update(gradients(weights, skill.inputs[rows], skill.targets[rows]))
        weight = 1.0 - min(AVERAGE_DECAY, (1 + step) / (10 + step))
        th._foreach_lerp_(list(average.values()), list(weights.values()), weight)
        if step in steps:
            for i, rate in enumerate(actor.rates):
                reached[rate][step] = judge(network, {name: p[i] for name, p in average.items()}, skill)
    return reached


def _updater(actor: Actor, weights: Weights) -> Callable[[Weights], None]:
    """What takes a step of the actor's optimiser, in place, given the gradients."""
    views = {(name, i): nn.Parameter(p[i]) for name, p in weights.items() for i in range(len(p))}
    groups: dict[float, list[nn.Parameter]] = {}
    for (name, i), view in views.items():
        groups.setdefault(actor.rates[i] * actor.factors.get(group_of(name), 1.0), []).append(view)
    optimizer = OPTIMIZERS[actor.optimizer]([{"params": views, "lr": rate} for rate, views in groups.items()])

    def update(gradients: Weights) -> None:
        for (name, i), view in views.items():
            view.grad = gradients[name][i]
        optimizer.step()

    return update


def gradients_of(
    network: nn.Module, weights: Weights, inputs: th.Tensor, targets: th.Tensor
) -> Callable[[Weights, th.Tensor, th.Tensor], Weights]:
    """A function that gives the clipped gradients of several networks from their weights and a batch.

    A single small network spends most of its time outside arithmetic. So where inputs are rows, all networks are traced
    into one list of tensor operations. What is unrolled over time cannot be traced like this: one after the other.

    :param network: gives the structure
    :param weights: for each parameter ``(networks, ...)``
    :param inputs: a batch of the size of all later ones
    :param targets: its targets
    """
    buffers = dict(network.named_buffers())

    def loss(one: Weights, x: th.Tensor, y: th.Tensor) -> th.Tensor:
        outputs: th.Tensor = functional_call(network, {**one, **buffers}, (x,))[0]
        return (outputs - y).square().mean()

    def alone(weights: Weights, x: th.Tensor, y: th.Tensor) -> Weights:
        found = []
        for i in range(len(next(iter(weights.values())))):
            one = {name: p[i].detach().requires_grad_() for name, p in weights.items()}
            slopes = th.autograd.grad(loss(one, x, y), list(one.values()))
            found.append(_clipped(dict(zip(one, slopes, strict=True))))
        return {name: th.stack([each[name] for each in found]) for name in weights}

    if inputs.dim() == 3 or any(isinstance(part, nn.RNNBase) for part in network.modules()):
        return alone
    together = vmap(lambda one, x, y: _clipped(grad(loss)(one, x, y)), in_dims=(0, None, None))
    traced: Callable[[Weights, th.Tensor, th.Tensor], Weights] = make_fx(together)(weights, inputs, targets)
    return traced


def _clipped(gradients: Weights) -> Weights:
    """The gradients of one network, scaled down where their norm is large."""
    norm = th.stack([slope.square().sum() for slope in gradients.values()]).sum().sqrt()
    scale = (LARGEST_GRADIENT / (norm + 1e-6)).clamp(max=1.0)
    return {name: slope * scale for name, slope in gradients.items()}


def best_of(actor: Actor, skill: Skill, steps: Sequence[int], seeds: Sequence[int]) -> Result:
    """R2 at the best of the actor's rates, for every number of steps; means over seeds."""
    try:
        parameters = count(actor.make(skill, seeds[0]))
    except ValueError as error:
        raise ConfigError(f"actor {actor.name!r}: {error}") from error
    runs = [learn(actor, skill, steps, seed) for seed in seeds]
    found = {rate: {step: _mean([run[rate][step] for run in runs]) for step in steps} for rate in actor.rates}

    def order(step: int, rate: float) -> float:
        later = found[rate][step].later
        return later if math.isfinite(later) else -math.inf  # a network may diverge

    rates = {step: max(found, key=partial(order, step)) for step in steps}
    best = {step: found[rates[step]][step] for step in steps}
    later, learnt = ({step: fit[i] for step, fit in best.items()} for i in range(2))
    return Result(skill.name, actor.name, parameters, later, rates, learnt)


def _mean(fits: Sequence[Fit]) -> Fit:
    return Fit(*(sum(values) / len(fits) for values in zip(*fits, strict=True)))


def fit(arguments: argparse.Namespace) -> tuple[list[str], dict[str, object]]:
    """Lines to print, and the figures of all actors on all skills."""
    th.set_num_threads(1)
    steps = sorted(arguments.steps)
    actors = [parse_actor(text) for text in arguments.actors]
    lines = [
        "R2 on later episodes after Adam steps, at the best rate (in brackets) of each actor's grid; last column:",
        "R2 after the last steps on rows that were learnt from, for comparison",
        "",
        f"| skill | actor | parameters | {' | '.join(str(step) for step in steps)} | learnt from |",
        "|---" * (4 + len(steps)) + "|",
    ]
    results = []
    for name in arguments.tasks or skill_names():
        skill = load_skill(name)
        for actor in actors:
            result = best_of(actor, skill, steps, range(arguments.seeds))
            figures = " | ".join(f"{result.r2[step]:.3f} ({result.rates[step]:g})" for step in steps)
            lines.append(
                f"| {name} | {actor.name} | {result.parameters} | {figures} | {result.r2_learnt[steps[-1]]:.3f} |"
            )
            print(lines[-1], file=sys.stderr, flush=True)  # a table may take an hour
            results.append(result._asdict())
    return lines, {"fit": results}
