"""SB3's policy of flat SAC with an averaged actor, so that the baseline is evaluated as the two-level agents are."""

from __future__ import annotations

import copy

import torch as th
from stable_baselines3.common.type_aliases import PyTorchObs, Schedule
from stable_baselines3.sac.policies import Actor, MultiInputPolicy


class AveragedPolicy(MultiInputPolicy):
    """A policy whose deterministic actions are those of an average of the actor's weights.

    The average is a part of the policy: it is saved, loaded and resumed with it.
    """

    average_actor: Actor

    def _build(self, lr_schedule: Schedule) -> None:
        super()._build(lr_schedule)
        self.average_actor = copy.deepcopy(self.actor)
        self.average_actor.requires_grad_(False)
        self.average_actor.set_training_mode(False)

    @th.no_grad()
    def follow(self, update: int, decay: float) -> None:
        """Move the average toward the present weights, as :mod:`sb3_tbc.level.update` does.

        :param update: number of updates so far, this one included
        :param decay: share of the average that is kept; in early updates less
        """
        keep = min(decay, (1 + update) / (10 + update))
        for average, parameter in zip(self.average_actor.parameters(), self.actor.parameters(), strict=True):
            average.lerp_(parameter, 1.0 - keep)

    def _predict(self, observation: PyTorchObs, deterministic: bool = False) -> th.Tensor:
        if not deterministic:
            return super()._predict(observation, deterministic)
        return self.average_actor(observation, deterministic)  # type: ignore[no-any-return]
