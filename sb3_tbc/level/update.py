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
from functools import cached_property

import numpy as np
import torch as th
from stable_baselines3.common.preprocessing import get_action_dim
from torch.utils._pytree import TreeSpec, tree_flatten, tree_leaves, tree_unflatten

from sb3_tbc.aliases import Plain
from sb3_tbc.arrays import FloatArray
from sb3_tbc.level.actors import squash
from sb3_tbc.level.compilation import compile_step
from sb3_tbc.level.critics import BATCH_MOMENTUM, optimism_of
from sb3_tbc.level.policies import LevelPolicy
from sb3_tbc.level.step_inputs import Given, LearntState, Moments, Schedules, StepInputs
from sb3_tbc.level.storage import FlatParameters, flat_adam
from sb3_tbc.replay.batch import LevelBatch
from sb3_tbc.smdp.bounds import ValueBounds

DIAGNOSTICS = ("critic_loss", "actor_loss", "ent_coef_loss", "ent_coef", "q_mean", "entropy", "target_clipped")
"""Quantities whose mean is logged; ``target_clipped`` is the share of targets that were moved to a bound."""
EXTREMES: dict[str, Callable[[float, float], float]] = {"target_min": min, "target_max": max}
"""The lowest and the highest target of the critics, which are logged as well."""
AVERAGE_DECAY = 0.999
"""Default decay per update of the averaged actor; in the n-th update at most (1 + n) / (10 + n)."""

ACTOR, CRITIC, TEMPERATURE = range(3)
"""Places in :meth:`SACUpdate.optimizers` and :attr:`LearntState.moments`."""


