"""Hindsight worked by hand on one short episode."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from corridor import Corridor

from sb3_tbc.replay.buffers import OptionReplayBuffer, SubgoalReplayBuffer
from sb3_tbc.smdp.hindsight import (
    GoalTest,
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
from sb3_tbc.smdp.options import Episode, Option, OptionRules, TerminationReason
from sb3_tbc.smdp.rewards import HighLevelReward, LowLevelReward
from sb3_tbc.smdp.spaces import SubgoalSpace
from sb3_tbc.smdp.views import LevelViews

ENV = Corridor()
RULES = OptionRules(dt_max=4.0, max_options=5)
LAYOUT = LevelViews(ENV.subgoals, True)
GOALS = GoalTest(lambda a, d: ENV.compute_reward(a, d, {}), lambda a, d: ENV.compute_terminated(a, d, {}))


def option(start: int, duration: int, subgoal: float, budget: float, testing: bool, reached: bool) -> Option:
    unit = np.array([subgoal, 2 * budget / 4.0 - 1])
    reason = TerminationReason.REACHED if reached else TerminationReason.EXPIRED
    return Option(start, duration, unit, np.array([subgoal]), budget, testing, reached, reason)


def episode() -> Episode:
    """Two windows to the right, 0 -> 0.3 -> 0.5: the first (3 steps, to 0.9) fails its test, the second reaches 0.5."""
    position = np.array([0.0, 0.1, 0.2, 0.3, 0.4, 0.5])
    rows = np.stack([position, np.arange(6.0), np.ones(6)], axis=1).astype(np.float32)
    return Episode(
        observation=rows,
        achieved_goal=position[:, None],
        desired_goal=np.full((6, 1), 0.5),
        actions=np.ones((5, 1), np.float32),
        states=np.zeros((5, 2), np.float32),
        next_states=np.ones((5, 2), np.float32),
        rewards=np.array([-1.0, -1, -1, -1, 0]),
        options=(option(0, 3, 0.9, 2.5, True, False), option(3, 2, 0.5, 1.5, False, True)),
        terminated=True,
        success=True,
    )


def test_low_level_transitions_of_two_windows() -> None:
    steps = low_level_steps(episode(), ENV.subgoals, RULES)
    np.testing.assert_array_equal(steps.position, [0, 1, 2, 0, 1])
    np.testing.assert_array_equal(steps.length, [3, 3, 3, 2, 2])
    np.testing.assert_array_equal(steps.time_left, [2.5, 1.5, 0.5, 1.5, 0.5])
    np.testing.assert_array_equal(steps.dones, [False, False, True, False, True])
    np.testing.assert_array_equal(steps.rewards, [0, 0, 0, 0, 1])
    np.testing.assert_allclose(steps.achieved[:, 0], [0.1, 0.2, 0.3, 0.4, 0.5])


def test_window_cut_by_the_episode_is_not_over_for_the_low_level() -> None:
    cut = episode()._replace(options=(option(0, 3, 0.9, 2.5, True, False), option(3, 2, -0.5, 3.5, False, False)))
    assert not low_level_steps(cut, ENV.subgoals, RULES).dones[-1]


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
    with pytest.raises(ValueError, match="final"):
        check_goal_strategy("final", ENV.subgoals)


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
    steps = high_level_steps(
        wandering, ENV.subgoals, RULES, reward, settings, GOALS, LAYOUT.high, np.random.default_rng(0)
    )
    assert steps.dones[-1] == met
    assert steps.durations[-1] == (1 if met else 3)


def test_all_high_level_transitions_by_hand() -> None:
    reward = HighLevelReward("decision", 0.9, dt_ref=2.0, dt_max=4.0, decision_cost=0.0, duration_cost=2.0)
    settings = HindsightSettings(n_goals=1, goal_strategy="future", testing_penalty=-5.0, keep_original=False)
    steps = high_level_steps(
        episode(), ENV.subgoals, RULES, reward, settings, GOALS, LAYOUT.high, np.random.default_rng(0)
    )
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
    return high_level_steps(of, ENV.subgoals, RULES, reward, settings, GOALS, LAYOUT.high, np.random.default_rng(0))


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


def low_buffer(size: int, hindsight: float, rules: OptionRules = RULES, **kwargs: Any) -> SubgoalReplayBuffer:
    spaces = LAYOUT.low_space(), ENV.action_space
    return SubgoalReplayBuffer(size, *spaces, LAYOUT, rules, 2, 0.99, hindsight, seed=0, **kwargs)


def test_relabelled_low_level_samples_are_consistent() -> None:
    buffer = low_buffer(100, hindsight=1e9)
    buffer.extend(low_level_steps(episode(), ENV.subgoals, RULES))
    batch = buffer.sample_burst(1, 2000)
    observations, rewards = batch.observations[0].numpy(), batch.rewards[0, :, 0].numpy()
    position, subgoal, left = observations[:, 0], observations[:, 3], observations[:, 4] * RULES.dt_max
    ahead = np.rint((subgoal - position) / 0.1)  # steps from here to the relabelled subgoal
    assert set(ahead) <= {1.0, 2.0, 3.0}
    assert ((position < 0.25) | (ahead <= 2)).all()  # the second window has two steps
    assert ((position >= 0.25) | (subgoal < 0.35)).all()  # no subgoal from across the window's border
    assert ((left > ahead - 1) & (left <= ahead)).all()
    np.testing.assert_array_equal(rewards, ahead == 1)
    np.testing.assert_array_equal(batch.dones[0, :, 0].numpy(), rewards)
    later = batch.next_observations[0].numpy()
    np.testing.assert_allclose(later[:, 0], position + 0.1, atol=1e-6)
    np.testing.assert_array_equal(later[:, 3], subgoal)  # the next step is asked for the same
    np.testing.assert_allclose(later[:, 4] * RULES.dt_max, np.maximum(left - 1, 0), atol=1e-6)


@pytest.mark.parametrize("kind", ["sparse", "dense"])
def test_relabelled_windows_do_not_end_before_dt_min(kind: str) -> None:
    """A point that stands still is at its subgoal from the first step on; the window may end from the second on."""
    rules = OptionRules(dt_max=4.0, dt_min=2.0, max_options=5, window_end="reached")
    still = episode()._replace(observation=np.stack([np.zeros(6), np.arange(6.0), np.ones(6)], axis=1))
    buffer = low_buffer(100, hindsight=1e9, rules=rules, reward=LowLevelReward(kind, ENV.subgoals, rules))
    buffer.extend(low_level_steps(still._replace(achieved_goal=np.zeros((6, 1))), ENV.subgoals, rules))
    batch = buffer.sample_burst(1, 500)
    step, left = batch.observations[0, :, 1].numpy(), batch.observations[0, :, 4].numpy() * rules.dt_max
    within = np.where(step < 3, step, step - 3)  # steps since the window began
    over = (left <= 1.0) | (within + 1 >= rules.dt_min)
    assert 0 < over.sum() < len(over)
    np.testing.assert_array_equal(batch.dones[0, :, 0].numpy(), over)
    np.testing.assert_array_equal(batch.rewards[0, :, 0].numpy(), over)


def test_whole_budgets_are_rounded_and_last_as_long_as_they_say() -> None:
    whole = OptionRules(dt_max=4.0, dt_min=0.0, whole_budgets=True)
    np.testing.assert_array_equal(whole.budget(np.array([-1.0, -0.6, -0.3, 0.1, 0.3, 1.0])), [1, 1, 1, 2, 3, 4])
    steps = np.repeat([1.0, 2.0, 3.0, 4.0], 500)
    unit = whole.unit_budget(whole.budget_that_lasted(steps, np.random.default_rng(0)))
    np.testing.assert_array_equal(whole.budget(unit), steps)
    fractional = OptionRules(dt_max=4.0)
    lasted = fractional.budget(fractional.unit_budget(fractional.budget_that_lasted(steps, np.random.default_rng(0))))
    np.testing.assert_array_equal(np.ceil(lasted), steps)


def test_relabelled_remaining_time_is_whole_where_budgets_are() -> None:
    rules = OptionRules(dt_max=4.0, max_options=5, whole_budgets=True)
    buffer = low_buffer(100, hindsight=1e9, rules=rules)
    buffer.extend(low_level_steps(episode(), ENV.subgoals, rules))
    observations = buffer.sample_burst(1, 500).observations[0].numpy()
    position, subgoal, left = observations[:, 0], observations[:, 3], observations[:, 4] * rules.dt_max
    np.testing.assert_allclose(left, np.rint((subgoal - position) / 0.1), atol=1e-5)


def test_plain_low_level_samples_are_what_was_stored() -> None:
    buffer = low_buffer(100, hindsight=0)
    buffer.extend(low_level_steps(episode(), ENV.subgoals, RULES))
    batch = buffer.sample_burst(2, 50)
    assert batch.observations.shape == (2, 50, 5)
    assert np.round(batch.observations[..., 3].unique().numpy(), 5).tolist() == pytest.approx([0.5, 0.9])
    assert batch.next_states.min() == 1
    assert batch.states.max() == 0


def test_ring_never_mixes_windows_after_wrapping() -> None:
    buffer = low_buffer(13, hindsight=1e9)  # 5 rows at a time: windows get cut by the write position
    for _ in range(7):
        buffer.extend(low_level_steps(episode(), ENV.subgoals, RULES))
        batch = buffer.sample_burst(1, 500)
        position, subgoal = batch.observations[0, :, 0].numpy(), batch.observations[0, :, 3].numpy()
        untouched = np.isclose(subgoal, 0.9) | (np.isclose(subgoal, 0.5) & (position > 0.25))
        within = np.where(position < 0.25, subgoal < 0.35, subgoal > 0.35)
        assert (untouched | within).all()
    assert buffer.size() == 13


def test_option_buffer_gives_sb3_samples_with_discounts() -> None:
    buffer = OptionReplayBuffer(50, LAYOUT.high_space(ENV.observation_space), LAYOUT.high_action_space(), seed=0)
    reward = HighLevelReward("smdp", 0.9, dt_ref=2.0, dt_max=4.0, decision_cost=1.0, duration_cost=0.0)
    settings = HindsightSettings(0, "future", -5.0, keep_original=True)
    buffer.extend(
        high_level_steps(episode(), ENV.subgoals, RULES, reward, settings, GOALS, LAYOUT.high, np.random.default_rng(0))
    )
    sample = buffer.sample(64)
    np.testing.assert_allclose(sample.discounts.unique().numpy(), [0.9**1.5, 0.9], rtol=1e-6)
    with pytest.raises(TypeError, match="extend"):
        buffer.add()


def test_buffer_state_round_trip_and_mismatch() -> None:
    buffer, other = low_buffer(13, 3), low_buffer(13, 3)
    for _ in range(3):
        buffer.extend(low_level_steps(episode(), ENV.subgoals, RULES))
    other.set_state({k: v.copy() for k, v in buffer.get_state().items()})
    assert (other.pos, other.full) == (buffer.pos, buffer.full)
    for name in buffer.data:
        np.testing.assert_array_equal(other.data[name], buffer.data[name])
    state = buffer.get_state()
    state["subgoal"] = np.zeros((13, 7))
    with pytest.raises(ValueError, match="subgoal has width 1"):
        other.set_state(state)
    with pytest.raises(ValueError, match="does not fit"):
        low_buffer(3, 1).extend(low_level_steps(episode(), ENV.subgoals, RULES))


def test_dense_reward_adds_up_to_how_much_nearer_the_window_came() -> None:
    steps = low_level_steps(episode(), ENV.subgoals, RULES, LowLevelReward("dense", ENV.subgoals, RULES))
    # a step of 0.1 toward the subgoal is 0.05 of the bounds' width; the last one also reaches it in time
    np.testing.assert_allclose(steps.rewards, [0.05, 0.05, 0.05, 0.05, 1.05], atol=1e-6)
    np.testing.assert_array_equal(steps.dones, [False, False, True, False, True])
    reward = LowLevelReward("dense", ENV.subgoals, RULES)
    np.testing.assert_allclose(reward.completion(np.array([[1.0], [-1.0], [0.5]]), np.ones((3, 1))), [1, 0, 0.75])
    with pytest.raises(ValueError, match="low_reward must be one of 'sparse', 'dense', 'step', got 'dence'"):
        LowLevelReward("dence", ENV.subgoals, RULES)


def test_per_step_reward_ends_where_the_subgoal_is_reached_and_only_there() -> None:
    steps = low_level_steps(episode(), ENV.subgoals, RULES, LowLevelReward("step", ENV.subgoals, RULES))
    np.testing.assert_array_equal(steps.rewards, [-1, -1, -1, -1, 0])
    np.testing.assert_array_equal(steps.dones, [False, False, False, False, True])  # running out of time is no end


def test_dense_reward_of_relabelled_steps() -> None:
    buffer = low_buffer(100, 1e9, reward=LowLevelReward("dense", ENV.subgoals, RULES))
    buffer.extend(low_level_steps(episode(), ENV.subgoals, RULES))
    batch = buffer.sample_burst(1, 500)
    ahead = np.rint((batch.observations[0, :, 3] - batch.observations[0, :, 0]).numpy() / 0.1)
    np.testing.assert_allclose(batch.rewards[0, :, 0].numpy(), 0.05 + (ahead == 1), atol=1e-6)


@pytest.mark.parametrize("strategy", ["future", "episode"])
def test_untimed_goals_come_from_the_same_window(strategy: str) -> None:
    layout = LAYOUT._replace(remaining_time=False, timed_actions=False)
    reward = LowLevelReward("step", ENV.subgoals, RULES)
    buffer = SubgoalReplayBuffer(
        100, layout.low_space(), ENV.action_space, layout, RULES, 2, 0.99, 3, seed=0, reward=reward, hindsight=strategy
    )
    buffer.extend(low_level_steps(episode(), ENV.subgoals, RULES, reward))
    batch = buffer.sample_burst(1, 20_000)
    assert batch.observations.shape == (1, 20_000, 4)  # position, steps, serial, subgoal: no time
    row = np.rint(batch.observations[0, :, 0].numpy() / 0.1).astype(int)
    goal = batch.observations[0, :, 3].numpy().round(1)
    drawn = {r: sorted(set(goal[row == r].tolist())) for r in range(5)}
    if strategy == "future":  # strictly later, so the last step of a window keeps its subgoal
        assert drawn[0] == pytest.approx([0.2, 0.3, 0.9])
        assert drawn[1] == pytest.approx([0.3, 0.9])
        assert drawn[2] == pytest.approx([0.9])
        # two goals are there to draw from at the first step, one at the second
        assert np.mean(goal[row == 0] < 0.5) == pytest.approx(2 / 3, abs=0.03)
        assert np.mean(goal[row == 1] < 0.5) == pytest.approx(1 / 2, abs=0.03)
    else:
        assert drawn[0] == drawn[1] == drawn[2] == pytest.approx([0.1, 0.2, 0.3, 0.9])
        assert np.mean(goal[row == 2] < 0.5) == pytest.approx(3 / 4, abs=0.03)
    met = np.abs(goal - 0.1 * (row + 1)) < 0.05
    np.testing.assert_array_equal(batch.rewards[0, :, 0].numpy(), met - 1.0)
    np.testing.assert_array_equal(batch.dones[0, :, 0].numpy(), met)
    with pytest.raises(ValueError, match="hindsight must be one of timed, future, episode"):
        SubgoalReplayBuffer(9, LAYOUT.low_space(), ENV.action_space, LAYOUT, RULES, 2, 0.9, 1, hindsight="final")


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
    steps = high_level_steps(moved, ENV.subgoals, RULES, reward, settings, GOALS, LAYOUT.high, np.random.default_rng(0))
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
        episode()._replace(options=options), ENV.subgoals, RULES, reward, settings, GOALS, LAYOUT.high,
        np.random.default_rng(0),
    )  # fmt: skip
    np.testing.assert_allclose(steps.actions[:, 0], [0.9, 0.3, 0.5])  # as chosen, as it turned out, as it was reached
    np.testing.assert_allclose(steps.rewards, [-1.0, -1.0 + 0.25, 0.0 + 0.25])  # only what was completed has the bonus
    np.testing.assert_array_equal(steps.relabelled, [False, True, False])
    np.testing.assert_allclose(steps.here[:, 0], [0.0, 0.0, 0.3])  # where each option began


def test_burn_in_recomputes_memory_through_the_window() -> None:
    buffer = low_buffer(
        100, hindsight=0, sequence_length=3, advance=lambda observations, states: 0.5 * states + observations[:, :1]
    )
    buffer.extend(low_level_steps(episode(), ENV.subgoals, RULES))
    batch = buffer.sample_burst(1, 200)
    row = np.rint(batch.observations[0, :, 0].numpy() / 0.1).astype(int)
    # state before row 2: 0.5 * (0.5 * 0 + position of row 0) + position of row 1; memory begins anew at row 3
    before, after = np.array([0, 0, 0.1, 0, 0.3]), np.array([0, 0.1, 0.25, 0.3, 0.55])
    np.testing.assert_allclose(batch.states[0, :, 0].numpy(), before[row], atol=1e-6)
    np.testing.assert_allclose(batch.next_states[0, :, 1].numpy(), after[row], atol=1e-6)


def test_burn_in_starts_from_the_stored_state_where_it_is_shorter_than_the_window() -> None:
    steps = low_level_steps(episode(), ENV.subgoals, RULES)
    buffer = low_buffer(100, hindsight=0, sequence_length=2, advance=lambda observations, states: states + 10.0)
    buffer.extend(steps._replace(states=np.arange(5.0)[:, None] * np.ones((5, 2))))
    batch = buffer.sample_burst(1, 200)
    row = np.rint(batch.observations[0, :, 0].numpy() / 0.1).astype(int)
    np.testing.assert_allclose(batch.states[0, :, 0].numpy(), np.array([0, 10, 11, 3, 13])[row])


def test_burn_in_sees_the_sampled_subgoal_and_its_time() -> None:
    buffer = low_buffer(
        100, hindsight=1e9, sequence_length=2, advance=lambda observations, states: observations[:, 3:5]
    )
    buffer.extend(low_level_steps(episode(), ENV.subgoals, RULES))
    batch = buffer.sample_burst(1, 500)
    observations, states = batch.observations[0].numpy(), batch.states[0].numpy()
    later = ~np.isin(np.rint(observations[:, 0] / 0.1), [0, 3])  # not the first step of a window
    np.testing.assert_allclose(states[later, 0], observations[later, 3])
    np.testing.assert_allclose(states[later, 1], np.minimum(observations[later, 4] + 0.25, 1.0), atol=1e-6)
    assert (states[~later] == 0).all()
    with pytest.raises(ValueError, match="recomputes the low level's memory"):
        SubgoalReplayBuffer(9, LAYOUT.low_space(), ENV.action_space, LAYOUT, RULES, 0, 0.9, 1, sequence_length=2)


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
        return high_level_steps(of, subgoals, RULES, reward, settings, GOALS, LAYOUT.high, np.random.default_rng(0))

    happened = steps(episode()._replace(observation=flags))
    np.testing.assert_allclose(happened.observations[-2:, 0], 0.3)  # both get the goal that the first option met
    np.testing.assert_array_equal(happened.dones[-2:], [True, False])
    flags[:, 2] = 0
    assert len(steps(episode()._replace(observation=flags)).rewards) == len(happened.rewards) - 2


def test_decisions_meet_hindsight_goals_at_their_end() -> None:
    """With a reward per decision a goal that the window only passes is not met, whatever ``goals_met`` says."""
    there_and_on = np.array([0.0, 0.2, 0.5, 0.3, 0.4, 0.2])
    rows = np.stack([there_and_on, np.arange(6.0), np.ones(6)], axis=1).astype(np.float32)
    wandering = episode()._replace(observation=rows, achieved_goal=there_and_on[:, None], desired_goal=np.ones((6, 1)))
    reward = HighLevelReward("decision", 0.9, dt_ref=2.0, dt_max=4.0, decision_cost=0.0, duration_cost=0.0)
    settings = HindsightSettings(1, "future", -5.0, keep_original=False, goals_met="passing")
    rng = np.random.default_rng(0)
    steps = high_level_steps(wandering, ENV.subgoals, RULES, reward, settings, GOALS, LAYOUT.high, rng)
    assert not steps.dones[-1]
    assert steps.durations[-1] == 3


def test_copies_with_hindsight_goals_have_the_bonus_and_keep_their_types() -> None:
    reward = HighLevelReward(
        "smdp", 1.0, dt_ref=2.0, dt_max=4.0, decision_cost=1.0, duration_cost=0.0, completion_bonus=0.25
    )
    settings = HindsightSettings(1, "future", -5.0, keep_original=False)
    rng = np.random.default_rng(0)
    steps = high_level_steps(episode(), ENV.subgoals, RULES, reward, settings, GOALS, LAYOUT.high, rng)
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
