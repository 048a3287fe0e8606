"""Hindsight worked by hand on one short episode."""

from __future__ import annotations

import numpy as np
import pytest
from two_windows import ENV, GOALS, LAYOUT, RULES, SPARSE, episode, option

from sb3_tbc.smdp.hindsight import (
    HighLevelSteps,
    HindsightSettings,
    check_goal_strategy,
    goal_pairs,
    high_level_steps,
    hindsight_success,
    low_level_steps,
    ordered_pairs,
    relabel_actions,
    relabel_goals,
)
from sb3_tbc.smdp.options import Episode, OptionRules, TerminationReason
from sb3_tbc.smdp.rewards import HighLevelReward, LowLevelReward
from sb3_tbc.smdp.spaces import SubgoalSpace


def test_low_level_transitions_of_two_windows() -> None:
    steps = low_level_steps(episode(), SPARSE)
    np.testing.assert_array_equal(steps.position, [0, 1, 2, 0, 1])
    np.testing.assert_array_equal(steps.length, [3, 3, 3, 2, 2])
    np.testing.assert_array_equal(steps.time_left, [2.5, 1.5, 0.5, 1.5, 0.5])
    np.testing.assert_array_equal(steps.dones, [False, False, True, False, True])
    np.testing.assert_array_equal(steps.rewards, [0, 0, 0, 0, 1])
    np.testing.assert_allclose(steps.achieved[:, 0], [0.1, 0.2, 0.3, 0.4, 0.5])
    for kept in ("actions", "states", "next_states"):
        np.testing.assert_array_equal(getattr(steps, kept), getattr(episode(), kept))


def test_window_cut_by_the_episode_is_not_over_for_the_low_level() -> None:
    cut = episode()._replace(options=(option(0, 3, 0.9, 2.5, True, False), option(3, 2, -0.5, 3.5, False, False)))
    assert not low_level_steps(cut, SPARSE).dones[-1]


def test_failed_option_becomes_the_one_that_was_achieved() -> None:
    actions, failed = relabel_actions(episode(), ENV.subgoals, RULES, np.random.default_rng(0))
    np.testing.assert_array_equal(failed, [True, False])
    assert actions[0, 0] == pytest.approx(0.3)
    assert 2.0 < RULES.budget(actions[0, 1:])[0] <= 3.0  # expires at the third step
    np.testing.assert_array_equal(actions[1], episode().options[1].unit_action)


def test_goal_pairs_never_use_an_options_own_outcome_nor_the_past() -> None:
    pairs = goal_pairs(4, 3, "future", np.random.default_rng(0))
    assert (pairs[:, 1] > pairs[:, 0]).all()
    assert np.bincount(pairs[:, 0], minlength=4).tolist() == [3, 2, 1, 0]
    anywhere = goal_pairs(4, 3, "episode", np.random.default_rng(0))
    assert np.bincount(anywhere[:, 0]).tolist() == [3, 3, 3, 3]


def test_relabelled_goal_met_inside_a_window_ends_it_there() -> None:
    reward = HighLevelReward("smdp", 1.0, dt_ref=2.0, dt_max=4.0, decision_cost=1.0, duration_cost=0.0)
    starts, durations = np.array([0, 0, 3]), np.array([3, 3, 2])
    copies = relabel_goals(episode(), starts, durations, np.array([[0.2], [0.9], [0.5]]), reward, GOALS, at_end=False)
    np.testing.assert_array_equal(copies.dones, [True, False, True])
    np.testing.assert_array_equal(copies.durations, [2, 3, 2])
    np.testing.assert_allclose(copies.rewards, [-1 / 2 - 1, -3 / 2 - 1, -1 / 2 - 1])
    hits = HighLevelReward("decision", 0.9, dt_ref=2.0, dt_max=4.0, decision_cost=0.0, duration_cost=0.0)
    goals = np.array([[0.2], [0.3], [0.5]])
    at_the_end = relabel_goals(episode(), starts, durations, goals, hits, GOALS, at_end=True)
    np.testing.assert_array_equal(at_the_end.dones, [False, True, True])
    np.testing.assert_array_equal(at_the_end.rewards, [-1, 0, 0])
    at_the_end = relabel_goals(episode(), starts, durations, goals, reward, GOALS, at_end=True)
    np.testing.assert_array_equal(at_the_end.dones, [False, True, True])
    np.testing.assert_array_equal(at_the_end.durations, durations)
    np.testing.assert_allclose(at_the_end.rewards, [-2 / 2 - 1, -2 / 2 - 1, -1 / 2 - 1])


