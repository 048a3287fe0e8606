"""One SAC update as one function over flat storage, run eagerly or as one compiled graph.

The numbers are those of SB3's ``SAC.train`` (Haarnoja et al. 2018, arXiv 1812.05905), in its order: temperature,
critics, actor (through the updated critics), targets. What differs is the storage: a network's parameters lie in one
vector, whose slices the policy's modules share, so that

* all critics' layers are one batched product, Adam and Polyak averaging a few operations over one vector;
* the whole update is a function of a dozen tensors that can be traced and compiled once per batch size;
* the modules are never stale: ``predict``, ``save`` and ``get_parameters`` see each update without a copy.

Random numbers and schedules come in as tensors, nothing that changes is baked into the graph.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Sequence
from typing import Any, NamedTuple

import numpy as np
import torch as th
from torch import nn

from sb3_tbc.tbc_hrl.compilation import compile_step
from sb3_tbc.tbc_hrl.policies import Block, LevelPolicy
from sb3_tbc.type_aliases import LevelBatch

DIAGNOSTICS = ("critic_loss", "actor_loss", "ent_coef_loss", "ent_coef", "q_mean", "entropy")
AVERAGE_DECAY = 0.999
"""Decay per update of the averaged actor; during the first updates (1 + n) / (10 + n) where that is smaller."""
SQUASH_EPSILON = 1e-6
"""Added inside the logarithm of tanh's derivative, as SB3 does."""
HALF_LOG_TAU = 0.5 * math.log(2 * math.pi)


class Schedules(NamedTuple):
    """What varies from update to update, as 0-dim tensors."""

    actor_step: th.Tensor  # learning rate / (1 - beta1^n)
    critic_step: th.Tensor
    ent_coef_step: th.Tensor
    correction: th.Tensor  # 1 / sqrt(1 - beta2^n)
    tau: th.Tensor
    average_weight: th.Tensor  # 1 - decay of the averaged actor
    target_entropy: th.Tensor


class FlatParameters:
    """One vector that holds a network's parameters; the network's modules are made to share its memory.

    :param blocks: see :class:`sb3_tbc.tbc_hrl.policies.Block`
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
        """Whether the modules still share the vector's memory (``policy.to(...)`` may have moved them)."""
        start = self.vector.data_ptr()
        for p in self._parameters:
            if p.data_ptr() != start:
                return False
            start += p.numel() * p.element_size()
        return True

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


def adam_(
    options: dict[str, Any],
    parameter: th.Tensor,
    grad: th.Tensor,
    moments: tuple[th.Tensor, th.Tensor],
    step_size: th.Tensor,
    correction: th.Tensor,
) -> None:
    """One step of Adam in place; bias corrections come in with ``step_size`` and ``correction``."""
    (beta1, beta2), (mean, square) = options["betas"], moments
    mean.lerp_(grad, 1 - beta1)
    square.mul_(beta2).addcmul_(grad, grad, value=1 - beta2)
    parameter.sub_(mean / (square.sqrt() * correction + options["eps"]) * step_size)


def squash(mean: th.Tensor, log_std: th.Tensor, noise: th.Tensor) -> tuple[th.Tensor, th.Tensor]:
    """Squashed Gaussian sample ``(batch, action_dim)`` and its log-probability ``(batch, 1)``, from given noise."""
    actions = th.tanh(mean + log_std.exp() * noise)
    log_prob = -0.5 * noise.square() - log_std - HALF_LOG_TAU - th.log(1 - actions.square() + SQUASH_EPSILON)
    return actions, log_prob.sum(dim=-1, keepdim=True)


