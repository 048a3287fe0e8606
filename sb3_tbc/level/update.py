"""One SAC update as one function over flat storage, run eagerly or as one compiled graph.

The numbers are those of SB3's ``SAC.train`` (Haarnoja et al. 2018, arXiv 1812.05905), in its order: temperature,
critics, actor (through the updated critics), targets. What differs is the storage: a network's parameters lie in one
vector, whose slices the policy's modules share, so that

* all critics' layers are one batched product, Adam and Polyak averaging a few operations over one vector;
* the whole update is a function of a few dozen tensors that can be traced and compiled once per batch size;
* the modules are never stale: ``predict``, ``save`` and ``get_parameters`` see each update without a copy.

Random numbers and schedules come in as tensors, nothing that changes is baked into the graph. The function's arguments
are the leaves of :class:`StepInputs`, in the order that torch's pytree gives them.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Any, NamedTuple

import numpy as np
import torch as th
from torch.utils._pytree import tree_flatten, tree_leaves, tree_unflatten

from sb3_tbc.level.compilation import compile_step
from sb3_tbc.level.policies import LevelPolicy
from sb3_tbc.level.storage import FlatParameters, flat_adam
from sb3_tbc.replay.batch import LevelBatch

DIAGNOSTICS = ("critic_loss", "actor_loss", "ent_coef_loss", "ent_coef", "q_mean", "entropy")
AVERAGE_DECAY = 0.999
"""Decay per update of the averaged actor unless given; during the first updates (1 + n) / (10 + n) if smaller."""
SQUASH_EPSILON = 1e-6
"""Added inside the logarithm of tanh's derivative, as SB3 does."""
HALF_LOG_TAU = 0.5 * math.log(2 * math.pi)


class Schedules(NamedTuple):
    """Numbers that vary from update to update, as 0-dim tensors."""

    actor_step: th.Tensor  # learning rate / (1 - beta1^n)
    critic_step: th.Tensor
    ent_coef_step: th.Tensor
    correction: th.Tensor  # 1 / sqrt(1 - beta2^n)
    tau: th.Tensor
    average_weight: th.Tensor  # 1 - decay of the averaged actor
    target_entropy: th.Tensor


class Moments(NamedTuple):
    """Adam's running means for one flat parameter."""

    mean: th.Tensor
    square: th.Tensor


class LearntState(NamedTuple):
    """What an update starts from. All but ``constants`` is changed in place."""

    sums: th.Tensor  # (len(DIAGNOSTICS),)
    ent: th.Tensor  # temperature, or its logarithm when it is automatic
    actor: th.Tensor
    critic: th.Tensor
    target: th.Tensor
    average: th.Tensor
    moments: tuple[Moments, ...]  # of actor, critics and, when it is automatic, temperature
    constants: list[th.Tensor]  # the actor's tensors that are not trained


class Given(NamedTuple):
    """What is new in each update; a burst of updates has one more leading dimension."""

    row: th.Tensor  # (len(Schedules._fields),)
    noise: th.Tensor  # (2, batch, action_dim): for the actions at the observations and at the next observations
    labels: tuple[th.Tensor, ...]  # (batch, 1), what the last action coordinate is drawn toward, or none
    batch: LevelBatch


class StepInputs(NamedTuple):
    """Arguments of one update."""

    state: LearntState
    given: Given


