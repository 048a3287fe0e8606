"""Episodes that are cut anew: windows that could have been chosen, and transitions that did happen."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from two_windows import ENV, GOALS, LAYOUT, RULES, episode, option

from sb3_tbc.smdp.cuts import cut_anew
from sb3_tbc.smdp.hindsight import HighLevelSteps, HindsightSettings, high_level_steps
from sb3_tbc.smdp.options import Episode, OptionRules
from sb3_tbc.smdp.rewards import HighLevelReward
from sb3_tbc.smdp.spaces import SubgoalSpace

REWARD = HighLevelReward("smdp", 0.9, dt_ref=2.0, dt_max=4.0, decision_cost=1.0, duration_cost=2.0)


def walk(steps: int) -> Episode:
    """An episode that goes from 0 to 1 in steps of equal length and ends there."""
    path = np.linspace(0.0, 1.0, steps + 1)
    rows = np.stack([path, np.arange(steps + 1.0), np.ones(steps + 1)], axis=1).astype(np.float32)
    return episode()._replace(
        observation=rows, achieved_goal=path[:, None], desired_goal=np.ones((steps + 1, 1)),
        actions=np.zeros((steps, 1), np.float32), states=np.zeros((steps, 2), np.float32),
        next_states=np.zeros((steps, 2), np.float32), rewards=np.append(np.full(steps - 1, -1.0), 0.0),
        options=tuple(option(i, 1, 0.9, 1.0, i == 0, False) for i in range(steps)),
    )  # fmt: skip


def learnt(of: Episode, n_cuts: int, seed: int = 0, tolerance: float | None = None) -> HighLevelSteps:
    settings = HindsightSettings(2, "future", -5.0, False, tolerance, n_cuts=n_cuts, cut_lengths=(1, 4))
    return high_level_steps(of, LAYOUT, RULES, REWARD, settings, GOALS, np.random.default_rng(seed))


@given(steps=st.integers(1, 40), shortest=st.integers(1, 8), more=st.integers(0, 5), seed=st.integers(0, 999))
def test_windows_follow_each_other_and_have_lengths_that_can_be_chosen(
    steps: int, shortest: int, more: int, seed: int
) -> None:
    lengths = (shortest, shortest + more)
    cut = cut_anew(walk(steps), ENV.subgoals, lengths, np.random.default_rng(seed))
    options = cut.options
    assert 0 <= steps - cut.length < shortest
    assert options[0].start == 0
    assert [o.start + o.duration for o in options] == [*(o.start for o in options[1:]), cut.length]
    np.testing.assert_array_equal(cut.achieved_goal, walk(steps).achieved_goal[steps - cut.length :])
    assert all(lengths[0] <= o.duration <= lengths[1] for o in options[:-1])
    assert 1 <= options[-1].duration <= lengths[1]


def test_cuts_differ() -> None:
    rng = np.random.default_rng(0)
    found = {tuple(o.start for o in cut_anew(walk(30), ENV.subgoals, (2, 9), rng).options) for _ in range(20)}
    assert len(found) > 15


def test_an_event_ends_a_window() -> None:
    space = SubgoalSpace.from_slices([-1], [1], [0.1], local_scale=[1, 1, 1], names=["position"], event=2)
    of = walk(20)
    of.observation[:, 2] = 0.0
    of.observation[7, 2] = 1.0
    for seed in range(20):
        cut = cut_anew(of, space, (5, 9), np.random.default_rng(seed))
        assert 7 - (20 - cut.length) in [o.start + o.duration for o in cut.options]


@given(seed=st.integers(0, 999))
def test_transitions_of_cuts_are_what_happened(seed: int) -> None:
    of, n_cuts = walk(17), 3
    chosen, steps = learnt(of, 0, seed), learnt(of, n_cuts, seed)
    for name in HighLevelSteps._fields:  # those of the high level's own windows come first, unchanged
        np.testing.assert_array_equal(getattr(steps, name)[: len(chosen.rewards)], getattr(chosen, name))
    more = HighLevelSteps(*(column[len(chosen.rewards) :] for column in steps))
    assert more.relabelled.all()
    true_goal = np.isclose(more.observations[:, 0], 1.0)
    starts = np.rint(more.here[:, 0] * 17).astype(int)
    ends = np.rint(LAYOUT.subgoals.unscale(more.actions[:, :-1])[:, 0] * 17).astype(int)
    took = np.ceil(RULES.budget(more.actions[:, -1]))
    np.testing.assert_array_equal(took, ends - starts)
    np.testing.assert_array_equal(more.durations[true_goal], took[true_goal])
    np.testing.assert_array_equal(more.dones[true_goal], ends[true_goal] == 17)
    np.testing.assert_array_less(0, took)


def test_cuts_add_neither_penalties_nor_options_that_hindsight_leaves_out() -> None:
    of = walk(12)
    of = of._replace(achieved_goal=of.achieved_goal + 5.0)  # out of reach of every subgoal
    kept = learnt(of, 0, tolerance=0.05)
    assert len(learnt(of, 4, tolerance=0.05).rewards) == len(kept.rewards)
    steps = learnt(walk(12), 4)
    assert np.isfinite(steps.actions).all()
    assert np.count_nonzero(steps.rewards == -5.0) == 1  # the failed test of the window that was chosen


@pytest.mark.parametrize(
    ("budget", "whole", "steps"), [(0.0, False, 1), (2.1, False, 3), (2.1, True, 2), (0.2, True, 1), (4.0, False, 4)]
)
def test_how_long_a_budget_lasts(budget: float, whole: bool, steps: int) -> None:
    assert OptionRules(dt_max=5.0, whole_budgets=whole).lasts(budget) == steps
