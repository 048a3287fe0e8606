"""What the replay buffers sample, worked by hand on one short episode."""

from __future__ import annotations

import numpy as np
import pytest
from two_windows import ENV, GOALS, LAYOUT, RULES, SPARSE, episode, low_buffer

from sb3_tbc.replay.buffers import OptionReplayBuffer, SubgoalReplayBuffer
from sb3_tbc.smdp.hindsight import (
    HindsightSettings,
    high_level_steps,
    low_level_steps,
)
from sb3_tbc.smdp.options import OptionRules
from sb3_tbc.smdp.rewards import HighLevelReward, LowLevelReward


def test_relabelled_low_level_samples_are_consistent() -> None:
    buffer = low_buffer(100, hindsight=1e9)
    buffer.extend(low_level_steps(episode(), SPARSE))
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
    buffer.extend(
        low_level_steps(still._replace(achieved_goal=np.zeros((6, 1))), LowLevelReward("sparse", ENV.subgoals, rules))
    )
    batch = buffer.sample_burst(1, 500)
    step, left = batch.observations[0, :, 1].numpy(), batch.observations[0, :, 4].numpy() * rules.dt_max
    within = np.where(step < 3, step, step - 3)  # steps since the window began
    over = (left <= 1.0) | (within + 1 >= rules.dt_min)
    assert 0 < over.sum() < len(over)
    np.testing.assert_array_equal(batch.dones[0, :, 0].numpy(), over)
    np.testing.assert_array_equal(batch.rewards[0, :, 0].numpy(), over)


def test_relabelled_remaining_time_is_whole_where_budgets_are() -> None:
    rules = OptionRules(dt_max=4.0, max_options=5, whole_budgets=True)
    buffer = low_buffer(100, hindsight=1e9, rules=rules)
    buffer.extend(low_level_steps(episode(), LowLevelReward("sparse", ENV.subgoals, rules)))
    observations = buffer.sample_burst(1, 500).observations[0].numpy()
    position, subgoal, left = observations[:, 0], observations[:, 3], observations[:, 4] * rules.dt_max
    np.testing.assert_allclose(left, np.rint((subgoal - position) / 0.1), atol=1e-5)


def test_plain_low_level_samples_are_what_was_stored() -> None:
    buffer = low_buffer(100, hindsight=0)
    buffer.extend(low_level_steps(episode(), SPARSE))
    batch = buffer.sample_burst(2, 50)
    assert batch.observations.shape == (2, 50, 5)
    assert np.round(batch.observations[..., 3].unique().numpy(), 5).tolist() == pytest.approx([0.5, 0.9])
    assert batch.next_states.min() == 1
    assert batch.states.max() == 0


def test_ring_never_mixes_windows_after_wrapping() -> None:
    buffer = low_buffer(13, hindsight=1e9)  # 5 rows at a time: windows get cut by the write position
    for _ in range(7):
        buffer.extend(low_level_steps(episode(), SPARSE))
        batch = buffer.sample_burst(1, 500)
        position, subgoal = batch.observations[0, :, 0].numpy(), batch.observations[0, :, 3].numpy()
        untouched = np.isclose(subgoal, 0.9) | (np.isclose(subgoal, 0.5) & (position > 0.25))
        within = np.where(position < 0.25, subgoal < 0.35, subgoal > 0.35)
        assert (untouched | within).all()
    assert buffer.size() == 13


def test_a_full_ring_relabels_its_newest_window_too() -> None:
    buffer = low_buffer(10, hindsight=1e9)  # two episodes fit to the row
    steps = low_level_steps(episode(), SPARSE)
    for _ in range(3):
        buffer.extend(steps._replace(subgoal=np.full_like(steps.subgoal, 0.9)))
    assert buffer.sample_burst(1, 500).observations[..., 3].max() < 0.65  # 0.9 was asked for, 0.5 reached at most


def test_option_buffer_gives_sb3_samples_with_discounts() -> None:
    buffer = OptionReplayBuffer(50, LAYOUT.high_space(ENV.observation_space), LAYOUT.high_action_space(), seed=0)
    reward = HighLevelReward("smdp", 0.9, dt_ref=2.0, dt_max=4.0, decision_cost=1.0, duration_cost=0.0)
    settings = HindsightSettings(0, "future", -5.0, keep_original=True)
    buffer.extend(high_level_steps(episode(), LAYOUT, RULES, reward, settings, GOALS, np.random.default_rng(0)))
    sample = buffer.sample(64)
    np.testing.assert_allclose(sample.discounts.unique().numpy(), [0.9**1.5, 0.9], rtol=1e-6)
    with pytest.raises(TypeError, match="extend"):
        buffer.add()


def test_buffer_state_round_trip_and_mismatch() -> None:
    buffer, other = low_buffer(13, 3), low_buffer(13, 3)
    for _ in range(3):
        buffer.extend(low_level_steps(episode(), SPARSE))
    other.set_state({k: v.copy() for k, v in buffer.get_state().items()})
    assert (other.pos, other.full) == (buffer.pos, buffer.full)
    for name in buffer.data:
        np.testing.assert_array_equal(other.data[name], buffer.data[name])
    state = buffer.get_state()
    state["subgoal"] = np.zeros((13, 7))
    with pytest.raises(ValueError, match="subgoal has width 1"):
        other.set_state(state)
    with pytest.raises(ValueError, match="does not fit"):
        low_buffer(3, 1).extend(low_level_steps(episode(), SPARSE))