def squash(mean: th.Tensor, log_std: th.Tensor, noise: th.Tensor) -> tuple[th.Tensor, th.Tensor]:
    """Squashed Gaussian sample ``(batch, action_dim)`` and its log-probability ``(batch, 1)``, from given noise."""
    # u = mean + std * noise, a = tanh(u); log pi(a) = log N(u; mean, std) - sum log(1 - tanh(u)^2)
    # (appendix C of arXiv 1801.01290). With u standardised, log N is a function of the noise alone.
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
        *,
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
        self._shapes: dict[int, list[th.Size]] = {}  # of what an update is given, by batch size
        self._structure = tree_flatten(self.example(1, th.zeros(1)))[1]

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
        :raises ValueError: for tensors of another shape or type
        """
        n_steps = len(batch.rewards)
        given = Given(
            row=self._schedules(n_steps, tau, target_entropy),
            noise=noise,
            labels=() if labels is None else (labels.contiguous(),),
            batch=LevelBatch(*(x.contiguous() for x in batch)),
        )
        self._check(given)
        state = self._state(ent_coef)
        step = self._step_for(given.batch.rewards.shape[1], ent_coef)
        fixed = tree_leaves(state)
        for changing in zip(*(x.unbind(0) for x in tree_leaves(given)), strict=True):
            step(*fixed, *changing)
        for optimizer in self.optimizers():
            self._adam_state(optimizer)["step"] += n_steps
        return dict(zip(DIAGNOSTICS, (state.sums / n_steps).tolist(), strict=True))

    def _given(self, batch_size: int) -> Given:
        """Zeros in the shapes of what one update is given."""
        obs_dim, state_dim = math.prod(self.policy.observation_space.shape or ()), self.policy.actor.state_dim
        return Given(
            row=th.zeros(len(Schedules._fields)),
            noise=th.zeros(2, batch_size, self.action_dim),
            labels=(th.zeros(batch_size, 1),) if self.label_coef else (),
            batch=LevelBatch(
                observations=th.zeros(batch_size, obs_dim),
                actions=th.zeros(batch_size, self.action_dim),
                next_observations=th.zeros(batch_size, obs_dim),
                rewards=th.zeros(batch_size, 1),
                dones=th.zeros(batch_size, 1),
                discounts=th.zeros(batch_size, 1),
                states=th.zeros(batch_size, state_dim),
                next_states=th.zeros(batch_size, state_dim),
            ),
        )

    def _check(self, given: Given) -> None:
        """The compiled step trusts shapes and types, so they are checked here, once per burst."""
        if len(given.labels) != bool(self.label_coef):
            raise ValueError(f"labels are needed where label_coef is not 0, and only there; it is {self.label_coef}")
        n_steps, batch_size = given.batch.rewards.shape[:2]
        if batch_size not in self._shapes:
            self._shapes[batch_size] = [x.shape for x in tree_leaves(self._given(batch_size))]
        names = ("row", "noise", *("labels" for _ in given.labels), *LevelBatch._fields)
        for name, x, one in zip(names, tree_leaves(given), self._shapes[batch_size], strict=True):
            if x.shape != (n_steps, *one) or x.dtype != th.float32:
                shape = (n_steps, *one)
                raise ValueError(f"batch.{name} must be float32 of shape {shape}, got {x.dtype} {tuple(x.shape)}")

    def optimizers(self) -> list[th.optim.Optimizer]:
        """Actor's, critics' and, when the temperature is automatic, the temperature's optimizer."""
        optimizers = [self.policy.actor.optimizer, self.policy.critic.optimizer]
        return optimizers if self.ent_coef_optimizer is None else [*optimizers, self.ent_coef_optimizer]

    @staticmethod
    def _adam_state(optimizer: th.optim.Optimizer) -> dict[str, th.Tensor]:
        state: dict[str, th.Tensor] = optimizer.state[optimizer.param_groups[0]["params"][0]]
        return state

    def _state(self, ent_coef: th.Tensor) -> LearntState:
        """What updates start from and change, read afresh since loading an agent replaces some of it."""
        for flat in (self.actor, self.critic, self.target, self.average):
            flat.sync()
        adam = [self._adam_state(optimizer) for optimizer in self.optimizers()]
        return LearntState(
            sums=th.zeros(len(DIAGNOSTICS)),
            ent=ent_coef.data,
            actor=self.actor.vector.data,
            critic=self.critic.vector.data,
            target=self.target.vector.data,
            average=self.average.vector.data,
            moments=tuple(Moments(state["exp_avg"], state["exp_avg_sq"]) for state in adam),
            constants=self.policy.actor.constants(),
        )

    def _schedules(self, n_steps: int, tau: float, target_entropy: float) -> th.Tensor:
        """A row of :class:`Schedules` per update."""
        first = float(self._adam_state(self.policy.actor.optimizer)["step"])
        count = first + 1 + np.arange(n_steps, dtype=np.float64)
        options = [optimizer.param_groups[0] for optimizer in self.optimizers()]
        rates = [option["lr"] / (1 - option["betas"][0] ** count) for option in options]
        columns = {
            "actor_step": rates[0],
            "critic_step": rates[1],
            "ent_coef_step": rates[-1],
            "correction": 1 / np.sqrt(1 - options[0]["betas"][1] ** count),
            "tau": tau,
            "average_weight": 1 - np.minimum(self.average_decay, (1 + count) / (10 + count)),
            "target_entropy": target_entropy,
        }
        table = np.empty((n_steps, len(columns)), dtype=np.float32)
        for column, name in enumerate(Schedules._fields):
            table[:, column] = columns[name]
        return th.from_numpy(table)

    def _step_for(self, batch_size: int, ent_coef: th.Tensor) -> Callable[..., None]:
        """The step for a batch size and the circuit's present number of sub-steps, compiled when first asked for."""
        key = (batch_size, self.policy.actor.sub_steps)
        if key not in self._steps:
            self._steps[key] = compile_step(self._step, tree_leaves(self.example(batch_size, ent_coef)), self.compile)
        return self._steps[key]

    def choose(self, compile: bool | str) -> None:
        """Run updates compiled or eagerly from now on."""
        if compile != self.compile:
            self.compile = compile
            self._steps.clear()

    def example(self, batch_size: int, ent_coef: th.Tensor) -> StepInputs:
        """Arguments of one update: the state itself, and a batch of zeros."""
        return StepInputs(self._state(ent_coef), self._given(batch_size))

    def prepare(self, batch_size: int, ent_coef: th.Tensor) -> None:
        """Compile for a batch size now rather than at the first update."""
        self._step_for(batch_size, ent_coef)

    def rehearse(self, batch_size: int, ent_coef: th.Tensor) -> None:
        """One update on copies, eagerly, for those who want to watch its operations."""
        self._step(*(tensor.clone() for tensor in tree_leaves(self.example(batch_size, ent_coef))))

    def _step(self, *leaves: th.Tensor) -> None:
        """One update, from the leaves of :class:`StepInputs`."""
        x: StepInputs = tree_unflatten(list(leaves), self._structure)
        state, batch, row = x.state, x.given.batch, Schedules(*x.given.row.unbind())
        with th.enable_grad():
            actor_leaf = state.actor.detach().requires_grad_()
            actions_pi, log_prob = self._sample(actor_leaf, x, batch.observations, batch.states, x.given.noise[0])
        ent_coef = state.ent.exp() if self.automatic else state.ent.clone()
        surplus = (log_prob.detach() + row.target_entropy).mean()

        target_q = self._target_q(x, ent_coef)
        critic_loss, critic_grad, q_mean = self._critic_loss(x, target_q)
        self._adam(1, state, critic_grad, row)
        # The actor's loss looks through the critics that were just changed, as in SB3.
        actor_loss = self._actor_loss(x, actions_pi, log_prob, ent_coef)
        (actor_grad,) = th.autograd.grad(actor_loss, actor_leaf)
        self._adam(0, state, actor_grad, row)
        # The temperature last, so that nothing changes while both forward passes of the actor share what they compute;
        # the losses use its value from before the update, as in SB3.
        ent_coef_loss = -(state.ent * surplus).sum() if self.automatic else state.ent.new_zeros(())
        if self.automatic:
            self._adam(2, state, -surplus.expand(1), row)
        state.target.lerp_(state.critic, row.tau)
        state.average.lerp_(state.actor, row.average_weight)
        diagnostics = (critic_loss, actor_loss, ent_coef_loss, ent_coef.sum(), q_mean, -log_prob.mean())
        state.sums.add_(th.stack([value.detach() for value in diagnostics]))

    def _sample(
        self, vector: th.Tensor, x: StepInputs, obs: th.Tensor, membrane: th.Tensor, noise: th.Tensor
    ) -> tuple[th.Tensor, th.Tensor]:
        """Actions of the actor whose parameters are ``vector``, and their log-probabilities."""
        blocks = self.actor.unflatten(vector)
        mean, log_std, _ = self.policy.actor.step_blocks(blocks, x.state.constants, obs, membrane)
        return squash(mean, log_std, noise)

    def _target_q(self, x: StepInputs, ent_coef: th.Tensor) -> th.Tensor:
        """``r + (1 - done) discount (min Q'(s', a') - alpha log pi(a' | s'))``, ``(batch, 1)``."""
        state, batch = x.state, x.given.batch
        with th.no_grad():
            actions, log_prob = self._sample(
                state.actor, x, batch.next_observations, batch.next_states, x.given.noise[1]
            )
            q = self.policy.critic.q_blocks(self.target.unflatten(state.target), batch.next_observations, actions)
            return batch.rewards + (1 - batch.dones) * batch.discounts * (q.amin(dim=0) - ent_coef * log_prob)

    def _critic_loss(self, x: StepInputs, target_q: th.Tensor) -> tuple[th.Tensor, th.Tensor, th.Tensor]:
        """Half the summed mean squared errors, its gradient, and the mean Q-value."""
        batch = x.given.batch
        with th.enable_grad():
            leaf = x.state.critic.detach().requires_grad_()
            q = self.policy.critic.q_blocks(self.critic.unflatten(leaf), batch.observations, batch.actions)
            loss = 0.5 * (q - target_q).square().mean(dim=(1, 2)).sum()
            (grad,) = th.autograd.grad(loss, leaf)
        return loss, grad, q.mean()

    def _actor_loss(self, x: StepInputs, actions: th.Tensor, log_prob: th.Tensor, ent_coef: th.Tensor) -> th.Tensor:
        """``alpha log pi - min Q``, and the labels' loss where there are any.

        The latter is the paper's ``L_dt = E (dt - dt*)^2``, in unit coordinates of the action.
        """
        with th.enable_grad():
            q = self.policy.critic.q_blocks(self.critic.unflatten(x.state.critic), x.given.batch.observations, actions)
            loss = (ent_coef * log_prob - q.amin(dim=0)).mean()
            for labels in x.given.labels:
                loss = loss + self.label_coef * (actions[:, -1:] - labels).square().mean()
        return loss

    def _adam(self, which: int, state: LearntState, grad: th.Tensor, row: Schedules) -> None:
        """One step of Adam in place (arXiv 1412.6980).

        :param which: 0 for the actor, 1 for the critics, 2 for the temperature
        """
        # theta -= lr / (1 - beta1^n) * m / (sqrt(v) / sqrt(1 - beta2^n) + eps): the corrections depend on the number
        # of updates n, so they come in as tensors, and one compiled graph serves all updates.
        parameter = (state.actor, state.critic, state.ent)[which]
        step_size = (row.actor_step, row.critic_step, row.ent_coef_step)[which]
        options = self.optimizers()[which].param_groups[0]
        (beta1, beta2), (mean, square) = options["betas"], state.moments[which]
        mean.lerp_(grad, 1 - beta1)
        square.mul_(beta2).addcmul_(grad, grad, value=1 - beta2)
        parameter.sub_(mean / (square.sqrt() * row.correction + options["eps"]) * step_size)
