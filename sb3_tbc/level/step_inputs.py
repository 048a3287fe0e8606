"""The arguments of one update by name; the update takes them as a flat list, in the order of torch's pytree."""

from __future__ import annotations

from typing import NamedTuple

import torch as th

from sb3_tbc.replay.batch import LevelBatch


class Schedules(NamedTuple):
    """Numbers that vary from update to update, as 0-dim tensors."""

    actor_step: th.Tensor  # learning rate / (1 - beta1^n)
    critic_step: th.Tensor
    ent_coef_step: th.Tensor
    actor_correction: th.Tensor  # 1 / sqrt(1 - beta2^n)
    critic_correction: th.Tensor
    ent_coef_correction: th.Tensor
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
    extremes: th.Tensor  # (2,), EXTREMES
    ent: th.Tensor  # temperature, or its logarithm when it is automatic
    actor: th.Tensor
    critic: th.Tensor
    target: th.Tensor
    average: th.Tensor
    statistics: tuple[th.Tensor, ...]  # the critics' running means and variances as one vector, where they have any
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
