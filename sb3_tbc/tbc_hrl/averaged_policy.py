"""SB3's policy of flat SAC with an averaged actor, so that the baseline is evaluated as the two-level agents are."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import torch as th
from stable_baselines3.common.type_aliases import PyTorchObs, Schedule
from stable_baselines3.sac.policies import Actor, MultiInputPolicy

from sb3_tbc.level.policies import copy_actor


class AveragedPolicy(MultiInputPolicy):
    """A policy whose deterministic actions are those of an average of the actor's weights.

    The average is a part of the policy: it is saved, loaded and resumed with it.
    """

    average_actor: Actor

    def _build(self, lr_schedule: Schedule) -> None:
        super()._build(lr_schedule)
        self.average_actor = copy_actor(self.actor)

    def load_state_dict(self, state_dict: Mapping[str, Any], *args: Any, **kwargs: Any) -> object:
        """Load weights in place, see torch; where they hold no average, it begins at the actor."""
        if not any(key.startswith("average_actor.") for key in state_dict):
            average = {f"average_{key}": value for key, value in state_dict.items() if key.startswith("actor.")}
            state_dict = {**state_dict, **average}
        return super().load_state_dict(state_dict, *args, **kwargs)

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
