"""Policies of one level: SB3's SAC policy with a circuit (NDBC) or MLP actor, bounded heads and an averaged actor.

Every network names its parameters as :class:`.Block` objects: which parameters lie side by side in the flat storage of
:mod:`sb3_tbc.level.storage`, and the shape under which one matrix product uses them all. Each network also has its
forward pass as a function of those blocks, which is what the update differentiates.
"""

from __future__ import annotations

import copy
from collections.abc import Sequence
from typing import Any

import torch as th
from gymnasium import spaces
from stable_baselines3.common.distributions import SquashedDiagGaussianDistribution
from stable_baselines3.common.policies import BasePolicy
from stable_baselines3.common.preprocessing import get_action_dim
from stable_baselines3.common.torch_layers import BaseFeaturesExtractor
from stable_baselines3.common.type_aliases import PyTorchObs, Schedule
from stable_baselines3.sac.policies import LOG_STD_MAX, LOG_STD_MIN, Actor, SACPolicy
from torch import nn
from torch.nn import functional

from sb3_tbc.aliases import Plain, PlainMapping, Space
from sb3_tbc.errors import ConfigError
from sb3_tbc.level.critics import LevelCritic
from sb3_tbc.level.storage import Block, linear_layers

WIRING_KEYS = (
    "inter", "command", "motor", "sensory_fanout", "inter_fanout", "recurrent_command_synapses", "motor_fanin", "seed",
    "sensory_to",
)  # fmt: skip


class GaussianHead:
    """Bounds of a squashed Gaussian's parameters before squashing.

    :param mean_bound: the mean is clamped to ``[-mean_bound, mean_bound]`` (HiTS: 3), None for no bound
    :param log_std_bounds: bounds of the logarithm of the standard deviation (SB3: -20, 2)
    :raises ValueError: if a bound is empty
    """

    def __init__(self, mean_bound: float | None, log_std_bounds: tuple[float, float]) -> None:
        if mean_bound is not None and mean_bound <= 0:
            raise ValueError(f"mean_bound must be positive or None, got {mean_bound}")
        if not log_std_bounds[0] < log_std_bounds[1]:
            raise ValueError(f"log_std_bounds must be (low, high) with low < high, got {tuple(log_std_bounds)}")
        self.mean_bound = mean_bound
        self.log_std_bounds = (float(log_std_bounds[0]), float(log_std_bounds[1]))

    def __call__(self, outputs: th.Tensor) -> tuple[th.Tensor, th.Tensor]:
        """Split a network's outputs ``(batch, 2 * action_dim)`` into mean and log_std, both bounded."""
        mean, log_std = outputs.chunk(2, dim=-1)
        if self.mean_bound is not None:
            mean = mean.clamp(-self.mean_bound, self.mean_bound)
        return mean, log_std.clamp(*self.log_std_bounds)


class MLPActor(Actor):
    """SB3's SAC actor with bounds on its head and the stepwise interface of circuit actors (state of width 0).

    :param mean_bound: see :class:`GaussianHead`
    :param log_std_bounds: see :class:`GaussianHead`
    :param kwargs: arguments of SB3's ``Actor``
    """

    state_dim = 0
    sub_steps = 0

    def __init__(
        self,
        *,
        mean_bound: float | None = None,
        log_std_bounds: tuple[float, float] = (LOG_STD_MIN, LOG_STD_MAX),
        **kwargs: Any,
    ) -> None:
        super().__init__(**kwargs)
        self.head = GaussianHead(mean_bound, log_std_bounds)
        self.activation = self.activation_fn()

    def step(self, obs: th.Tensor, state: th.Tensor) -> tuple[th.Tensor, th.Tensor, th.Tensor]:
        """Mean and log_std ``(batch, action_dim)`` for observations ``(batch, n)``; the empty state is passed on."""
        latent = self.latent_pi(obs)
        mean, log_std = self.head(th.cat((self.mu(latent), self.log_std(latent)), dim=-1))  # type: ignore[operator]
        return mean, log_std, state

    def constants(self) -> list[th.Tensor]:
        """None: an MLP has no tensors besides its parameters."""
        return []

    def blocks(self) -> list[Block]:
        """Layers' weights and biases; mean and log_std share one output layer."""
        blocks = [Block(tuple(p.shape), (p,)) for layer in linear_layers(self.latent_pi) for p in layer.parameters()]
        mean, log_std = self.mu, self.log_std
        if not isinstance(mean, nn.Linear) or not isinstance(log_std, nn.Linear):
            raise TypeError("an actor with state-dependent exploration cannot be a level; pass use_sde=False")
        outputs = 2 * mean.out_features
        return [
            *blocks,
            Block((outputs, mean.in_features), (mean.weight, log_std.weight)),
            Block((outputs,), (mean.bias, log_std.bias)),
        ]

    def step_blocks(
        self, blocks: Sequence[th.Tensor], constants: Sequence[th.Tensor], obs: th.Tensor, state: th.Tensor
    ) -> tuple[th.Tensor, th.Tensor, th.Tensor]:
        """:meth:`step` as a function of the parameter blocks."""
        hidden = obs
        for weight, bias in zip(blocks[:-2:2], blocks[1:-2:2], strict=True):
            hidden = self.activation(functional.linear(hidden, weight, bias))
        return *self.head(functional.linear(hidden, blocks[-2], blocks[-1])), state

    def get_action_dist_params(self, obs: Any) -> tuple[th.Tensor, th.Tensor, dict[str, th.Tensor]]:
        """Mean and log_std as SB3's SAC asks for them."""
        features = self.extract_features(obs, self.features_extractor)
        mean, log_std, _ = self.step(features, features.new_zeros((len(features), 0)))
        return mean, log_std, {}


