"""The form of a replay sample."""

from __future__ import annotations

from typing import NamedTuple

import torch as th


class LevelBatch(NamedTuple):
    """A replay sample of one level; leading dimensions ``(batch,)`` or ``(gradient_steps, batch)``, float32.

    ``states`` are the membrane potentials an NDBC actor started the step from (width 0 for an MLP actor). Where
    ``earlier`` holds steps of the same window, they are those before the first of them.
    ``discounts`` is gamma per transition (gamma**duration on the high level), not yet multiplied by ``1 - dones``.
    """

    observations: th.Tensor
    actions: th.Tensor
    next_observations: th.Tensor
    rewards: th.Tensor  # (..., 1)
    dones: th.Tensor  # (..., 1)
    discounts: th.Tensor  # (..., 1)
    states: th.Tensor  # (..., state_dim)
    next_states: th.Tensor  # (..., state_dim)
    earlier: th.Tensor  # (..., time * (1 + observation_dim)): whether the window had begun, and what was observed
