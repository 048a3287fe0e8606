"""The wrapper against a hand-rolled loop: windows, ends, resets, and what episodes record."""

from __future__ import annotations

import re
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from corridor import Corridor
from hypothesis import given, settings
from hypothesis import strategies as st
from stable_baselines3 import PPO
from stable_baselines3.common.monitor import Monitor
from stable_baselines3.common.vec_env import DummyVecEnv

from sb3_tbc.errors import HierarchyError, NonFiniteError
from sb3_tbc.smdp.hierarchical_vec_env import HierarchicalVecEnv, Proposal
from sb3_tbc.smdp.hindsight import low_level_steps
from sb3_tbc.smdp.options import OptionRules, TerminationReason
from sb3_tbc.smdp.rewards import HighLevelReward, LowLevelReward, discounted_sums
from sb3_tbc.smdp.views import LevelViews


class RandomHighLevel:
    """Proposes random options and keeps count of who asked."""

    def __init__(self, seed: int) -> None:
        self.rng = np.random.default_rng(seed)
        self.asked: list[np.ndarray] = []

    def __call__(self, observations: np.ndarray, where: np.ndarray) -> Proposal:
        assert len(observations) == len(where)
        self.asked.append(np.array(where))
        return Proposal(self.rng.uniform(-1, 1, (len(where), 2)), self.rng.random(len(where)) < 0.3)


def make(n_envs: int, seed: int, goal: float | None = None, limit: int = 50, **rules: Any) -> HierarchicalVecEnv:
    venv = DummyVecEnv([lambda: Monitor(Corridor(limit, goal)) for _ in range(n_envs)])
    venv.seed(seed)
    subgoals = venv.get_attr("subgoals")[0]
    defaults = {"dt_max": 10.0, "max_options": 7}
    return HierarchicalVecEnv(
        venv, RandomHighLevel(seed), LevelViews(subgoals, True), OptionRules(**{**defaults, **rules})
    )


def run(env: HierarchicalVecEnv, steps: int, seed: int) -> tuple[list[Any], np.ndarray, int]:
    """Random actions; all finished episodes, done flags per step, and low-level rewards given."""
    rng = np.random.default_rng(seed)
    env.reset()
    episodes, flags, rewarded = [], [], 0.0
    for _ in range(steps):
        step = env.advance(rng.uniform(-1, 1, (env.num_envs, 1)).astype(np.float32))
        assert all(("option" in info) == bool(over) for info, over in zip(step.infos, step.window_over, strict=True))
        assert set(step.episodes) == set(np.flatnonzero(step.episode_over))
        flags.append(step.window_over)
        rewarded += step.rewards.sum()
        episodes += step.episodes.values()
    return episodes, np.array(flags), int(rewarded)


@settings(max_examples=15, deadline=None)
@given(
    n_envs=st.integers(1, 4),
    seed=st.integers(0, 1000),
    dt_max=st.floats(1.0, 20.0),
    window_end=st.sampled_from(["timed", "reached"]),
)
def test_every_step_belongs_to_exactly_one_option(n_envs: int, seed: int, dt_max: float, window_end: str) -> None:
    episodes, _, _ = run(make(n_envs, seed, dt_max=dt_max, window_end=window_end), 150, seed)
    assert episodes
    for episode in episodes:
        position = 0
        for option in episode.options:
            assert option.start == position
            assert 1 <= option.duration <= max(1, np.ceil(option.time_budget))
            position += option.duration
        assert position == episode.length == len(episode.actions)
        assert len(episode.options) <= 7
        # nothing of another episode or environment: the corridor counts its own steps, and one serial number is kept
        assert np.array_equal(episode.observation[:, 1], np.arange(episode.length + 1))
        assert len(set(episode.observation[:, 2])) == 1
        place = episode.observation[:, 0]
        np.testing.assert_allclose(place[1:], np.clip(place[:-1] + 0.1 * episode.actions[:, 0], -1, 1), atol=1e-6)


@settings(max_examples=15, deadline=None)
@given(seed=st.integers(0, 1000), gamma=st.floats(0.5, 1.0))
def test_discounted_option_reward_equals_hand_rolled_sum(seed: int, gamma: float) -> None:
    episodes, _, _ = run(make(2, seed), 120, seed)
    for episode in episodes:
        starts = np.array([o.start for o in episode.options])
        durations = np.array([o.duration for o in episode.options])
        by_hand = [sum(gamma**j * episode.rewards[o.start + j] for j in range(o.duration)) for o in episode.options]
        np.testing.assert_allclose(discounted_sums(episode.rewards, starts, durations, gamma), by_hand, atol=1e-9)