class SACUpdate:
    """The update of one level: flat storage for its policy, and the step that changes it.

    :param policy: the level's policy, on the device it stays on; its parameters are moved into flat storage and its
        optimizers replaced by flat ones
    :param ent_coef_optimizer: optimizer of the logarithm of the temperature, None for a fixed temperature
    :param compile: "auto" (compiled if there is a C++ compiler), True or False
    """

    def __init__(
        self, policy: LevelPolicy, ent_coef_optimizer: th.optim.Adam | None = None, compile: bool | str = "auto"
    ) -> None:
        self.policy = policy
        self.actor = FlatParameters(policy.actor.blocks())
        self.critic = FlatParameters(policy.critic.blocks())
        self.target = FlatParameters(policy.critic_target.blocks())
        self.average = FlatParameters(policy.average_actor.blocks())
        policy.actor.optimizer = flat_adam(self.actor.vector, policy.actor.optimizer)
        policy.critic.optimizer = flat_adam(self.critic.vector, policy.critic.optimizer)
        self.ent_coef_optimizer = ent_coef_optimizer
        self.action_dim = math.prod(policy.action_space.shape or (1,))
        self.compile = compile
        self._steps: dict[tuple[int, int], Callable[..., None]] = {}

    def __getstate__(self) -> dict[str, Any]:
        return {**self.__dict__, "_steps": {}}

    @property
    def compiled(self) -> bool:
        """Whether the last updates ran as a compiled graph."""
        return any(step != self._step for step in self._steps.values())

    def run(
        self,
        batch: LevelBatch,
        noise: th.Tensor,
        *,
        tau: float,
        target_entropy: float,
        ent_coef: th.Tensor,
    ) -> dict[str, float]:
        """Run one update per leading index of ``batch``.

        :param batch: tensors ``(gradient_steps, batch, ...)``
        :param noise: standard normal, ``(gradient_steps, 2, batch, action_dim)``: for the actions at the observations
            and for those at the next observations
        :param tau: Polyak factor
        :param target_entropy: for the automatic temperature, in nats
        :param ent_coef: fixed temperature, or its logarithm when it is automatic
        :return: mean over the burst of each of :data:`DIAGNOSTICS`
        """
        n_steps, batch_size = batch.rewards.shape[:2]
        batch = LevelBatch(*(x.contiguous() for x in batch))
        self._check(batch, noise)
        stats = th.zeros(len(DIAGNOSTICS))
        state = [stats, ent_coef.data, *self._state()]
        rows = self._schedules(n_steps, tau, target_entropy).unbind(0)
        step = self._step_for(batch_size, [*state, rows[0], noise[0], *(x[0] for x in batch)])
        for row, step_noise, *inputs in zip(rows, noise.unbind(0), *(x.unbind(0) for x in batch), strict=True):
            step(*state, row, step_noise, *inputs)
        for optimizer in self.optimizers():
            self._adam_state(optimizer)["step"] += n_steps
        return dict(zip(DIAGNOSTICS, (stats / n_steps).tolist(), strict=True))

    def _check(self, batch: LevelBatch, noise: th.Tensor) -> None:
        """The compiled step trusts shapes and types, so they are checked here, once per burst."""
        lead = tuple(batch.rewards.shape[:2])
        obs_dim, state_dim = math.prod(self.policy.observation_space.shape or ()), self.policy.actor.state_dim
        widths = (obs_dim, self.action_dim, obs_dim, 1, 1, 1, state_dim, state_dim)
        expected = {name: (*lead, width) for name, width in zip(LevelBatch._fields, widths, strict=True)}
        expected["noise"] = (lead[0], 2, lead[1], self.action_dim)
        for name, x in (*batch._asdict().items(), ("noise", noise)):
            if tuple(x.shape) != expected[name] or x.dtype != th.float32:
                raise ValueError(
                    f"batch.{name} must be float32 of shape {expected[name]}, got {x.dtype} {tuple(x.shape)}"
                )

    def optimizers(self) -> list[th.optim.Optimizer]:
        """Actor's, critics' and, when the temperature is automatic, the temperature's optimizer."""
        optimizers = [self.policy.actor.optimizer, self.policy.critic.optimizer]
        return optimizers if self.ent_coef_optimizer is None else [*optimizers, self.ent_coef_optimizer]

    @staticmethod
    def _adam_state(optimizer: th.optim.Optimizer) -> dict[str, th.Tensor]:
        state: dict[str, th.Tensor] = optimizer.state[optimizer.param_groups[0]["params"][0]]
        return state

    def _state(self) -> Iterator[th.Tensor]:
        """Everything an update changes besides statistics and temperature, read afresh since loading replaces some."""
        for flat in (self.actor, self.critic, self.target, self.average):
            yield flat.vector.data
        for optimizer in self.optimizers():
            moments = self._adam_state(optimizer)
            yield moments["exp_avg"]
            yield moments["exp_avg_sq"]
        yield from self.policy.actor.constants()

    def _schedules(self, n_steps: int, tau: float, target_entropy: float) -> th.Tensor:
        """A row of :class:`Schedules` per update."""
        first = float(self._adam_state(self.policy.actor.optimizer)["step"])
        count = first + 1 + np.arange(n_steps, dtype=np.float64)
        table = np.empty((n_steps, len(Schedules._fields)), dtype=np.float32)
        options = [optimizer.param_groups[0] for optimizer in self.optimizers()]
        for column in range(3):
            option = options[min(column, len(options) - 1)]
            table[:, column] = option["lr"] / (1 - option["betas"][0] ** count)
        table[:, 3] = 1 / np.sqrt(1 - options[0]["betas"][1] ** count)
        table[:, 4] = tau
        table[:, 5] = 1 - np.minimum(AVERAGE_DECAY, (1 + count) / (10 + count))
        table[:, 6] = target_entropy
        return th.from_numpy(table)

    def _step_for(self, batch_size: int, example: list[th.Tensor]) -> Callable[..., None]:
        """The step for a batch size and the circuit's present number of sub-steps, compiled when first asked for."""
        key = (batch_size, self.policy.actor.sub_steps)
        if key not in self._steps:
            self._steps[key] = compile_step(self._step, example, self.compile)
        return self._steps[key]

    def _step(self, stats: th.Tensor, ent: th.Tensor, *tensors: th.Tensor) -> None:
        """One update; the tensors of :meth:`_state`, ``stats`` and ``ent`` are changed in place."""
        actor, critic, target, average = tensors[:4]
        n_moments = 2 * len(self.optimizers())
        moments, constants = tensors[4 : 4 + n_moments], tensors[4 + n_moments : -10]
        row = Schedules(*tensors[-10].unbind())
        noise, batch = tensors[-9], LevelBatch(*tensors[-8:])
        policy, automatic = self.policy, self.ent_coef_optimizer is not None

        with th.enable_grad():
            actor_leaf = actor.detach().requires_grad_()
            actor_blocks = self.actor.unflatten(actor_leaf)
            mean, log_std, _ = policy.actor.step_blocks(actor_blocks, constants, batch.observations, batch.states)
            actions_pi, log_prob = squash(mean, log_std, noise[0])
        with th.no_grad():
            ent_coef = ent.exp() if automatic else ent.clone()
            surplus = (log_prob + row.target_entropy).mean()
            ent_coef_loss = -(ent * surplus).sum() if automatic else ent.new_zeros(())
            blocks = self.actor.unflatten(actor)
            mean, log_std, _ = policy.actor.step_blocks(blocks, constants, batch.next_observations, batch.next_states)
            next_actions, next_log_prob = squash(mean, log_std, noise[1])
            next_q = policy.critic.q_blocks(self.target.unflatten(target), batch.next_observations, next_actions)
            next_value = next_q.amin(dim=0) - ent_coef * next_log_prob
            target_q = batch.rewards + (1 - batch.dones) * batch.discounts * next_value
        with th.enable_grad():
            critic_leaf = critic.detach().requires_grad_()
            q = policy.critic.q_blocks(self.critic.unflatten(critic_leaf), batch.observations, batch.actions)
            critic_loss = 0.5 * (q - target_q).square().mean(dim=(1, 2)).sum()
            (critic_grad,) = th.autograd.grad(critic_loss, critic_leaf)
        critic_options = policy.critic.optimizer.param_groups[0]
        adam_(critic_options, critic, critic_grad, (moments[2], moments[3]), row.critic_step, row.correction)
        with th.enable_grad():
            q_pi = policy.critic.q_blocks(self.critic.unflatten(critic), batch.observations, actions_pi)
            actor_loss = (ent_coef * log_prob - q_pi.amin(dim=0)).mean()
            (actor_grad,) = th.autograd.grad(actor_loss, actor_leaf)
        actor_options = policy.actor.optimizer.param_groups[0]
        adam_(actor_options, actor, actor_grad, (moments[0], moments[1]), row.actor_step, row.correction)
        if automatic:  # last, so that nothing changes while both forward passes of the actor share what they compute
            ent_options = self.optimizers()[2].param_groups[0]
            adam_(ent_options, ent, -surplus.expand(1), (moments[4], moments[5]), row.ent_coef_step, row.correction)
        target.lerp_(critic, row.tau)
        average.lerp_(actor, row.average_weight)
        diagnostics = (critic_loss, actor_loss, ent_coef_loss, ent_coef.sum(), q.mean(), -log_prob.mean())
        stats.add_(th.stack([x.detach() for x in diagnostics]))
