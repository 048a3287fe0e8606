"""Settings that were given and change nothing, as the others are: named before learning, since no result would tell."""

from __future__ import annotations

import warnings
from collections.abc import Iterator

from sb3_tbc.ndbc.stepping import StepRule
from sb3_tbc.tbc_hrl.config import TBCConfig


def warn_of_idle_settings(config: TBCConfig) -> None:
    """Warn of settings that change nothing, and of a level that would never be updated."""
    for sentence in (*_idle_in_agent(config), *_idle_in_actor(config), *_small_buffers(config)):
        warnings.warn(sentence, stacklevel=3)


def _idle_in_agent(config: TBCConfig) -> Iterator[str]:
    margin, end = config.reconsider_margin, config.window_end
    if end != "reconsider" and margin != 1.0:
        yield f"reconsider_margin={margin:g} has no effect: windows end by window_end={end!r}"
    if config.hindsight_cuts_fraction != 1.0 and not config.n_hindsight_cuts:
        share = config.hindsight_cuts_fraction
        yield f"hindsight_cuts_fraction={share:g} has no effect: with n_hindsight_cuts=0 no episode is cut anew"
    tests = {
        "testing_penalty": config.testing_penalty is not None,
        "deterministic_testing": config.deterministic_testing,
    }
    for name, given in tests.items():
        if given and not config.testing_fraction:
            yield f"{name} has no effect: with testing_fraction=0 no subgoal is tested"


def _idle_in_actor(config: TBCConfig) -> Iterator[str]:
    actor = config.low.policy_kwargs
    if config.memory != "none" and actor.ndbc is None and actor.gru is None:
        yield f"memory={config.memory!r} has no effect: the low level's actor is an MLP, which has no memory"
    rule = None if actor.ndbc is None else actor.ndbc.adaptive_step
    if isinstance(rule, StepRule) and not rule.half_step_check:
        for tolerance in ("relative_tolerance", "absolute_tolerance"):
            value = getattr(rule, tolerance)
            if value != getattr(StepRule, tolerance):
                where = f"low.policy_kwargs.ndbc.adaptive_step.{tolerance}"
                yield f"{where}={value:g} has no effect: it belongs to half_step_check, which agents of two levels lack"


def _small_buffers(config: TBCConfig) -> Iterator[str]:
    for name, level in (("high", config.high), ("low", config.low)):
        if level.buffer_size < level.batch_size:
            yield (
                f"the {name} level is never updated: {name}.buffer_size={level.buffer_size} holds less than a batch of "
                f"{name}.batch_size={level.batch_size}"
            )