class SACUpdate:
    """The update of one level: flat storage for its policy, and the step that changes it.

    :param policy: the level's policy, on the device it stays on; its parameters are moved into flat storage and its
        optimizers replaced by flat ones
    :param ent_coef_optimizer: optimizer of the logarithm of the temperature, None for a fixed temperature
    :param compile: "auto" (compiled if there is a C++ compiler), True or False
    :param label_coef: weight of the squared distance between the actor's last action coordinate and given labels
    :param average_decay: decay per update of the averaged actor
    :param bounds: every target is clipped to them, see :mod:`sb3_tbc.smdp.bounds`; None does not clip
    :param actor_q: which value of the critics the actor climbs: ``"min"`` as in SAC, ``"mean"``, ``"max"``, or a number
        between 0 (the smallest) and 1 (the largest). Small actors beside large critics learn less of a pessimistic one
        (arXiv 2506.01016). Targets always take the smallest
    :param earlier_steps: steps before each sample that batches hold: the actor's memory is unrolled through them from
        what was stored, with today's weights, and learns by backpropagation through time
    :raises ValueError: for bounds that hold nothing and another ``actor_q``
    """

    def __init__(
        self,
        policy: LevelPolicy,
        *,
        ent_coef_optimizer: th.optim.Adam | None = None,
        compile: bool | str = "auto",
        label_coef: float = 0.0,
        average_decay: float = AVERAGE_DECAY,
        bounds: ValueBounds | None = None,
        actor_q: str | float = "min",
        earlier_steps: int = 0,
    ) -> None:
        if bounds is not None and not bounds.low < bounds.high:
            raise ValueError(f"target_bounds must be [low, high] with low < high, got [{bounds.low}, {bounds.high}]")
        self.bounds, self.optimism = bounds, optimism_of(actor_q)
        self.policy = policy
        self.actor = FlatParameters(policy.actor.blocks())
        self.critic = FlatParameters(policy.critic.blocks())
        self.target = FlatParameters(policy.critic_target.blocks())
        self.average = FlatParameters(policy.average_actor.blocks())
        statistics = policy.critic.statistics()
        self.statistics = FlatParameters(statistics) if statistics else None
        policy.actor.optimizer = flat_adam(self.actor.vector, policy.actor.optimizer)
        policy.critic.optimizer = flat_adam(self.critic.vector, policy.critic.optimizer)
        self.ent_coef_optimizer = ent_coef_optimizer
        self.action_dim = get_action_dim(policy.action_space)
        self.compile = compile
        self.label_coef, self.average_decay, self.earlier_steps = label_coef, average_decay, earlier_steps
        self._steps: dict[tuple[int, int], Callable[..., None]] = {}
        self._shapes: dict[int, list[th.Size]] = {}  # of what an update is given, by batch size

    def __getstate__(self) -> Plain:
        state = {**self.__dict__, "_steps": {}}
        state.pop("_structure", None)
        return state

    @cached_property
    def _structure(self) -> TreeSpec:
        """How the leaves of :class:`StepInputs` belong together."""
        return tree_flatten(self.example(1, th.zeros(1)))[1]

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
        :return: mean over the burst of each of :data:`DIAGNOSTICS`, and :data:`EXTREMES`
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
        means = dict(zip(DIAGNOSTICS, (state.sums / n_steps).tolist(), strict=True))
        return means | dict(zip(EXTREMES, state.extremes.tolist(), strict=True))

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
                earlier=th.zeros(batch_size, self.earlier_steps * (1 + obs_dim)),
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
        if self.statistics is not None:
            self.statistics.sync()
        adam = [self._adam_state(optimizer) for optimizer in self.optimizers()]
        return LearntState(
            sums=th.zeros(len(DIAGNOSTICS)),
            extremes=th.tensor([math.inf, -math.inf]),
            ent=ent_coef.data,
            actor=self.actor.vector.data,
            critic=self.critic.vector.data,
            target=self.target.vector.data,
            average=self.average.vector.data,
            statistics=() if self.statistics is None else (self.statistics.vector.data,),
            moments=tuple(Moments(state["exp_avg"], state["exp_avg_sq"]) for state in adam),
            constants=self.policy.actor.constants(),
        )

    def _schedules(self, n_steps: int, tau: float, target_entropy: float) -> th.Tensor:
        """A row of :class:`Schedules` per update."""
        # Each optimizer counts its own updates: a temperature that was begun anew is younger than the networks.
        updates = 1 + np.arange(n_steps, dtype=np.float64)
        counts = [float(self._adam_state(optimizer)["step"]) + updates for optimizer in self.optimizers()]
        columns: dict[str, float | FloatArray] = {
            "tau": tau,
            "average_weight": 1 - np.minimum(self.average_decay, (1 + counts[0]) / (10 + counts[0])),
            "target_entropy": target_entropy,
        }
        for name, count, optimizer in zip(("actor", "critic", "ent_coef"), counts, self.optimizers(), strict=False):
            options = optimizer.param_groups[0]
            columns[f"{name}_step"] = options["lr"] / (1 - options["betas"][0] ** count)
            columns[f"{name}_correction"] = 1 / np.sqrt(1 - options["betas"][1] ** count)
        table = np.zeros((n_steps, len(Schedules._fields)), dtype=np.float32)  # a fixed temperature takes no steps
        for name, column in columns.items():
            table[:, Schedules._fields.index(name)] = column
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
        """Run one update eagerly on copies, so that its operations can be observed, e.g. by a profiler."""
        self._step(*(tensor.clone() for tensor in tree_leaves(self.example(batch_size, ent_coef))))

    def _step(self, *leaves: th.Tensor) -> None:
        """One update, from the leaves of :class:`StepInputs`."""
        x: StepInputs = tree_unflatten(list(leaves), self._structure)
        state, row = x.state, Schedules(*x.given.row.unbind())
        with th.enable_grad():
            actor_leaf = state.actor.detach().requires_grad_()
            x, memory = self._unrolled(actor_leaf, x)
            seen = x.given.batch.observations
            actions_pi, log_prob = self._sample(actor_leaf, x, seen, memory, x.given.noise[0])
        ent_coef = state.ent.exp() if self.automatic else state.ent.clone()
        surplus = (log_prob.detach() + row.target_entropy).mean()

        critic_grad, critic_diagnostics = self._critic_gradient(x, ent_coef)
        self._adam(CRITIC, state, critic_grad, row)
        # The actor's loss looks through the critics that were just changed, as in SB3.
        actor_loss = self._actor_loss(x, actions_pi, log_prob, ent_coef)
        (actor_grad,) = th.autograd.grad(actor_loss, actor_leaf)
        self._adam(ACTOR, state, actor_grad, row)
        # The temperature last, so that nothing changes while both forward passes of the actor share what they compute;
        # the losses use its value from before the update, as in SB3.
        ent_coef_loss = -(state.ent * surplus).sum() if self.automatic else state.ent.new_zeros(())
        if self.automatic:
            self._adam(TEMPERATURE, state, -surplus.expand(1), row)
        if self.statistics is None:
            state.target.lerp_(state.critic, row.tau)
        else:  # CrossQ has no target networks
            state.target.copy_(state.critic)
        state.average.lerp_(state.actor, row.average_weight)
        critic_loss, q_mean, clipped, lowest, highest = critic_diagnostics
        diagnostics = (critic_loss, actor_loss, ent_coef_loss, ent_coef.sum(), q_mean, -log_prob.mean(), clipped)
        state.sums.add_(th.stack([value.detach() for value in diagnostics]))
        # At the end: a change in place in the middle would keep the compiler from sharing what is computed twice.
        so_far = state.extremes.unbind()
        state.extremes.copy_(th.stack((th.minimum(so_far[0], lowest), th.maximum(so_far[1], highest))))

    def _unrolled(self, vector: th.Tensor, x: StepInputs) -> tuple[StepInputs, th.Tensor]:
        """Bring the memory up to the sampled steps.

        :return: inputs whose batch has the memory before and after the sampled steps, without gradient; and the memory
            before them, ``(batch, state_dim)``, with its gradient
        """
        batch = x.given.batch
        memory = batch.states
        if not self.earlier_steps:
            return x, memory
        blocks, constants = self.actor.unflatten(vector), x.state.constants
        for step in batch.earlier.view(len(batch.earlier), self.earlier_steps, -1).unbind(1):
            *_, after = self.policy.actor.step_blocks(blocks, constants, step[:, 1:], memory)
            memory = th.where(step[:, :1] > 0, after, memory)
        *_, after = self.policy.actor.step_blocks(blocks, constants, batch.observations, memory)
        batch = batch._replace(states=memory.detach(), next_states=after.detach())
        return x._replace(given=x.given._replace(batch=batch)), memory

    def _sample(
        self, vector: th.Tensor, x: StepInputs, obs: th.Tensor, membrane: th.Tensor, noise: th.Tensor
    ) -> tuple[th.Tensor, th.Tensor]:
        """Actions of the actor whose parameters are ``vector``, and their log-probabilities."""
        blocks = self.actor.unflatten(vector)
        mean, log_std, _ = self.policy.actor.step_blocks(blocks, x.state.constants, obs, membrane)
        return squash(mean, log_std, noise)

    def _critic_gradient(self, x: StepInputs, ent_coef: th.Tensor) -> tuple[th.Tensor, tuple[th.Tensor, ...]]:
        """Gradient of half the summed mean squared errors, and what is logged of it.

        :return: gradient, and loss, mean value, share of clipped targets, lowest and highest target
        """
        batch = x.given.batch
        with th.no_grad():
            observed = batch.next_observations, batch.next_states
            actions, log_prob = self._sample(x.state.actor, x, *observed, x.given.noise[1])
        with th.enable_grad():
            leaf = x.state.critic.detach().requires_grad_()
            if self.statistics is None:
                target_q, clipped = self._target_q(x, self._next_q(x, actions), log_prob, ent_coef)
                blocks, seen = self.critic.unflatten(leaf), self._critics_see(batch.observations, batch.states)
                q = self.policy.critic.q_blocks(blocks, seen, batch.actions)
            else:
                q, next_q = self._joint_q(x, leaf, actions)
                target_q, clipped = self._target_q(x, next_q, log_prob, ent_coef)
            loss = 0.5 * (q - target_q).square().mean(dim=(1, 2)).sum()
            (grad,) = th.autograd.grad(loss, leaf)
        return grad, (loss, q.mean(), clipped, target_q.amin(), target_q.amax())

    def _critics_see(self, observations: th.Tensor, memory: th.Tensor) -> th.Tensor:
        """The critics' inputs: the observations, and the actor's memory if they are to see it."""
        return th.cat((observations, memory), dim=-1) if self.policy.level_kwargs["critic_memory"] else observations

    def _next_q(self, x: StepInputs, next_actions: th.Tensor) -> th.Tensor:
        """The target networks' values of the next actions, ``(n_critics, batch, 1)``."""
        batch = x.given.batch
        with th.no_grad():
            blocks = self.target.unflatten(x.state.target)
            seen = self._critics_see(batch.next_observations, batch.next_states)
            return self.policy.critic.q_blocks(blocks, seen, next_actions)

    def _joint_q(self, x: StepInputs, leaf: th.Tensor, next_actions: th.Tensor) -> tuple[th.Tensor, th.Tensor]:
        """Values ``(n_critics, batch, 1)`` of the stored actions and, without gradient, of the next ones, without
        target networks; the running statistics move on.
        """
        # Batch normalisation must see both kinds of actions at once: the policy's next actions are distributed
        # otherwise than stored ones, and normalised by statistics of the latter alone their values are off. With joint
        # statistics no target networks are needed (section 3 of arXiv 1902.05605).
        batch = x.given.batch
        now = self._critics_see(batch.observations, batch.states)
        later = self._critics_see(batch.next_observations, batch.next_states)
        seen = th.cat((now, later))
        actions = th.cat((batch.actions, next_actions))
        joint, statistics = self.policy.critic.q_blocks_of_batch(self.critic.unflatten(leaf), seen, actions)
        x.state.statistics[0].lerp_(th.cat([part.flatten() for part in statistics]), BATCH_MOMENTUM)
        q, next_q = joint.chunk(2, dim=1)
        return q, next_q.detach()

    def _target_q(
        self, x: StepInputs, next_q: th.Tensor, log_prob: th.Tensor, ent_coef: th.Tensor
    ) -> tuple[th.Tensor, th.Tensor]:
        """``r + (1 - done) discount (min Q'(s', a') - alpha log pi(a' | s'))`` within the bounds, ``(batch, 1)``.

        :return: the targets, and the share of them that was clipped
        """
        batch = x.given.batch
        with th.no_grad():
            soft = next_q.amin(dim=0) - ent_coef * log_prob
            target_q = batch.rewards + (1 - batch.dones) * batch.discounts * soft
            clipped = target_q.new_zeros(())
            if self.bounds is not None:
                free, target_q = target_q, self._clip(target_q, self.bounds, ent_coef)
                clipped = (free != target_q).float().mean()
        return target_q, clipped

    def _clip(self, target_q: th.Tensor, bounds: ValueBounds, ent_coef: th.Tensor) -> th.Tensor:
        """Targets within the bounds; the upper one has room for the entropy of later actions."""
        # An action in [-1, 1]^d has at most the uniform distribution's entropy, d log 2 nats.
        highest = bounds.high + ent_coef * (bounds.later * self.action_dim * math.log(2.0))
        if self.policy.critic.negative:
            highest = highest.clamp(max=0.0)
        return th.minimum(target_q.clamp(min=bounds.low), highest)

    def _actor_loss(self, x: StepInputs, actions: th.Tensor, log_prob: th.Tensor, ent_coef: th.Tensor) -> th.Tensor:
        """``alpha log pi - Q`` with the Q that ``actor_q`` chooses, plus the labels' loss where there are labels.

        The latter is the paper's ``L_dt = E (dt - dt*)^2``, in unit coordinates of the action.
        """
        batch = x.given.batch
        with th.enable_grad():
            blocks, seen = self.critic.unflatten(x.state.critic), self._critics_see(batch.observations, batch.states)
            statistics = [] if self.statistics is None else self.statistics.unflatten(x.state.statistics[0])
            q = self.policy.critic.q_blocks(blocks, seen, actions, statistics)
            loss = (ent_coef * log_prob - self._ascended(q)).mean()
            for labels in x.given.labels:
                loss = loss + self.label_coef * (actions[:, -1:] - labels).square().mean()
        return loss

    def _ascended(self, q: th.Tensor) -> th.Tensor:
        """The value that the actor climbs, ``(batch, 1)``, of all critics' ``(n_critics, batch, 1)``."""
        if self.optimism is None:
            return q.mean(dim=0)
        if self.optimism == 0.0:
            return q.amin(dim=0)
        return th.lerp(q.amin(dim=0), q.amax(dim=0), self.optimism)

    def _adam(self, which: int, state: LearntState, grad: th.Tensor, row: Schedules) -> None:
        """One step of Adam in place (arXiv 1412.6980).

        :param which: :data:`ACTOR`, :data:`CRITIC` or :data:`TEMPERATURE`
        """
        # theta -= lr / (1 - beta1^n) * m / (sqrt(v) / sqrt(1 - beta2^n) + eps): the corrections depend on the number
        # of updates n, so they come in as tensors, and one compiled graph serves all updates.
        parameter = (state.actor, state.critic, state.ent)[which]
        step_size = (row.actor_step, row.critic_step, row.ent_coef_step)[which]
        correction = (row.actor_correction, row.critic_correction, row.ent_coef_correction)[which]
        options = self.optimizers()[which].param_groups[0]
        (beta1, beta2), (mean, square) = options["betas"], state.moments[which]
        mean.lerp_(grad, 1 - beta1)
        square.mul_(beta2).addcmul_(grad, grad, value=1 - beta2)
        parameter.sub_(mean / (square.sqrt() * correction + options["eps"]) * step_size)
