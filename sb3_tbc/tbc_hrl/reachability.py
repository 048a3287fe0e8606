"""How many steps a subgoal is away: the reachability estimate behind the rule for time budgets (paper, equation 1)."""

from __future__ import annotations

import itertools

import numpy as np
import torch as th
from torch import nn
from torch.nn import functional

from sb3_tbc.arrays import Float32, FloatArray
from sb3_tbc.replay.buffers import ReachPairs, SubgoalReplayBuffer
from sb3_tbc.smdp.spaces import SubgoalSpace

UPDATE_EVERY = 4
"""Environment steps per update of the estimate."""
BATCH_SIZE = 256
HIDDEN = (64, 64)
"""Widths of the hidden layers."""


class Reachability(nn.Module):
    """Estimates ``H_reach(s, g)``, the steps from a state to a subgoal-space point, from what was visited when.

    Hindsight gives exact labels: the steps from a visited state to the first visit of a point of the same episode.
    Many of these ways are detours, so a low expectile is regressed: it leans toward the short ones, i.e. the geodesic.

    :param subgoals: bounds and scales of what goes in
    :param unit: a typical number of steps, the output's scale
    :param horizon: longest way that is learnt, steps
    :param expectile: below 0.5 leans toward short ways
    :param learning_rate: Adam's
    :param seed: of the weights and of what is sampled
    :raises ValueError: if ``expectile`` is not in (0, 1)
    """

    def __init__(
        self,
        subgoals: SubgoalSpace,
        unit: float,
        horizon: int,
        expectile: float = 0.3,
        learning_rate: float = 1e-3,
        seed: int | None = None,
    ) -> None:
        super().__init__()
        if not 0.0 < expectile < 1.0:
            raise ValueError(f"expectile must lie in (0, 1), got {expectile}")
        self.subgoals, self.unit, self.horizon, self.expectile = subgoals, unit, horizon, expectile
        self.rng = np.random.default_rng(seed)
        sizes = (subgoals.local_dim + 2 * subgoals.dim, *HIDDEN, 1)
        with th.random.fork_rng(devices=[]):
            th.manual_seed(0 if seed is None else seed)
            self.layers = nn.ModuleList(nn.Linear(a, b) for a, b in itertools.pairwise(sizes))
        self.optimizer = th.optim.Adam(self.parameters(), lr=learning_rate)

    def forward(self, inputs: th.Tensor) -> th.Tensor:
        """Steps ``(n, 1)`` of inputs as :meth:`inputs` gives them."""
        for layer in self.layers[:-1]:
            inputs = functional.silu(layer(inputs))
        return self.unit * functional.softplus(self.layers[-1](inputs))

    def inputs(self, local: FloatArray, here: FloatArray, goal: FloatArray) -> th.Tensor:
        """Network inputs: state, place and way to go, each scaled to about [-1, 1]."""
        width = self.subgoals.high - self.subgoals.low
        parts = [local / self.subgoals.local_scale, self.subgoals.scale(here), 2.0 * (goal - here) / width]
        return th.from_numpy(np.concatenate(parts, axis=-1).astype(np.float32))

    def steps(self, local: FloatArray, here: FloatArray, goal: FloatArray) -> Float32:
        """Estimated steps from states to subgoals, ``(n,)``.

        :param local: the low level's view of the states, ``(n, local_dim)``
        :param here: subgoal-space points of the states, ``(n, subgoal_dim)``
        :param goal: subgoals, task units, ``(n, subgoal_dim)``
        """
        with th.no_grad():
            return np.asarray(self(self.inputs(local, here, goal))[:, 0].numpy())

    def update(self, pairs: ReachPairs) -> float:
        """One step of expectile regression on hindsight pairs; its loss in squared units."""
        error = th.from_numpy(pairs.steps)[:, None] - self(self.inputs(pairs.local, pairs.here, pairs.goal))
        error = error / self.unit
        weight = th.where(error < 0, 1.0 - self.expectile, self.expectile)
        loss = (weight * error.square()).mean()
        self.optimizer.zero_grad()
        loss.backward()
        self.optimizer.step()
        return float(loss.detach())

    def train_on(self, buffer: SubgoalReplayBuffer, updates: int) -> float:
        """Update on pairs drawn from the low level's replay buffer; the mean loss.

        :param buffer: may not be empty
        :param updates: at least 1
        """
        losses = [self.update(buffer.sample_pairs(BATCH_SIZE, self.horizon, self.rng)) for _ in range(updates)]
        return float(np.mean(losses))
