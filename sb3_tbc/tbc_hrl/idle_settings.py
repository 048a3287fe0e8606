"""Settings that were given and change nothing, as the others are: named before learning, since no result would tell."""

from __future__ import annotations

from collections.abc import Iterator

from sb3_tbc.ndbc.stepping import StepRule
from sb3_tbc.tbc_hrl.level_config import LowPolicyConfig


def idle_in_actor(actor: LowPolicyConfig, memory: str) -> Iterator[str]:
    """Sentences about settings of the low level's actor that change nothing.

    :param memory: when its memory is reset
    """
    if memory != "none" and actor.ndbc is None and actor.gru is None:
        yield f"memory={memory!r} has no effect: the low level's actor is an MLP, which has no memory"
    rule = None if actor.ndbc is None else actor.ndbc.adaptive_step
    if isinstance(rule, StepRule) and not rule.half_step_check:
        for tolerance in ("relative_tolerance", "absolute_tolerance"):
            value = getattr(rule, tolerance)
            if value != getattr(StepRule, tolerance):
                where = f"low.policy_kwargs.ndbc.adaptive_step.{tolerance}"
                yield f"{where}={value:g} has no effect: it belongs to half_step_check, which agents of two levels lack"


def idle_in_agent(window_end: str, reconsider_margin: float, testing_fraction: float, *tests: bool) -> Iterator[str]:
    """Sentences about settings that are of no level alone.

    :param tests: whether ``testing_penalty`` and ``deterministic_testing`` were given
    """
    if window_end != "reconsider" and reconsider_margin != 1.0:
        yield f"reconsider_margin={reconsider_margin:g} has no effect: windows end by window_end={window_end!r}"
    for name, given in zip(("testing_penalty", "deterministic_testing"), tests, strict=True):
        if given and not testing_fraction:
            yield f"{name} has no effect: with testing_fraction=0 no subgoal is tested"