class NDBCActor(BasePolicy):
    """Squashed Gaussian actor whose mean and log_std are read out of an NDBC circuit.

    :param ndbc: the wiring's numbers (``inter``, ``command``, ``motor``, fan-outs, ``seed`` of the wiring) and the
        network's options (``sub_steps``, ``dynamics``, ``input_scale``, ...); weights are drawn from torch's generator
    :param mean_bound: see :class:`GaussianHead`
    :param log_std_bounds: see :class:`GaussianHead`
    """

    action_space: spaces.Box

    def __init__(
        self,
        observation_space: spaces.Box,
        action_space: spaces.Box,
        features_extractor: nn.Module,
        features_dim: int,
        ndbc: PlainMapping,
        mean_bound: float | None = None,
        log_std_bounds: tuple[float, float] = (LOG_STD_MIN, LOG_STD_MAX),
        normalize_images: bool = True,
    ) -> None:
        super().__init__(
            observation_space,
            action_space,
            features_extractor=features_extractor,
            normalize_images=normalize_images,
            squash_output=True,
        )
        from sb3_tbc.ndbc import NDBCNet, NDBCWiring

        self.ndbc = dict(ndbc)
        wiring = NDBCWiring(features_dim, **{k: v for k, v in self.ndbc.items() if k in WIRING_KEYS})
        options = {k: v for k, v in self.ndbc.items() if k not in WIRING_KEYS}
        self.net = NDBCNet(features_dim, 2 * get_action_dim(action_space), wiring, **options)
        self.state_dim = int(self.net.state_dim)
        self.head = GaussianHead(mean_bound, log_std_bounds)
        self.action_dist = SquashedDiagGaussianDistribution(get_action_dim(action_space))

    def _get_constructor_parameters(self) -> Plain:
        bounds = {"mean_bound": self.head.mean_bound, "log_std_bounds": self.head.log_std_bounds}
        return {**super()._get_constructor_parameters(), "ndbc": self.ndbc, **bounds}

    def step(self, obs: th.Tensor, state: th.Tensor) -> tuple[th.Tensor, th.Tensor, th.Tensor]:
        """One control step: mean and log_std ``(batch, action_dim)`` and membrane potentials ``(batch, state_dim)``."""
        outputs, next_state = self.net(obs, state)
        return *self.head(outputs), next_state

    @property
    def sub_steps(self) -> int:
        """Sub-steps of a control step, K; the circuit's step-size rule may change it between bursts of updates."""
        return self.net.sub_steps

    def blocks(self) -> list[Block]:
        """One block per parameter of the circuit."""
        return [Block(tuple(p.shape), (p,)) for p in self.net.parameters()]

    def constants(self) -> list[th.Tensor]:
        """Tensors of the circuit that are not trained: masks, polarities, scales."""
        return list(self.net.buffers())

    def step_blocks(
        self, blocks: Sequence[th.Tensor], constants: Sequence[th.Tensor], obs: th.Tensor, state: th.Tensor
    ) -> tuple[th.Tensor, th.Tensor, th.Tensor]:
        """:meth:`step` as a function of the parameter blocks."""
        tensors = dict(zip((name for name, _ in self.net.named_parameters()), blocks, strict=True))
        tensors.update(zip((name for name, _ in self.net.named_buffers()), constants, strict=True))
        outputs, next_state = th.func.functional_call(self.net, tensors, (obs, state))
        return *self.head(outputs), next_state

    def get_action_dist_params(self, obs: Any) -> tuple[th.Tensor, th.Tensor, dict[str, th.Tensor]]:
        """Mean and log_std from a circuit at rest, as SB3's SAC asks for them."""
        features = self.extract_features(obs, self.features_extractor)
        mean, log_std, _ = self.step(features, self.net.initial_state(len(features)))
        return mean, log_std, {}

    def forward(self, obs: PyTorchObs, deterministic: bool = False) -> th.Tensor:
        """Squashed action from a circuit at rest."""
        mean, log_std, _ = self.get_action_dist_params(obs)
        return self.action_dist.actions_from_params(mean, log_std, deterministic=deterministic)

    def action_log_prob(self, obs: PyTorchObs) -> tuple[th.Tensor, th.Tensor]:
        """Sampled action and its log-probability from a circuit at rest."""
        mean, log_std, _ = self.get_action_dist_params(obs)
        return self.action_dist.log_prob_from_params(mean, log_std)

    def _predict(self, observation: PyTorchObs, deterministic: bool = False) -> th.Tensor:
        return self.forward(observation, deterministic)