def test_smdp_reward_and_discount_follow_the_executed_length() -> None:
    reward = HighLevelReward("smdp", 0.9, dt_ref=5.0, dt_max=10.0, decision_cost=1.0, duration_cost=0.0)
    step = 0.9 ** (1 / 5)
    rewards = np.array([-1.0, -1.0, -1.0, 0.0])
    value = reward.window_rewards(rewards, np.array([0, 3]), np.array([3, 1]))
    np.testing.assert_allclose(value, [-(1 + step + step**2) / 5 - 1, -1])
    np.testing.assert_allclose(reward.discounts(np.array([5, 1])), [0.9, step])


def test_window_runs_ceil_of_its_budget_when_timed() -> None:
    episodes, _, _ = run(make(3, 1, window_end="timed", goal=5.0), 200, 1)
    for episode in episodes:
        for option in episode.options[:-1]:
            assert option.duration == max(1, int(np.ceil(option.time_budget)))
            assert option.reason in (TerminationReason.EXPIRED, TerminationReason.REACHED)


def test_reached_ends_a_window_but_not_before_dt_min() -> None:
    free, _, _ = run(make(2, 3, window_end="reached", goal=5.0, max_options=1000), 400, 3)
    held, _, _ = run(make(2, 3, window_end="reached", goal=5.0, max_options=1000, dt_min=4.0), 400, 3)
    short = [o for e in free for o in e.options if o.reached and o.duration < np.ceil(o.time_budget)]
    assert short, "some window should have ended early"
    assert min(o.duration for e in held for o in e.options[:-1]) >= 4


def to_the_right(env: HierarchicalVecEnv) -> Any:
    """The first episode of an agent that always goes right."""
    env.reset()
    while True:
        step = env.advance(np.ones((1, 1), np.float32))
        if step.episodes:
            return step.episodes[0]


def test_truncation_and_termination_are_told_apart() -> None:
    success = to_the_right(make(1, 0, goal=0.3, limit=50))
    assert success.terminated
    assert success.success
    assert success.length == 3
    cut = to_the_right(make(1, 0, goal=5.0, limit=12, max_options=50))
    assert not cut.terminated
    assert not cut.success
    assert cut.length == 12


def test_used_up_action_budget_ends_the_episode_as_a_failure() -> None:
    env = make(2, 0, goal=5.0, limit=10_000, max_options=3)
    episodes, _, _ = run(env, 100, 0)
    assert all(len(e.options) == 3 and not e.terminated and not e.success for e in episodes)
    assert env.venv.get_attr("steps")[0] < 31  # the environments really were reset


def test_only_environments_whose_window_ended_ask_for_an_option() -> None:
    env = make(3, 5)
    _, flags, _ = run(env, 80, 5)
    asked = env.high_level.asked  # type: ignore[union-attr]
    assert len(asked[0]) == 3
    assert [list(a) for a in asked[1:]] == [list(np.flatnonzero(row)) for row in flags if row.any()]


def test_low_level_reward_is_paid_once_per_reached_window() -> None:
    env = make(2, 7, goal=5.0, limit=40, max_options=1000)
    episodes, _, rewarded = run(env, 200, 7)
    unfinished = env._recorder.options
    reached = sum(o.reached for e in episodes for o in e.options) + sum(o.reached for os in unfinished for o in os)
    assert reached == rewarded > 0


def test_stepping_before_reset_says_so() -> None:
    with pytest.raises(HierarchyError, match="before reset"):
        make(1, 0).step(np.zeros((1, 1), np.float32))


def test_environment_without_goals_is_refused() -> None:
    import gymnasium as gym

    venv = DummyVecEnv([lambda: gym.make("MountainCarContinuous-v0")])
    views = LevelViews(Corridor().subgoals, True)
    with pytest.raises(ValueError, match="goal environment"):
        HierarchicalVecEnv(venv, None, views, OptionRules(5.0))


@pytest.mark.parametrize(
    ("kwargs", "message"),
    [
        ({"dt_max": 5.0, "dt_min": 6.0}, "dt_min"),
        ({"dt_max": 0.5}, "at least one"),
        ({"dt_max": 5.0, "max_options": 0}, "max_options"),
        ({"dt_max": 5.0, "max_options": 2.5}, "max_options must be a whole number of at least 1, got 2.5"),
        ({"dt_max": 5.0, "max_options": True}, "max_options"),
        ({"dt_max": np.inf}, "dt_max must be a finite number"),
        ({"dt_max": 5.0, "window_end": "sometimes"}, "sometimes"),
    ],
)
def test_impossible_rules_are_refused(kwargs: dict[str, Any], message: str) -> None:
    with pytest.raises(ValueError, match=message):
        OptionRules(**kwargs)


