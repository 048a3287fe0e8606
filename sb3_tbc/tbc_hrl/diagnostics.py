"""Running means that explain learning: what each level did since the last log."""

from __future__ import annotations

from collections import defaultdict
from typing import Any

import numpy as np

from sb3_tbc.hindsight import HighLevelSteps
from sb3_tbc.options import Episode


class EpisodeDiagnostics:
    """Collects per-episode figures of both levels and gives their means."""

    def __init__(self) -> None:
        self.values: dict[str, list[float]] = defaultdict(list)

    def add(self, episode: Episode, steps: HighLevelSteps) -> None:
        """Take in a finished episode and the transitions made of it."""
        options = episode.options
        values: dict[str, Any] = {
            "option/subgoal_success": np.mean([option.reached for option in options]),
            "option/time_budget": np.mean([option.time_budget for option in options]),
            "option/duration": np.mean([option.duration for option in options]),
            "option/per_episode": len(options),
            "option/relabelled_share": np.mean(steps.relabelled),
            "high/reward_mean": np.mean(steps.rewards),
            "high/goal_reached_share": np.mean(steps.dones),
        }
        for name, value in values.items():
            self.values[name].append(float(value))

    def drain(self) -> dict[str, float]:
        """Means since the last call, by log name."""
        means = {name: float(np.mean(values)) for name, values in self.values.items()}
        self.values.clear()
        return means
