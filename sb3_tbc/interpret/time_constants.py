"""How fast each neuron of a circuit is, and how much of a decision its memory carries."""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
import torch as th

from sb3_tbc.arrays import FloatArray
from sb3_tbc.interpret.episodes import Trace
from sb3_tbc.interpret.units import CircuitUnits, Units, no_lesion


class TimeConstants(NamedTuple):
    """In control steps, per neuron ``(N,)``, over all steps of the episodes."""

    median: FloatArray
    low: FloatArray  # 5th percentile
    high: FloatArray  # 95th percentile


class MemoryShare(NamedTuple):
    """What the membrane from the step before adds to actions."""

    share: float  # mean squared change of actions without it, relative to their variance
    largest: float  # largest change of one action, unit coordinates (-1 to 1)


def time_constants(units: CircuitUnits, traces: Sequence[Trace]) -> TimeConstants:
    """Effective time constants over episodes; see :meth:`~sb3_tbc.ndbc.network.NDBCNet.time_constants`."""
    inputs = th.as_tensor(np.concatenate([t.inputs for t in traces])).double()
    potentials = th.as_tensor(np.concatenate([t.activations for t in traces])).double()
    values = units.net.time_constants(inputs, potentials).numpy()
    low, median, high = np.percentile(values, [5, 50, 95], axis=0)
    return TimeConstants(median, low, high)


def memory_share(units: Units, traces: Sequence[Trace]) -> MemoryShare:
    """Take the same steps once with the recorded membrane and once from zero."""
    inputs, before = (np.concatenate([getattr(t, name) for t in traces]) for name in ("inputs", "before"))
    lesion = no_lesion(units)
    with_memory = units.step(inputs, before, lesion)[0]
    without = units.step(inputs, np.zeros_like(before), lesion)[0]
    variance = float(with_memory.var(axis=0).sum())
    change = ((with_memory - without) ** 2).sum(axis=1)
    share = float(change.mean()) / variance if variance > 1e-12 else 0.0
    return MemoryShare(share, float(np.abs(with_memory - without).max()))