@pytest.mark.parametrize(
    ("unit", "testing", "error", "message"),
    [
        (np.zeros((1, 2)), np.zeros(2, bool), ValueError, r"2 options need unit actions \(2, 2\).* got \(1, 2\)"),
        (np.zeros((2, 1)), np.zeros(2, bool), ValueError, r"got \(2, 1\)"),
        (np.zeros(2), np.zeros(2, bool), ValueError, r"got \(2,\)"),
        (np.zeros((2, 2)), np.zeros(1, bool), ValueError, r"and testing \(2,\); got \(2, 2\) and \(1,\)"),
        (np.full((2, 2), np.nan), np.zeros(2, bool), NonFiniteError, "time budgets are not finite"),
    ],
)
def test_proposals_that_are_none_are_refused(unit: Any, testing: Any, error: type[Exception], message: str) -> None:
    """NumPy would spread a row over all environments; a window whose budget is NaN would never end."""
    views, venv = LevelViews(Corridor().subgoals, True), DummyVecEnv([Corridor, Corridor])
    env = HierarchicalVecEnv(venv, lambda *_: Proposal(unit, testing), views, OptionRules(5.0))
    with pytest.raises(error, match=message):
        env.reset()


def test_a_subgoal_reached_as_the_task_succeeds_counts_as_reached() -> None:
    """One step is both: the high level's test passes, as the low level's step earns its reward."""
    space = Corridor().subgoals
    env = HierarchicalVecEnv(
        DummyVecEnv([lambda: Corridor(goal=0.3)]),
        lambda seen, where: Proposal(np.array([[0.3, 1.0]]), np.ones(1, bool)),
        LevelViews(space),
        OptionRules(10.0, window_end="reached"),
    )
    episode = to_the_right(env)
    (option,) = episode.options
    assert episode.terminated
    assert option.reached
    assert option.reason is TerminationReason.REACHED
    low = low_level_steps(episode, LowLevelReward("sparse", space, env.rules))
    assert low.rewards[-1] == 1.0


@settings(max_examples=20, deadline=None)
@given(seed=st.integers(0, 1000), window_end=st.sampled_from(["timed", "reached"]), dt_min=st.floats(0.0, 4.0))
def test_both_levels_agree_on_what_was_reached(seed: int, window_end: str, dt_min: float) -> None:
    env = make(2, seed, limit=25, window_end=window_end, dt_min=dt_min)
    episodes, _, _ = run(env, 150, seed)
    for episode in episodes:
        low = low_level_steps(episode, LowLevelReward("sparse", env.views.subgoals, env.rules))
        ends = [option.start + option.duration - 1 for option in episode.options]
        assert [bool(low.rewards[end]) for end in ends] == [option.reached for option in episode.options]
        cut = [o.reason in (TerminationReason.EPISODE_END, TerminationReason.EVENT) for o in episode.options]
        assert [bool(low.dones[end]) for end in ends] == [not c for c in cut]


def test_sb3s_algorithms_learn_the_low_levels_problem() -> None:
    env = make(2, 0, goal=5.0, limit=23)
    PPO("MlpPolicy", env, n_steps=64, n_epochs=1, batch_size=32).learn(256)
    env.reset()
    kinds = set()
    for _ in range(60):
        _, _, over, infos = env.step(np.zeros((2, 1), np.float32))
        for index in np.flatnonzero(over):
            last = infos[index]["terminal_observation"]
            assert env.observation_space.contains(last)
            cut = infos[index]["option"]["reason"] == "episode_end"
            assert infos[index]["TimeLimit.truncated"] == cut
            kinds.add(cut)
            assert cut == (last[-1] > 0)  # time was left when it was cut off
    assert kinds == {True, False}


def test_the_pages_example_of_a_low_level_runs() -> None:
    page = (Path(__file__).parents[2] / "docs" / "your_task.md").read_text(encoding="utf-8")
    (code,) = re.findall(
        r"```python\n(.*?)```", page.partition("## Another algorithm as the low level\n")[2], re.DOTALL
    )
    found: dict[str, Any] = {}
    exec(code.replace("learn(50_000)", "learn(128)"), found)
    assert found["low"].num_timesteps == 128
    assert found["low"].observation_space == found["venv"].observation_space
