"""One level of the hierarchy: SB3's SAC on spaces alone, fed from outside, updated on flat storage, acting in NumPy."""

from __future__ import annotations

import time
from typing import NoReturn, Protocol, cast

import numpy as np
import torch as th
from gymnasium import spaces
from stable_baselines3 import SAC
from stable_baselines3.common.logger import Logger
from stable_baselines3.common.type_aliases import Schedule
from stable_baselines3.common.utils import FloatSchedule
from torch import nn

from sb3_tbc.aliases import Plain
from sb3_tbc.errors import HierarchyError, NonFiniteError
from sb3_tbc.level.acting import ActingLevel
from sb3_tbc.level.policies import LevelPolicy
from sb3_tbc.level.spaces_only import SpacesOnlyVecEnv
from sb3_tbc.level.update import AVERAGE_DECAY, EXTREMES, SACUpdate
from sb3_tbc.replay.batch import LevelBatch
from sb3_tbc.smdp.bounds import ValueBounds

BURST_ROWS = 32_768
"""Transitions drawn in one go, for several updates. Many more would not fit into the processor's caches."""


class BurstBuffer(Protocol):
    """What a level asks of its replay buffer."""

    def sample_burst(self, gradient_steps: int, batch_size: int) -> LevelBatch:
        """Sample tensors ``(gradient_steps, batch_size, ...)``."""


class LabelledBuffer(BurstBuffer, Protocol):
    """What a level with a ``label_coef`` asks of its replay buffer."""

    def sample_labelled(self, gradient_steps: int, batch_size: int) -> tuple[LevelBatch, th.Tensor]:
        """Sample tensors as :meth:`sample_burst`, and labels ``(gradient_steps, batch_size, 1)`` in [-1, 1]."""


def add_figures(total: dict[str, float], part: dict[str, float], share: float) -> None:
    """Add what one burst of updates measured to ``total``: means by the burst's share, extremes as they are."""
    for key, value in part.items():
        if key in EXTREMES:
            total[key] = EXTREMES[key](total.get(key, value), value)
        else:
            total[key] = total.get(key, 0.0) + share * value