class LevelPolicy(SACPolicy):
    """SAC policy of one level over flat observations: actor, averaged actor, critics and their targets.

    ``average_actor`` has the actor's structure; its parameters are an exponential moving average of the actor's, kept
    by the update and saved with the policy. The deterministic policy of the average is steadier than the latest one's.

    :param negative_critic: see :class:`LevelCritic`
    :param critic_norm: see :class:`.LevelCritic`
    :param mean_bound: see :class:`GaussianHead`
    :param log_std_bounds: see :class:`GaussianHead`
    :param ndbc: None for an MLP actor, else the circuit's numbers, see :class:`NDBCActor`
    :param kwargs: arguments of SB3's ``SACPolicy`` (``net_arch``, ``activation_fn``, ...)
    :raises ConfigError: for spaces or options that a level cannot have
    """

    actor: MLPActor | NDBCActor  # type: ignore[assignment]
    critic: LevelCritic
    critic_target: LevelCritic
    average_actor: MLPActor | NDBCActor
    weights_version: int = 0
    """Grows whenever the weights change; what was derived from older weights is stale."""

    def __init__(
        self,
        observation_space: Space,
        action_space: spaces.Box,
        lr_schedule: Schedule,
        *args: Any,
        negative_critic: bool = False,
        critic_norm: str = "none",
        mean_bound: float | None = None,
        log_std_bounds: tuple[float, float] = (LOG_STD_MIN, LOG_STD_MAX),
        ndbc: PlainMapping | None = None,
        **kwargs: Any,
    ) -> None:
        if not isinstance(observation_space, spaces.Box) or len(observation_space.shape) != 1:
            raise ConfigError(f"a level observes a flat vector (Box of one dimension), got {observation_space}")
        if kwargs.get("use_sde") or kwargs.get("share_features_extractor"):
            raise ConfigError("a level has neither use_sde nor share_features_extractor; leave both False")
        self.level_kwargs: Plain = {
            "negative_critic": negative_critic,
            "critic_norm": critic_norm,
            "mean_bound": mean_bound,
            "log_std_bounds": (float(log_std_bounds[0]), float(log_std_bounds[1])),
            "ndbc": None if ndbc is None else dict(ndbc),
        }
        super().__init__(observation_space, action_space, lr_schedule, *args, **kwargs)

    def _build(self, lr_schedule: Schedule) -> None:
        super()._build(lr_schedule)
        self.average_actor = copy_actor(self.actor)

    def _get_constructor_parameters(self) -> Plain:
        return {**super()._get_constructor_parameters(), **self.level_kwargs}

    def load_state_dict(self, *args: Any, **kwargs: Any) -> object:
        """Load weights in place, see torch."""
        result = super().load_state_dict(*args, **kwargs)
        self._weights_changed()
        return result

    def after_updates(self, n_updates: int) -> None:
        """Bring up to date what depends on the weights, after they were updated ``n_updates`` times."""
        if isinstance(self.actor, NDBCActor):
            self.actor.net.after_update(n_updates)
        self._weights_changed()

    def _weights_changed(self) -> None:
        if isinstance(self.actor, NDBCActor) and isinstance(self.average_actor, NDBCActor):
            self.average_actor.net.sub_steps = self.actor.net.sub_steps
        self.weights_version += 1

    def make_actor(self, features_extractor: BaseFeaturesExtractor | None = None) -> MLPActor | NDBCActor:  # type: ignore[override]
        """Build the actor that ``ndbc`` asks for."""
        kwargs = self._update_features_extractor(self.actor_kwargs, features_extractor)
        bounds = {key: self.level_kwargs[key] for key in ("mean_bound", "log_std_bounds")}
        ndbc = self.level_kwargs["ndbc"]
        if ndbc is None:
            return MLPActor(**bounds, **kwargs).to(self.device)
        shared = ("observation_space", "action_space", "features_extractor", "features_dim", "normalize_images")
        return NDBCActor(ndbc=ndbc, **bounds, **{key: kwargs[key] for key in shared}).to(self.device)

    def make_critic(self, features_extractor: BaseFeaturesExtractor | None = None) -> LevelCritic:
        """Build the critics."""
        kwargs = self._update_features_extractor(self.critic_kwargs, features_extractor)
        negative, norm = self.level_kwargs["negative_critic"], self.level_kwargs["critic_norm"]
        return LevelCritic(negative=negative, norm=norm, **kwargs).to(self.device)


def copy_actor(actor: MLPActor | NDBCActor) -> MLPActor | NDBCActor:
    """A copy of an actor without its optimizer, not trained by gradients."""
    optimizer = actor.__dict__.pop("optimizer", None)
    try:
        average = copy.deepcopy(actor)
    finally:
        if optimizer is not None:
            actor.optimizer = optimizer
    average.requires_grad_(False)
    average.set_training_mode(False)
    return average
