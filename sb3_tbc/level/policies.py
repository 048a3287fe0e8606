"""Policies of one level: SB3's SAC policy with one of this package's actors and an averaged copy of it."""

from __future__ import annotations

import copy
from typing import Any, TypeVar

from gymnasium import spaces
from stable_baselines3.common.policies import BasePolicy
from stable_baselines3.common.torch_layers import BaseFeaturesExtractor
from stable_baselines3.common.type_aliases import Schedule
from stable_baselines3.sac.policies import LOG_STD_MAX, LOG_STD_MIN, SACPolicy

from sb3_tbc.aliases import Plain, PlainMapping, Space
from sb3_tbc.errors import ConfigError
from sb3_tbc.level.actors import GRUActor, MemoryActor, MLPActor, NDBCActor
from sb3_tbc.level.critics import LevelCritic

LevelActor = MLPActor | NDBCActor | GRUActor
AnyActor = TypeVar("AnyActor", bound=BasePolicy)


class LevelPolicy(SACPolicy):
    """SAC policy of one level over flat observations: actor, averaged actor, critics and their targets.

    ``average_actor`` has the actor's structure; its parameters are an exponential moving average of the actor's, kept
    by the update and saved with the policy. The deterministic policy of the average is steadier than the latest one's.

    :param observation_space: flat observations of the level
    :param action_space: the level's actions, unit coordinates
    :param lr_schedule: learning rate of actor and critics
    :param negative_critic: see :class:`.LevelCritic`
    :param critic_norm: see :class:`.LevelCritic`
    :param mean_bound: see :class:`.GaussianHead`
    :param log_std_bounds: see :class:`.GaussianHead`
    :param ndbc: None for an MLP actor, else the circuit's numbers, see :class:`.NDBCActor`
    :param gru: None, or the settings of the GRU that acts, see :class:`.GRUActor`
    :param critic_memory: critics see the actor's memory beside the observation. Where observations hide something,
        the value of an action depends on what was seen before
    :param kwargs: arguments of SB3's ``SACPolicy`` (``net_arch``, ``activation_fn``, ...)
    :raises ConfigError: for spaces or options that a level cannot have
    """

    actor: LevelActor  # type: ignore[assignment]
    critic: LevelCritic
    critic_target: LevelCritic
    average_actor: LevelActor
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
        gru: PlainMapping | None = None,
        critic_memory: bool = False,
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
            "gru": None if gru is None else dict(gru),
            "critic_memory": critic_memory,
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
        if isinstance(self.actor, MemoryActor):
            self.actor.net.after_update(n_updates)
        self._weights_changed()

    def _weights_changed(self) -> None:
        if isinstance(self.actor, NDBCActor) and isinstance(self.average_actor, NDBCActor):
            self.average_actor.net.sub_steps = self.actor.net.sub_steps
        self.weights_version += 1

    def make_actor(self, features_extractor: BaseFeaturesExtractor | None = None) -> LevelActor:  # type: ignore[override]
        """Build the actor that ``ndbc`` or ``gru`` asks for, else an MLP."""
        kwargs = self._update_features_extractor(self.actor_kwargs, features_extractor)
        bounds = {key: self.level_kwargs[key] for key in ("mean_bound", "log_std_bounds")}
        shared = ("observation_space", "action_space", "features_extractor", "features_dim", "normalize_images")
        given = bounds | {key: kwargs[key] for key in shared}
        if self.level_kwargs["ndbc"] is not None:
            return NDBCActor(settings=self.level_kwargs["ndbc"], **given).to(self.device)
        if self.level_kwargs["gru"] is not None:
            return GRUActor(settings=self.level_kwargs["gru"], **given).to(self.device)
        return MLPActor(**bounds, **kwargs).to(self.device)

    def make_critic(self, features_extractor: BaseFeaturesExtractor | None = None) -> LevelCritic:
        """Build the critics, after the actor."""
        kwargs = self._update_features_extractor(self.critic_kwargs, features_extractor)
        negative, norm = self.level_kwargs["negative_critic"], self.level_kwargs["critic_norm"]
        if self.level_kwargs["critic_memory"]:
            kwargs["features_dim"] += self.actor.state_dim
        return LevelCritic(negative=negative, norm=norm, **kwargs).to(self.device)


def copy_actor(actor: AnyActor) -> AnyActor:
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