@pytest.mark.parametrize(("goals_met", "met"), [("passing", 1), ("end", 0)])
def test_where_windows_meet_hindsight_goals_is_a_setting(goals_met: str, met: int) -> None:
    there_and_on = np.array([0.0, 0.2, 0.5, 0.3, 0.4, 0.2])  # the second window ends where the first passed
    rows = np.stack([there_and_on, np.arange(6.0), np.ones(6)], axis=1).astype(np.float32)
    wandering = episode()._replace(observation=rows, achieved_goal=there_and_on[:, None], desired_goal=np.ones((6, 1)))
    reward = HighLevelReward("smdp", 1.0, dt_ref=2.0, dt_max=4.0, decision_cost=1.0, duration_cost=0.0)
    settings = HindsightSettings(1, "future", -5.0, keep_original=False, goals_met=goals_met)
    steps = high_level_steps(wandering, LAYOUT, RULES, reward, settings, GOALS, np.random.default_rng(0))
    assert steps.dones[-1] == met
    assert steps.durations[-1] == (1 if met else 3)


def test_all_high_level_transitions_by_hand() -> None:
    reward = HighLevelReward("decision", 0.9, dt_ref=2.0, dt_max=4.0, decision_cost=0.0, duration_cost=2.0)
    settings = HindsightSettings(n_goals=1, goal_strategy="future", testing_penalty=-5.0, keep_original=False)
    steps = high_level_steps(episode(), LAYOUT, RULES, reward, settings, GOALS, np.random.default_rng(0))
    # failed test, two hindsight actions, one goal copy (the first option with the second's outcome)
    assert len(steps.rewards) == 4
    assert steps.rewards[0] == -5.0
    assert steps.actions[0, 0] == pytest.approx(0.9)
    took = RULES.budget(steps.actions[1, 1:])[0]
    np.testing.assert_allclose(steps.rewards[1:], [-1 - 2 * took / 4, 0 - 2 * 1.5 / 4, -1 - 2 * took / 4])
    np.testing.assert_array_equal(steps.dones, [False, False, True, False])
    np.testing.assert_array_equal(steps.relabelled, [False, True, False, True])
    np.testing.assert_allclose(steps.observations[3, 0], 0.5)  # the goal comes first in the high level's view
    np.testing.assert_allclose(steps.discounts, 0.9)


def high_steps(of: Episode, duration_cost: float = 0.0, keep_original: bool = False) -> HighLevelSteps:
    reward = HighLevelReward("decision", 0.9, dt_ref=2.0, dt_max=4.0, decision_cost=0.0, duration_cost=duration_cost)
    settings = HindsightSettings(0, "future", -5.0, keep_original=keep_original)
    return high_level_steps(of, LAYOUT, RULES, reward, settings, GOALS, np.random.default_rng(0))


def test_a_reached_test_is_not_punished() -> None:
    options = (option(0, 3, 0.9, 2.5, True, False), option(3, 2, 0.5, 1.5, True, True))
    steps = high_steps(episode()._replace(options=options))
    assert steps.rewards.tolist() == [-5.0, -1.0, 0.0]  # the first failed, and what became of both
    assert steps.actions[0, 0] == pytest.approx(0.9)


