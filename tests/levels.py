"""A small level with batches that are given, not sampled; shared by the tests of updates."""

import numpy as np
import pytest
import torch as th
from gymnasium import spaces
from stable_baselines3.common.type_aliases import ReplayBufferSamples

from sb3_tbc.level import compilation
from sb3_tbc.level.level import SACLevel
from sb3_tbc.replay.batch import LevelBatch

OBS_DIM, ACTION_DIM, BATCH, UPDATES = 5, 2, 32, 50
OBSERVATIONS = spaces.Box(-np.inf, np.inf, (OBS_DIM,), np.float32)
ACTIONS = spaces.Box(-1.0, 1.0, (ACTION_DIM,), np.float32)
COMPILER = pytest.mark.skipif(compilation.compiler_problem() is not None, reason="no C++ compiler")


def make_batches(seed: int = 0, state_dim: int = 0, updates: int = UPDATES, earlier_steps: int = 0) -> LevelBatch:
    g = th.Generator().manual_seed(seed)

    def draw(width: int) -> th.Tensor:
        return th.randn(updates, BATCH, width, generator=g)

    discounts = 0.9 + 0.1 * th.rand(updates, BATCH, 1, generator=g)
    dones = (draw(1) > 1.0).float()
    states = (0.3 * draw(state_dim), 0.3 * draw(state_dim))
    plain = draw(OBS_DIM), th.tanh(draw(ACTION_DIM)), draw(OBS_DIM), draw(1)
    earlier = [part for _ in range(earlier_steps) for part in ((draw(1) > 0).float(), draw(OBS_DIM))]
    return LevelBatch(*plain, dones, discounts, *states, th.cat([draw(0), *earlier], dim=-1))


class FixedBuffer:
    """Hands out given batches in order, to a level as bursts, to SB3 one by one."""

    def __init__(self, batches: LevelBatch) -> None:
        self.batches, self.used = batches, 0

    def sample_burst(self, gradient_steps: int, batch_size: int) -> LevelBatch:
        start, self.used = self.used, self.used + gradient_steps
        return LevelBatch(*(x[start : self.used, :batch_size] for x in self.batches))

    def sample(self, batch_size: int, env: object = None) -> ReplayBufferSamples:
        b = LevelBatch(*(x[0] for x in self.sample_burst(1, batch_size)))
        return ReplayBufferSamples(b.observations, b.actions, b.next_observations, b.dones, b.rewards, b.discounts)


def make_level(batches: LevelBatch, compile: bool | str = False, **kwargs: object) -> SACLevel:
    arguments = {"learning_rate": 1e-3, "policy_kwargs": {"net_arch": [16, 16]}, "seed": 3, **kwargs}
    level = SACLevel(OBSERVATIONS, ACTIONS, compile=compile, **arguments)
    level.replay_buffer = FixedBuffer(batches)
    return level


class LabelledBuffer(FixedBuffer):
    """The same batches with a label each."""

    def __init__(self, batches: LevelBatch, label: float) -> None:
        super().__init__(batches)
        self.label = label

    def sample_labelled(self, gradient_steps: int, batch_size: int) -> tuple[LevelBatch, th.Tensor]:
        return self.sample_burst(gradient_steps, batch_size), th.full((gradient_steps, batch_size, 1), self.label)


def labelled_level(label: float, coef: float, compile: bool = False) -> SACLevel:
    level = make_level(make_batches(), compile, label_coef=coef, ent_coef=0.01)
    level.replay_buffer = LabelledBuffer(make_batches(), label)
    return level