def test_rows_that_just_fill_a_smaller_buffer_stay() -> None:
    old, new = low_buffer(13, 3), low_buffer(5, 3)
    steps = low_level_steps(episode(), SPARSE)
    assert steps.local.shape[0] == 5
    old.extend(steps)
    new.set_state(old.get_state())
    assert (new.size(), new.full, new.pos) == (5, True, 0)


@pytest.mark.parametrize("more", [0, 5])
def test_a_full_ring_goes_on_in_a_larger_one(more: int) -> None:
    """Episodes are told apart by their serial number; what was sampled of a window belongs to it."""
    old, new = (low_buffer(size, 1e9, sequence_length=3, reach_pairs=True) for size in (13, 13 + more))
    steps = low_level_steps(episode(), SPARSE)
    marked = [steps._replace(local=steps.local * 0 + n, states=steps.states * 0 + n) for n in range(1, 8)]
    for part in marked[:6]:
        old.extend(part)
    new.set_state(old.get_state())
    assert (old.pos, new.size(), new.full) == (4, 13, not more)
    for serials in ({4.0, 5.0, 6.0}, {4.0, 5.0, 6.0, 7.0} if more else {5.0, 6.0, 7.0}):
        at, where, second = new._timed(np.arange(13).repeat(40))
        assert len(where) > 300
        np.testing.assert_array_equal(new.data["local"][at[where], 0], new.data["local"][second, 0])
        batch = new.sample_burst(1, 500)
        assert set(batch.observations[0, :, 0].tolist()) == serials
        np.testing.assert_array_equal(batch.states[0, :, 0], batch.observations[0, :, 0])  # before what is unrolled
        pairs = new.sample_pairs(500, 4, np.random.default_rng(0))
        np.testing.assert_allclose((pairs.goal - pairs.here)[:, 0], 0.1 * pairs.steps, atol=1e-6)
        new.extend(marked[6])


def test_dense_reward_of_relabelled_steps() -> None:
    buffer = low_buffer(100, 1e9, reward=LowLevelReward("dense", ENV.subgoals, RULES))
    buffer.extend(low_level_steps(episode(), SPARSE))
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
    buffer.extend(low_level_steps(episode(), reward))
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


def test_samples_hold_the_steps_before_them_of_their_window() -> None:
    buffer = low_buffer(100, hindsight=0, sequence_length=3)
    steps = low_level_steps(episode(), SPARSE)
    buffer.extend(steps._replace(states=np.arange(5.0)[:, None] * np.ones((5, 2))))
    batch = buffer.sample_burst(1, 200)
    observations, earlier = batch.observations[0].numpy(), batch.earlier[0].view(200, 2, 1 + 5).numpy()
    row = np.rint(observations[:, 0] / 0.1).astype(int)
    before = np.array([0, 1, 2, 0, 1])[row]  # steps of the window that came before
    np.testing.assert_array_equal(earlier[..., 0], np.stack([before >= 2, before >= 1], axis=1))
    one, two = earlier[before >= 1, 1, 1:], earlier[before >= 2, 0, 1:]
    np.testing.assert_allclose(one[:, 0], observations[before >= 1, 0] - 0.1, atol=1e-6)
    np.testing.assert_allclose(two[:, 0], observations[before >= 2, 0] - 0.2, atol=1e-6)
    np.testing.assert_array_equal(batch.states[0, :, 0].numpy(), row - before)  # memory at the first of these steps
    assert (earlier[earlier[..., 0] == 0] == 0).all()


def test_memory_begins_where_the_steps_do() -> None:
    buffer = low_buffer(100, hindsight=0, sequence_length=2)
    steps = low_level_steps(episode(), SPARSE)
    buffer.extend(steps._replace(states=np.arange(5.0)[:, None] * np.ones((5, 2))))
    batch = buffer.sample_burst(1, 200)
    row = np.rint(batch.observations[0, :, 0].numpy() / 0.1).astype(int)
    np.testing.assert_array_equal(batch.states[0, :, 0].numpy(), np.array([0, 0, 1, 3, 3])[row])


def test_without_earlier_steps_the_stored_states_are_sampled() -> None:
    buffer = low_buffer(100, hindsight=0)
    buffer.extend(low_level_steps(episode(), SPARSE))
    batch = buffer.sample_burst(1, 50)
    assert set(batch.states.unique().tolist()) == {0.0}
    assert set(batch.next_states.unique().tolist()) == {1.0}
    assert batch.earlier.shape == (1, 50, 0)


def test_earlier_steps_have_the_sampled_subgoal_and_its_time() -> None:
    buffer = low_buffer(100, hindsight=1e9, sequence_length=2)
    buffer.extend(low_level_steps(episode(), SPARSE))
    batch = buffer.sample_burst(1, 500)
    observations, earlier = batch.observations[0].numpy(), batch.earlier[0].numpy()
    known = earlier[:, 0] == 1
    np.testing.assert_array_equal(known, ~np.isin(np.rint(observations[:, 0] / 0.1), [0, 3]))  # no first steps
    np.testing.assert_allclose(earlier[known, 4], observations[known, 3])
    np.testing.assert_allclose(earlier[known, 5], np.minimum(observations[known, 4] + 0.25, 1.0), atol=1e-6)
    with pytest.raises(ValueError, match="unrolls the low level's memory"):
        SubgoalReplayBuffer(9, LAYOUT.low_space(), ENV.action_space, LAYOUT, RULES, 0, 0.9, 1, sequence_length=2)