@pytest.mark.parametrize(
    ("reason", "success", "punished"),
    [
        (TerminationReason.EPISODE_END, True, 1),  # success came before the budget was spent
        (TerminationReason.EPISODE_END, False, 2),  # the time limit
        (TerminationReason.EXPIRED, True, 2),  # its own time was up as well
    ],
)
def test_a_test_that_success_cuts_off_has_not_failed(reason: TerminationReason, success: bool, punished: int) -> None:
    cut = option(3, 2, -0.9, 3.5, True, False)._replace(reason=reason)
    options = (option(0, 3, 0.9, 2.5, True, False), cut)
    steps = high_steps(episode()._replace(options=options, success=success), keep_original=True)
    assert (steps.rewards == -5.0).sum() == punished
    kept = np.isclose(steps.actions[:, 0], -0.9) & (steps.rewards > -5.0)
    assert kept.sum() == (punished == 1)  # what was asked for is learned from as of any option that was no test


def test_originals_pay_for_their_time_too() -> None:
    options = (option(0, 3, 0.9, 2.5, False, False), option(3, 2, 0.5, 1.5, False, True))
    steps = high_steps(episode()._replace(options=options), duration_cost=2.0, keep_original=True)
    took = RULES.budget(steps.actions[:, 1])
    assert took[0] == pytest.approx(2.5)
    np.testing.assert_allclose(steps.rewards, np.array([-1.0, -1.0, 0.0]) - 2.0 * took / 4.0)


def test_ordered_pairs_are_uniform() -> None:
    rng = np.random.default_rng(0)
    first, second = ordered_pairs(np.full(60_000, 3), rng)
    counts = np.bincount(first * 3 + second, minlength=9)
    assert counts[[3, 6, 7]].sum() == 0
    np.testing.assert_allclose(counts[[0, 1, 2, 4, 5, 8]] / 60_000, 1 / 6, atol=0.01)


def test_whole_budgets_are_rounded_and_last_as_long_as_they_say() -> None:
    whole = OptionRules(dt_max=4.0, dt_min=0.0, whole_budgets=True)
    np.testing.assert_array_equal(whole.budget(np.array([-1.0, -0.6, -0.3, 0.1, 0.3, 1.0])), [1, 1, 1, 2, 3, 4])
    steps = np.repeat([1.0, 2.0, 3.0, 4.0], 500)
    unit = whole.unit_budget(whole.budget_that_lasted(steps, np.random.default_rng(0)))
    np.testing.assert_array_equal(whole.budget(unit), steps)
    fractional = OptionRules(dt_max=4.0)
    lasted = fractional.budget(fractional.unit_budget(fractional.budget_that_lasted(steps, np.random.default_rng(0))))
    np.testing.assert_array_equal(np.ceil(lasted), steps)


def test_dense_reward_adds_up_to_how_much_nearer_the_window_came() -> None:
    steps = low_level_steps(episode(), LowLevelReward("dense", ENV.subgoals, RULES))
    # a step of 0.1 toward the subgoal is 0.05 of the bounds' width; the last one also reaches it in time
    np.testing.assert_allclose(steps.rewards, [0.05, 0.05, 0.05, 0.05, 1.05], atol=1e-6)
    np.testing.assert_array_equal(steps.dones, [False, False, True, False, True])
    reward = LowLevelReward("dense", ENV.subgoals, RULES)
    np.testing.assert_allclose(reward.completion(np.array([[1.0], [-1.0], [0.5]]), np.ones((3, 1))), [1, 0, 0.75])
    with pytest.raises(ValueError, match="low_reward must be one of 'sparse', 'dense', 'step', got 'dence'"):
        LowLevelReward("dence", ENV.subgoals, RULES)


def test_per_step_reward_ends_where_the_subgoal_is_reached_and_only_there() -> None:
    steps = low_level_steps(episode(), LowLevelReward("step", ENV.subgoals, RULES))
    np.testing.assert_array_equal(steps.rewards, [-1, -1, -1, -1, 0])
    np.testing.assert_array_equal(steps.dones, [False, False, False, False, True])  # running out of time is no end


