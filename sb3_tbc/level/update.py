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

from sb3_tbc.level.compilation import compile_step
from sb3_tbc.level.policies import Block, LevelPolicy
from sb3_tbc.replay.batch import LevelBatch

DIAGNOSTICS = ("critic_loss", "actor_loss", "ent_coef_loss", "ent_coef", "q_mean", "entropy")
AVERAGE_DECAY = 0.999
"""Decay per update of the averaged actor unless given; during the first updates (1 + n) / (10 + n) if smaller."""
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


class StepInputs(NamedTuple):
    """Arguments of one update, sorted."""

    stats: th.Tensor  # sums of DIAGNOSTICS
    ent: th.Tensor  # temperature, or its logarithm when it is automatic
    actor: th.Tensor
    critic: th.Tensor
    target: th.Tensor
    average: th.Tensor
    moments: list[tuple[th.Tensor, th.Tensor]]  # Adam's, per optimizer: actor, critic, temperature
    constants: list[th.Tensor]
    row: Schedules
    noise: th.Tensor
    labels: list[th.Tensor]  # what the last action coordinate is drawn toward, or none
    batch: LevelBatch


class FlatParameters:
    """One vector that holds a network's parameters; the network's modules are made to share its memory.

    :param blocks: see :class:`sb3_tbc.level.policies.Block`
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
        start = self.vector.data_ptr()
        for p in self._parameters:
            if p.data_ptr() != start:
                return False
            start += p.numel() * p.element_size()
        return True

    def sync(self) -> None:
        """Take over the modules' values if they no longer share the vector's memory, and share it again."""
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
    :param label_coef: weight of the squared distance between the actor's last action coordinate and given labels
    :param average_decay: decay per update of the averaged actor
    """

    def __init__(
        self,
        policy: LevelPolicy,
        ent_coef_optimizer: th.optim.Adam | None = None,
        compile: bool | str = "auto",
        label_coef: float = 0.0,
        average_decay: float = AVERAGE_DECAY,
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
        self.label_coef, self.average_decay = label_coef, average_decay
        self._steps: dict[tuple[int, int], Callable[..., None]] = {}

    def __getstate__(self) -> dict[str, Any]:
        return {**self.__dict__, "_steps": {}}

    @property
    def automatic(self) -> bool:
        """Whether the temperature is learnt."""
        return self.ent_coef_optimizer is not None

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
        labels: th.Tensor | None = None,
    ) -> dict[str, float]:
        """Run one update per leading index of ``batch``.

        :param batch: tensors ``(gradient_steps, batch, ...)``
        :param noise: standard normal, ``(gradient_steps, 2, batch, action_dim)``: for the actions at the observations
            and for those at the next observations
        :param tau: Polyak factor
        :param target_entropy: for the automatic temperature, in nats
        :param ent_coef: fixed temperature, or its logarithm when it is automatic
        :param labels: ``(gradient_steps, batch, 1)`` in [-1, 1], needed where ``label_coef`` is not 0
        :return: mean over the burst of each of :data:`DIAGNOSTICS`
        """
        n_steps = len(batch.rewards)
        batch = LevelBatch(*(x.contiguous() for x in batch))
        given = [] if labels is None else [labels.contiguous()]
        self._check(batch, noise, given)
        stats = th.zeros(len(DIAGNOSTICS))
        state = [stats, ent_coef.data, *self._state()]
        rows = self._schedules(n_steps, tau, target_entropy)
        bursts = (rows, noise, *given, *batch)
        step = self._step_for([*state, *(x[0] for x in bursts)])
        for inputs in zip(*(x.unbind(0) for x in bursts), strict=True):
            step(*state, *inputs)
        for optimizer in self.optimizers():
            self._adam_state(optimizer)["step"] += n_steps
        return dict(zip(DIAGNOSTICS, (stats / n_steps).tolist(), strict=True))

    def _shapes(self, n_steps: int, batch_size: int) -> dict[str, tuple[int, ...]]:
        """Shapes of what changes from update to update, in the order of the step's arguments."""
        obs_dim, state_dim = math.prod(self.policy.observation_space.shape or ()), self.policy.actor.state_dim
        widths = (obs_dim, self.action_dim, obs_dim, 1, 1, 1, state_dim, state_dim)
        shapes: dict[str, tuple[int, ...]] = {
            "schedules": (n_steps, len(Schedules._fields)),
            "noise": (n_steps, 2, batch_size, self.action_dim),
        }
        if self.label_coef:
            shapes["labels"] = (n_steps, batch_size, 1)
        for name, width in zip(LevelBatch._fields, widths, strict=True):
            shapes[name] = (n_steps, batch_size, width)
        return shapes

    def _check(self, batch: LevelBatch, noise: th.Tensor, labels: Sequence[th.Tensor]) -> None:
        """The compiled step trusts shapes and types, so they are checked here, once per burst."""
        if len(labels) != bool(self.label_coef):
            raise ValueError(f"labels are needed where label_coef is not 0, and only there; it is {self.label_coef}")
        shapes = self._shapes(*batch.rewards.shape[:2])
        for name, x in (("noise", noise), *(("labels", x) for x in labels), *batch._asdict().items()):
            if tuple(x.shape) != shapes[name] or x.dtype != th.float32:
                raise ValueError(
                    f"batch.{name} must be float32 of shape {shapes[name]}, got {x.dtype} {tuple(x.shape)}"
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
            flat.sync()
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
        table[:, 5] = 1 - np.minimum(self.average_decay, (1 + count) / (10 + count))
        table[:, 6] = target_entropy
        return th.from_numpy(table)

    def _step_for(self, example: list[th.Tensor]) -> Callable[..., None]:
        """The step for a batch size and the circuit's present number of sub-steps, compiled when first asked for."""
        key = (len(example[-1]), self.policy.actor.sub_steps)
        if key not in self._steps:
            self._steps[key] = compile_step(self._step, example, self.compile)
        return self._steps[key]

    def choose(self, compile: bool | str) -> None:
        """Run updates compiled or eagerly from now on."""
        if compile != self.compile:
            self.compile = compile
            self._steps.clear()

    def _example(self, batch_size: int, ent_coef: th.Tensor) -> list[th.Tensor]:
        """Arguments of the step: the state itself, and a batch of zeros."""
        per_step = [th.zeros(shape[1:]) for shape in self._shapes(1, batch_size).values()]
        return [th.zeros(len(DIAGNOSTICS)), ent_coef.data, *self._state(), *per_step]

    def prepare(self, batch_size: int, ent_coef: th.Tensor) -> None:
        """Compile for a batch size now rather than at the first update."""
        self._step_for(self._example(batch_size, ent_coef))

    def rehearse(self, batch_size: int, ent_coef: th.Tensor) -> None:
        """One update on copies, eagerly, for those who want to watch its operations."""
        self._step(*(tensor.clone() for tensor in self._example(batch_size, ent_coef)))

    def _step(self, *tensors: th.Tensor) -> None:
        """One update; everything of :class:`StepInputs` before ``constants`` is changed in place."""
        x = self._unpack(tensors)
        with th.enable_grad():
            actor_leaf = x.actor.detach().requires_grad_()
            actions_pi, log_prob = self._sample(actor_leaf, x, x.batch.observations, x.batch.states, x.noise[0])
        ent_coef = x.ent.exp() if self.automatic else x.ent.clone()
        surplus = (log_prob.detach() + x.row.target_entropy).mean()

        target_q = self._target_q(x, ent_coef)
        critic_loss, q_mean = self._update_critics(x, target_q)
        actor_loss = self._update_actor(x, actor_leaf, actions_pi, log_prob, ent_coef)
        # The temperature last, so that nothing changes while both forward passes of the actor share what they compute;
        # the losses use its value from before the update, as in SB3.
        ent_coef_loss = -(x.ent * surplus).sum() if self.automatic else x.ent.new_zeros(())
        if self.automatic:
            self._adam(2, x.ent, -surplus.expand(1), x, x.row.ent_coef_step)
        x.target.lerp_(x.critic, x.row.tau)
        x.average.lerp_(x.actor, x.row.average_weight)
        diagnostics = (critic_loss, actor_loss, ent_coef_loss, ent_coef.sum(), q_mean, -log_prob.mean())
        x.stats.add_(th.stack([value.detach() for value in diagnostics]))

    def _unpack(self, tensors: Sequence[th.Tensor]) -> StepInputs:
        stats, ent, actor, critic, target, average, *rest = tensors
        n_moments = 2 * len(self.optimizers())
        moments = list(zip(rest[0:n_moments:2], rest[1:n_moments:2], strict=True))
        n_labels = int(bool(self.label_coef))
        per_step = 2 + n_labels + len(LevelBatch._fields)  # what changes from update to update
        row, noise, *sampled = rest[-per_step:]
        constants = rest[n_moments:-per_step]
        return StepInputs(
            stats, ent, actor, critic, target, average, moments, constants,
            Schedules(*row.unbind()), noise, sampled[:n_labels], LevelBatch(*sampled[n_labels:]),
        )  # fmt: skip

    def _sample(
        self, vector: th.Tensor, x: StepInputs, obs: th.Tensor, state: th.Tensor, noise: th.Tensor
    ) -> tuple[th.Tensor, th.Tensor]:
        """Actions of the actor whose parameters are ``vector``, and their log-probabilities."""
        mean, log_std, _ = self.policy.actor.step_blocks(self.actor.unflatten(vector), x.constants, obs, state)
        return squash(mean, log_std, noise)

    def _target_q(self, x: StepInputs, ent_coef: th.Tensor) -> th.Tensor:
        """``r + (1 - done) discount (min Q'(s', a') - alpha log pi(a' | s'))``, ``(batch, 1)``."""
        batch = x.batch
        with th.no_grad():
            actions, log_prob = self._sample(x.actor, x, batch.next_observations, batch.next_states, x.noise[1])
            q = self.policy.critic.q_blocks(self.target.unflatten(x.target), batch.next_observations, actions)
            return batch.rewards + (1 - batch.dones) * batch.discounts * (q.amin(dim=0) - ent_coef * log_prob)

    def _update_critics(self, x: StepInputs, target_q: th.Tensor) -> tuple[th.Tensor, th.Tensor]:
        """Step on half the summed mean squared errors; the loss and the mean Q-value before it."""
        with th.enable_grad():
            leaf = x.critic.detach().requires_grad_()
            q = self.policy.critic.q_blocks(self.critic.unflatten(leaf), x.batch.observations, x.batch.actions)
            loss = 0.5 * (q - target_q).square().mean(dim=(1, 2)).sum()
            (grad,) = th.autograd.grad(loss, leaf)
        self._adam(1, x.critic, grad, x, x.row.critic_step)
        return loss, q.mean()

    def _update_actor(
        self, x: StepInputs, leaf: th.Tensor, actions: th.Tensor, log_prob: th.Tensor, ent_coef: th.Tensor
    ) -> th.Tensor:
        """Step on ``alpha log pi - min Q`` through the updated critics, and on the labels' loss where there are any.

        The latter is the paper's ``L_dt = E (dt - dt*)^2``, in unit coordinates of the action.
        """
        with th.enable_grad():
            q = self.policy.critic.q_blocks(self.critic.unflatten(x.critic), x.batch.observations, actions)
            loss = (ent_coef * log_prob - q.amin(dim=0)).mean()
            for labels in x.labels:
                loss = loss + self.label_coef * (actions[:, -1:] - labels).square().mean()
            (grad,) = th.autograd.grad(loss, leaf)
        self._adam(0, x.actor, grad, x, x.row.actor_step)
        return loss

    def _adam(self, which: int, parameter: th.Tensor, grad: th.Tensor, x: StepInputs, step_size: th.Tensor) -> None:
        """One step of Adam in place; the bias corrections come in with ``step_size`` and ``row.correction``."""
        options = self.optimizers()[which].param_groups[0]
        (beta1, beta2), (mean, square) = options["betas"], x.moments[which]
        mean.lerp_(grad, 1 - beta1)
        square.mul_(beta2).addcmul_(grad, grad, value=1 - beta2)
        parameter.sub_(mean / (square.sqrt() * x.row.correction + options["eps"]) * step_size)
