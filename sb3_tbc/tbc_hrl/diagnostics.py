"""What learning tells: means of what each level did, SB3's keys of progress, settings, and the progress bar."""

from __future__ import annotations

import time
from collections import defaultdict
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Protocol

import numpy as np
from stable_baselines3.common.base_class import BaseAlgorithm
from stable_baselines3.common.callbacks import BaseCallback, CallbackList, ProgressBarCallback
from stable_baselines3.common.logger import HParam, TensorBoardOutputFormat
from stable_baselines3.common.utils import safe_mean

from sb3_tbc.aliases import Plain, PlainMapping
from sb3_tbc.settings import flat
from sb3_tbc.smdp.hindsight import HighLevelSteps
from sb3_tbc.smdp.options import Episode


class EpisodeDiagnostics:
    """Collects per-episode figures of both levels and gives their means."""

    def __init__(self) -> None:
        self.values: dict[str, list[float]] = defaultdict(list)

    def add(self, episode: Episode, steps: HighLevelSteps) -> None:
        """Take in a finished episode and the transitions made of it."""
        options = episode.options
        values: Plain = {
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


def record_progress(model: BaseAlgorithm) -> None:
    """Log what SB3's algorithms log of the time that passed and of the episodes that ended."""
    logger = model.logger
    elapsed = max((time.time_ns() - model.start_time) / 1e9, 1e-9)
    logger.record("time/episodes", model._episode_num, exclude="tensorboard")
    logger.record("time/fps", int((model.num_timesteps - model._num_timesteps_at_start) / elapsed))
    logger.record("time/time_elapsed", int(elapsed), exclude="tensorboard")
    logger.record("time/total_timesteps", model.num_timesteps, exclude="tensorboard")
    if model.ep_info_buffer:
        logger.record("rollout/ep_rew_mean", safe_mean([info["r"] for info in model.ep_info_buffer]))
        logger.record("rollout/ep_len_mean", safe_mean([info["l"] for info in model.ep_info_buffer]))
    if model.ep_success_buffer:
        logger.record("rollout/success_rate", safe_mean(model.ep_success_buffer))
    logger.record("train/n_updates", model._n_updates)


METRICS = ("eval/success_rate", "rollout/success_rate", "rollout/ep_rew_mean")
"""What TensorBoard shows beside the settings of a run."""


def record_settings(model: BaseAlgorithm, settings: PlainMapping) -> None:
    """Let TensorBoard show an agent's settings as hyperparameters, once for each of its files.

    :param settings: plain data; sections become dotted names
    """
    logger = model.logger
    if not any(isinstance(form, TensorBoardOutputFormat) for form in logger.output_formats):
        return
    if getattr(model, "_settings_told_to", None) is logger:
        return
    model._settings_told_to = logger  # type: ignore[attr-defined]
    dotted = {name: x if isinstance(x, bool | int | float) else str(x) for name, x in flat(settings).items()}
    told = HParam({"algorithm": type(model).__name__, **dotted}, dict.fromkeys(METRICS, 0.0))
    logger.record("hparams", told, exclude=("stdout", "log", "json", "csv"))


class ProgressBar(Protocol):
    """What is asked of the bar that SB3 shows, a tqdm bar."""

    def set_description(self, desc: str | None = None, /) -> None:
        """Show a text on the bar; None shows none."""


def progress_bar_of(callback: BaseCallback) -> ProgressBar | None:
    """The bar that SB3 shows while learning; None without one.

    :param callback: what ``learn`` calls, its training started
    """
    if isinstance(callback, CallbackList):
        return next(filter(None, map(progress_bar_of, callback.callbacks)), None)
    return callback.pbar if isinstance(callback, ProgressBarCallback) else None


@contextmanager
def described(bar: ProgressBar | None, text: str) -> Iterator[None]:
    """Show a text on the bar for a while.

    :param bar: the bar; None: nothing is shown
    :param text: what is going on
    """
    if bar is None or not text:
        yield
        return
    bar.set_description(text)
    try:
        yield
    finally:
        bar.set_description(None)