@pytest.mark.parametrize(("end", "relabelled"), [(1.04, True), (1.2, False)])
def test_hindsight_options_must_end_within_the_tolerance(end: float, relabelled: bool) -> None:
    """The nearest subgoal to a point outside of the bounds is the bound: 1.04 is 0.04 away in unit coordinates."""
    moved = episode()
    moved.achieved_goal[3] = end
    actions, changed = relabel_actions(moved, ENV.subgoals, RULES, np.random.default_rng(0), tolerance=0.05)
    np.testing.assert_array_equal(changed, [relabelled, False])
    assert actions[0, 0] == pytest.approx(1.0 if relabelled else 0.9)
    reward = HighLevelReward("decision", 0.9, dt_ref=2.0, dt_max=4.0, decision_cost=0.0, duration_cost=0.0)
    settings = HindsightSettings(0, "future", -5.0, keep_original=False, tolerance=0.05)
    steps = high_level_steps(moved, LAYOUT, RULES, reward, settings, GOALS, np.random.default_rng(0))
    # the failed test is penalised; without a hindsight action it is not also stored as if nothing had been wrong
    assert steps.rewards.tolist() == ([-5.0, -1.0, 0.0] if relabelled else [-5.0, 0.0])


def test_hindsight_success_is_a_distance_in_unit_coordinates() -> None:
    reached = np.array([[0.03, 0.04], [0.03, 0.041], [0.0, 0.0]])
    np.testing.assert_array_equal(hindsight_success(reached, np.zeros((3, 2))), [True, False, True])


def test_originals_are_kept_beside_their_hindsight_copies() -> None:
    options = (option(0, 3, 0.9, 2.5, False, False), option(3, 2, 0.5, 1.5, False, True))
    reward = HighLevelReward(
        "decision", 0.9, dt_ref=2.0, dt_max=4.0, decision_cost=0.0, duration_cost=0.0, completion_bonus=0.25
    )
    settings = HindsightSettings(0, "future", -5.0, keep_original=True)
    steps = high_level_steps(
        episode()._replace(options=options), LAYOUT, RULES, reward, settings, GOALS,
        np.random.default_rng(0),
    )  # fmt: skip
    np.testing.assert_allclose(steps.actions[:, 0], [0.9, 0.3, 0.5])  # as chosen, as it turned out, as it was reached
    np.testing.assert_allclose(steps.rewards, [-1.0, -1.0 + 0.25, 0.0 + 0.25])  # only what was completed has the bonus
    np.testing.assert_array_equal(steps.relabelled, [False, True, False])
    np.testing.assert_allclose(steps.here[:, 0], [0.0, 0.0, 0.3])  # where each option began


def test_goals_of_an_event() -> None:
    """The flag, the third entry of the observation, is set when the first option ends."""
    own = ENV.subgoals
    with pytest.raises(ValueError, match="names none"):
        check_goal_strategy("event", own)
    with pytest.raises(ValueError, match="names none"):
        check_goal_strategy("event", None)
    maps = own.achieved, own.local
    subgoals = SubgoalSpace([-1.0], [1.0], [0.05], *maps, [1.0, 50.0, 100.0], ["position"], event=2)
    check_goal_strategy("event", subgoals)
    options = np.arange(2)
    np.testing.assert_array_equal(
        goal_pairs(2, 3, "event", np.random.default_rng(0), 0), np.stack([options, [0, 0]], 1)
    )
    assert goal_pairs(2, 3, "event", np.random.default_rng(0)).shape == (0, 2)
    assert np.issubdtype(goal_pairs(2, 3, "event", np.random.default_rng(0)).dtype, np.integer)
    flags = episode().observation.copy()
    flags[:, 2] = [0, 0, 0, 1, 0, 0]
    reward = HighLevelReward("decision", 0.9, dt_ref=2.0, dt_max=4.0, decision_cost=0.0, duration_cost=0.0)
    settings = HindsightSettings(3, "event", -5.0, keep_original=False)

    def steps(of: Episode) -> HighLevelSteps:
        return high_level_steps(
            of, LAYOUT._replace(subgoals=subgoals), RULES, reward, settings, GOALS, np.random.default_rng(0)
        )

    happened = steps(episode()._replace(observation=flags))
    np.testing.assert_allclose(happened.observations[-2:, 0], 0.3)  # both get the goal that the first option met
    np.testing.assert_array_equal(happened.dones[-2:], [True, False])
    flags[:, 2] = 0
    assert len(steps(episode()._replace(observation=flags)).rewards) == len(happened.rewards) - 2