class SACLevel(SAC):
    """SAC for one level. It does not collect or store transitions: the agent that owns the level sets and
    fills its ``replay_buffer``, and acts with its ``acting``, an :class:`.ActingLevel`.

    :param observation_space: flat observations of the level
    :param action_space: the level's actions, unit coordinates
    :param ent_coef_learning_rate: learning rate of the automatic temperature, by default ``learning_rate``
    :param actor_learning_rate: learning rate of the actor, by default ``learning_rate``; circuits need larger steps
        than critics
    :param compile: "auto" (compiled if there is a C++ compiler), True or False (eager)
    :param name: names the level in messages and logs (``low/critic_loss``)
    :param label_coef: weight of a regression of the last action coordinate toward labels of the replay buffer in the
        actor's loss (the paper's duration loss); if positive, batches come from ``replay_buffer.sample_labelled``
    :param average_decay: decay per update of the averaged actor, which acts where deterministic actions are asked for
    :param bounds: targets of the critics are clipped to them, see :mod:`sb3_tbc.smdp.bounds`; None does not clip
    :param actor_q: which value of the critics the actor climbs, see :class:`.SACUpdate`
    :param earlier_steps: steps before each sample through which the actor's memory is unrolled, see :class:`.SACUpdate`

    Other parameters are SB3's; ``policy_kwargs`` are :class:`LevelPolicy`'s.

    :raises ConfigError: for spaces or policy options that a level cannot have
    :raises ValueError: for another device than the CPU, an unknown ``actor_q``, or empty ``bounds``
    """

    policy: LevelPolicy
    observation_space: spaces.Box
    action_space: spaces.Box

    def __init__(
        self,
        observation_space: spaces.Box,
        action_space: spaces.Box,
        learning_rate: float | Schedule = 3e-4,
        gamma: float = 0.99,
        tau: float = 0.005,
        ent_coef: str | float = "auto",
        target_entropy: str | float = "auto",
        policy_kwargs: Plain | None = None,
        seed: int | None = None,
        device: th.device | str = "cpu",
        compile: bool | str = "auto",
        ent_coef_learning_rate: float | None = None,
        actor_learning_rate: float | Schedule | None = None,
        name: str = "level",
        label_coef: float = 0.0,
        average_decay: float = AVERAGE_DECAY,
        bounds: ValueBounds | None = None,
        actor_q: str | float = "min",
        earlier_steps: int = 0,
    ) -> None:
        super().__init__(
            LevelPolicy,
            SpacesOnlyVecEnv(observation_space, action_space),
            learning_rate=learning_rate,
            buffer_size=1,
            gamma=gamma,
            tau=tau,
            ent_coef=ent_coef,
            target_entropy=target_entropy,
            policy_kwargs=dict(policy_kwargs or {}),
            seed=seed,
            device="cpu" if device == "auto" else device,
            _init_setup_model=False,
        )
        self.compile = compile
        self.ent_coef_learning_rate = ent_coef_learning_rate
        self.actor_lr_schedule = None if actor_learning_rate is None else FloatSchedule(actor_learning_rate)
        self.log_prefix = f"{name}/"
        self.label_coef, self.average_decay = label_coef, average_decay
        self.bounds, self.actor_q, self.earlier_steps = bounds, actor_q, earlier_steps
        self.set_logger(Logger(folder=None, output_formats=[]))
        self._setup_model()
        self.replay_buffer = None

    def _setup_model(self) -> None:
        super()._setup_model()
        if self.ent_coef_optimizer is not None and self.log_ent_coef is not None:
            zeros = {"exp_avg": th.zeros(1), "exp_avg_sq": th.zeros(1)}
            self.ent_coef_optimizer.state[self.log_ent_coef] = {"step": th.tensor(0.0), **zeros}
        self.noise_rng = np.random.default_rng(self.seed)
        self._update = SACUpdate(
            self.policy,
            ent_coef_optimizer=self.ent_coef_optimizer,
            compile=self.compile,
            label_coef=self.label_coef,
            average_decay=self.average_decay,
            bounds=self.bounds,
            actor_q=self.actor_q,
            earlier_steps=self.earlier_steps,
        )
        self.acting = ActingLevel(self.policy)

    def _excluded_save_params(self) -> list[str]:
        return [*super()._excluded_save_params(), "_update", "acting"]

    @classmethod
    def load(cls, *_: object, **__: object) -> NoReturn:
        """Refused: SB3's would unpickle what the file holds, and then know no environment of a level.

        :raises TypeError: always, naming what to load
        """
        raise TypeError(
            "a level is loaded with its agent: use TBCHRL.load(path); weights of a level that was saved alone are read "
            "by its set_parameters(path)"
        )

    @property
    def compiled(self) -> bool:
        """Whether the last updates ran as a compiled graph."""
        return self._update.compiled

    def train(self, gradient_steps: int, batch_size: int = 256) -> None:
        """Sample ``gradient_steps`` batches and update on each.

        :raises HierarchyError: without a replay buffer
        :raises NonFiniteError: if a parameter became NaN or infinite
        """
        if self.replay_buffer is None:
            raise HierarchyError(f"{self.log_prefix[:-1]} has no replay buffer; set its replay_buffer before train")
        self.policy.set_training_mode(True)
        self._set_learning_rates()
        figures: dict[str, float] = {}
        burst = max(1, BURST_ROWS // batch_size)
        for start in range(0, gradient_steps, burst):
            steps = min(burst, gradient_steps - start)
            add_figures(figures, self._run(steps, batch_size), steps / gradient_steps)
            self.policy.after_updates(steps)
        self._n_updates += gradient_steps
        self._check_finite()
        for key, value in figures.items():
            self.logger.record(self.log_prefix + key, value)
        self.logger.record(self.log_prefix + "n_updates", self._n_updates, exclude="tensorboard")

    def _run(self, gradient_steps: int, batch_size: int) -> dict[str, float]:
        labels: th.Tensor | None = None
        if self.label_coef:
            batch, labels = cast(LabelledBuffer, self.replay_buffer).sample_labelled(gradient_steps, batch_size)
        else:
            batch = cast(BurstBuffer, self.replay_buffer).sample_burst(gradient_steps, batch_size)
        shape = (gradient_steps, 2, batch.rewards.shape[1], self._update.action_dim)
        noise = th.from_numpy(self.noise_rng.standard_normal(shape, dtype=np.float32))
        return self._update.run(
            batch,
            noise,
            tau=self.tau,
            target_entropy=float(self.target_entropy),
            ent_coef=self._ent_coef_state(),
            labels=labels,
        )

    def _ent_coef_state(self) -> th.Tensor:
        return self.ent_coef_tensor if self.log_ent_coef is None else self.log_ent_coef

    def prepare(self, batch_size: int, compile: bool | str | None = None) -> float:
        """Compile the update for a batch size now rather than in the first :meth:`train`.

        :param compile: changes how updates run from now on; by default as the level was made
        :return: seconds it took
        """
        start = time.perf_counter()
        self._update.choose(self.compile if compile is None else compile)
        self._update.prepare(batch_size, self._ent_coef_state())
        return time.perf_counter() - start

    def _set_learning_rates(self) -> None:
        learning_rate = self.lr_schedule(self._current_progress_remaining)
        for optimizer in self._update.optimizers():
            optimizer.param_groups[0]["lr"] = learning_rate
        if self.actor_lr_schedule is not None:
            actor_learning_rate = self.actor_lr_schedule(self._current_progress_remaining)
            self.policy.actor.optimizer.param_groups[0]["lr"] = actor_learning_rate
            self.logger.record(self.log_prefix + "actor_learning_rate", actor_learning_rate)
        if self.ent_coef_optimizer is not None and self.ent_coef_learning_rate is not None:
            self.ent_coef_optimizer.param_groups[0]["lr"] = self.ent_coef_learning_rate
        self.logger.record(self.log_prefix + "learning_rate", learning_rate)

    def _check_finite(self) -> None:
        vectors: dict[str, th.Tensor] = {"critic": self._update.critic.vector, "actor": self._update.actor.vector}
        if self.log_ent_coef is not None:
            vectors["log_ent_coef"] = self.log_ent_coef
        for module, vector in vectors.items():
            if not th.isfinite(vector.detach().sum()):
                raise NonFiniteError(self._describe_non_finite(module))

    def _describe_non_finite(self, module: str) -> str:
        """Name the first parameter of a module that is not finite."""
        name = module
        network: nn.Module | None = getattr(self.policy, module, None)
        for key, parameter in network.named_parameters() if network is not None else ():
            if not th.isfinite(parameter).all():
                name = f"{module}.{key}"
                break
        return (
            f"{self.log_prefix[:-1]}.{name} became NaN or infinite within the burst that ended at update"
            f" {self._n_updates}; a lower learning rate, or observations or rewards of smaller scale, usually cure it"
        )

    @property
    def state_dim(self) -> int:
        """Width of the actor's state, 0 for an MLP."""
        return self.acting.state_dim
