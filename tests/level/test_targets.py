"""What the update makes of targets and of both critics: bounds, their logs, and the actor's choice between critics."""

import math

import pytest
import torch as th
from hypothesis import given, settings
from hypothesis import strategies as st
from levels import ACTION_DIM, BATCH, COMPILER, UPDATES, make_batches, make_level

from sb3_tbc.level.level import SACLevel
from sb3_tbc.smdp.bounds import ValueBounds

ROOM = ACTION_DIM * math.log(2.0)
"""Largest entropy of an action."""


def logged(level: SACLevel, name: str) -> float:
    return float(level.logger.name_to_value[f"level/{name}"])


@settings(max_examples=40, deadline=None)
@given(
    low=st.floats(-50, 5),
    width=st.floats(0.1, 60),
    later=st.floats(0, 50),
    ent_coef=st.sampled_from([0.01, 1.0, "auto_0.5"]),
    scale=st.floats(0.01, 1e3),
    negative=st.booleans(),
    norm=st.sampled_from(["none", "layer", "batch"]),
)
def test_no_target_lies_outside_of_the_bounds(
    low: float, width: float, later: float, ent_coef: str | float, scale: float, negative: bool, norm: str
) -> None:
    batches = make_batches(updates=4)
    level = make_level(
        batches._replace(rewards=scale * batches.rewards),
        policy_kwargs={"net_arch": [4], "negative_critic": negative, "critic_norm": norm},
        ent_coef=ent_coef,
        learning_rate=0.05,
        bounds=ValueBounds(low, low + width, later),
    )
    with th.no_grad():
        level._update.target.vector.mul_(10.0)
    largest = max(0.5 if ent_coef == "auto_0.5" else ent_coef, 0.7)
    level.train(4, BATCH)
    highest = low + width + largest * later * ROOM
    if negative:
        highest = min(highest, 0.0)
    assert logged(level, "target_max") <= highest + 1e-3 * (1 + abs(highest))
    if low <= highest:
        assert logged(level, "target_min") >= low - 1e-4


def test_targets_are_the_free_ones_clipped() -> None:
    """With a done everywhere a target is its reward, and the critics move as those of clipped rewards do."""
    batches = make_batches()
    batches = batches._replace(dones=th.ones_like(batches.dones))
    bounded = make_level(batches, bounds=ValueBounds(-0.5, 0.25), ent_coef=0.1)
    plain = make_level(batches._replace(rewards=batches.rewards.clamp(-0.5, 0.25)), ent_coef=0.1)
    for level in (bounded, plain):
        level.train(UPDATES, BATCH)
    assert th.equal(bounded._update.critic.vector, plain._update.critic.vector)
    assert logged(bounded, "target_min") == -0.5
    assert logged(bounded, "target_max") == 0.25
    outside = (batches.rewards < -0.5) | (batches.rewards > 0.25)
    assert logged(bounded, "target_clipped") == pytest.approx(float(outside.float().mean()), abs=1e-5)
    assert logged(plain, "target_clipped") == 0.0


def test_the_upper_bound_has_room_for_later_entropy() -> None:
    batches = make_batches()
    batches = batches._replace(rewards=batches.rewards + 100.0)
    level = make_level(batches, bounds=ValueBounds(0.0, 1.0, 3.0), ent_coef=0.2)
    level.train(2, BATCH)
    assert logged(level, "target_max") == pytest.approx(1.0 + 0.2 * 3.0 * ROOM, rel=1e-6)


def test_bounds_that_never_bind_change_nothing() -> None:
    free, wide = (make_level(make_batches(), bounds=bounds) for bounds in (None, ValueBounds(-1e6, 1e6)))
    for level in (free, wide):
        level.train(UPDATES, BATCH)
    assert th.equal(free._update.critic.vector, wide._update.critic.vector)
    assert th.equal(free._update.actor.vector, wide._update.actor.vector)


def test_extremes_are_those_of_all_updates_of_a_call(monkeypatch: pytest.MonkeyPatch) -> None:
    batches = make_batches(updates=6)
    batches = batches._replace(dones=th.ones_like(batches.dones))
    monkeypatch.setattr("sb3_tbc.level.level.BURST_ROWS", 2 * BATCH)  # three bursts
    level = make_level(batches)
    level.train(6, BATCH)
    assert logged(level, "target_min") == pytest.approx(float(batches.rewards.min()))
    assert logged(level, "target_max") == pytest.approx(float(batches.rewards.max()))


def test_impossible_bounds() -> None:
    with pytest.raises(ValueError, match=r"low < high, got \[1.0, 1.0\]"):
        make_level(make_batches(), bounds=ValueBounds(1.0, 1.0))


@pytest.mark.parametrize(
    ("actor_q", "expected"),
    [
        ("min", lambda q: q.amin(0)),
        ("mean", lambda q: q.mean(0)),
        ("max", lambda q: q.amax(0)),
        (0, lambda q: q.amin(0)),
        (0.25, lambda q: 0.75 * q.amin(0) + 0.25 * q.amax(0)),
        (1.0, lambda q: q.amax(0)),
    ],
)
def test_the_actor_climbs_the_chosen_value(actor_q: str | float, expected) -> None:
    level = make_level(make_batches(), actor_q=actor_q, policy_kwargs={"net_arch": [4], "n_critics": 3})
    q = th.randn(3, 10, 1)
    assert th.allclose(level._update._ascended(q), expected(q), atol=1e-6)


def test_an_optimistic_actor_leaves_targets_alone() -> None:
    """The critics' first step is the same, the actor's is not."""
    levels = [make_level(make_batches(), actor_q=actor_q) for actor_q in ("min", "max")]
    for level in levels:
        level.train(1, BATCH)
    assert th.equal(levels[0]._update.critic.vector, levels[1]._update.critic.vector)
    assert not th.equal(levels[0]._update.actor.vector, levels[1]._update.actor.vector)


@pytest.mark.parametrize("actor_q", ["median", -0.1, 1.5, True, None])
def test_unknown_actor_q(actor_q: object) -> None:
    with pytest.raises(ValueError, match="actor_q must be 'min', 'mean', 'max' or a number from 0"):
        make_level(make_batches(), actor_q=actor_q)


@pytest.mark.slow
@COMPILER
def test_compiled_agrees_with_eager() -> None:
    eager, compiled = (
        make_level(make_batches(), compile, bounds=ValueBounds(-1.0, 1.0, 2.0), actor_q=0.25)
        for compile in (False, True)
    )
    for level in (eager, compiled):
        level.train(UPDATES, BATCH)
    assert compiled.compiled
    for name, value in eager.policy.state_dict().items():
        assert th.allclose(compiled.policy.state_dict()[name], value, rtol=0, atol=1e-5), name
    for name in ("target_min", "target_max", "target_clipped"):
        assert logged(compiled, name) == pytest.approx(logged(eager, name), abs=1e-5)