@pytest.mark.parametrize("goals_met", ["passing", "end"])
@pytest.mark.parametrize(
    ("terminated", "success", "over"), [(True, False, True), (True, True, False), (False, False, False)]
)
def test_a_failure_ends_with_any_goal(goals_met: str, terminated: bool, success: bool, over: bool) -> None:
    """The last option stays as it ended; the success of another goal would not have ended the episode."""
    reward = HighLevelReward("smdp", 0.9, dt_ref=2.0, dt_max=4.0, decision_cost=1.0, duration_cost=0.0)
    settings = HindsightSettings(40, "episode", -5.0, keep_original=False, goals_met=goals_met)
    of, rng = episode()._replace(terminated=terminated, success=success), np.random.default_rng(0)
    steps = high_level_steps(of, LAYOUT, RULES, reward, settings, GOALS, rng)
    copies = np.arange(len(steps.dones)) > 2  # behind a failed test and the two options
    elsewhere = copies & np.isclose(steps.observations[:, 0], 0.3)  # a goal that only the first option met
    last = np.isclose(steps.observations[:, 1], 0.3)
    assert {*steps.dones[elsewhere & last]} == {over}
    assert {*steps.dones[elsewhere & ~last]} == {True}
    assert {*steps.dones[copies & ~elsewhere & ~last]} == {False}


def test_decisions_meet_hindsight_goals_at_their_end() -> None:
    """With a reward per decision a goal that the window only passes is not met, whatever ``goals_met`` says."""
    there_and_on = np.array([0.0, 0.2, 0.5, 0.3, 0.4, 0.2])
    rows = np.stack([there_and_on, np.arange(6.0), np.ones(6)], axis=1).astype(np.float32)
    wandering = episode()._replace(observation=rows, achieved_goal=there_and_on[:, None], desired_goal=np.ones((6, 1)))
    reward = HighLevelReward("decision", 0.9, dt_ref=2.0, dt_max=4.0, decision_cost=0.0, duration_cost=0.0)
    settings = HindsightSettings(1, "future", -5.0, keep_original=False, goals_met="passing")
    rng = np.random.default_rng(0)
    steps = high_level_steps(wandering, LAYOUT, RULES, reward, settings, GOALS, rng)
    assert not steps.dones[-1]
    assert steps.durations[-1] == 3


def test_copies_with_hindsight_goals_have_the_bonus_and_keep_their_types() -> None:
    reward = HighLevelReward(
        "smdp", 1.0, dt_ref=2.0, dt_max=4.0, decision_cost=1.0, duration_cost=0.0, completion_bonus=0.25
    )
    settings = HindsightSettings(1, "future", -5.0, keep_original=False)
    rng = np.random.default_rng(0)
    steps = high_level_steps(episode(), LAYOUT, RULES, reward, settings, GOALS, rng)
    assert steps.rewards[-1] == pytest.approx(-3 / 2 - 1 + 0.25)  # three steps to 0.3, on the way to 0.5
    assert steps.dones.dtype == bool
    assert np.issubdtype(steps.durations.dtype, np.integer)
    goals = relabel_goals(episode(), np.array([0]), np.array([3]), np.array([[0.2]]), reward, GOALS, at_end=False)
    assert np.issubdtype(goals.durations.dtype, np.integer)


def test_the_tolerance_of_hindsight_is_the_one_given() -> None:
    moved = episode()
    moved.achieved_goal[3] = 1.2
    for tolerance, relabelled in ((0.3, True), (0.1, False)):
        actions, changed = relabel_actions(moved, ENV.subgoals, RULES, np.random.default_rng(0), tolerance)
        np.testing.assert_array_equal(changed, [relabelled, False])
        assert actions[0, 0] == pytest.approx(1.0 if relabelled else 0.9)
