"""Time budgets in a corridor, where the true reach time is known: distance / 0.1 steps at full speed."""

from __future__ import annotations

import csv
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from corridor import Corridor
from scipy.stats import spearmanr
from stable_baselines3.common.callbacks import StopTrainingOnMaxEpisodes
from stable_baselines3.common.logger import configure
from two_windows import LAYOUT, low_buffer

from sb3_tbc import TBCHRL
from sb3_tbc.smdp.hindsight import low_level_steps
from sb3_tbc.smdp.options import Episode, Option, OptionRules, TerminationReason
from sb3_tbc.smdp.rewards import LowLevelReward
from sb3_tbc.tbc_hrl.evaluation import evaluate_hierarchical
from sb3_tbc.tbc_hrl.reachability import UPDATE_EVERY, Reachability
from sb3_tbc.tbc_hrl.scheduling import DurationTeacher, FixedWindows, ReachRule

ENV = Corridor()
RULES = OptionRules(dt_max=20.0, dt_min=2.0, max_options=5)
SPARSE = LowLevelReward("sparse", ENV.subgoals, RULES)
LEVEL: dict[str, Any] = {"batch_size": 16, "policy_kwargs": {"net_arch": [8, 8]}}


def reach_time(here: Any, goal: Any) -> Any:
    return np.abs(goal - here)[..., 0] / 0.1


def states(position: Any) -> Any:
    """The corridor's local view of positions ``(n, 1)``."""
    return np.concatenate([position, np.full((len(position), 2), 10.0)], axis=1)


def wandering(rng: np.random.Generator, steps: int = 100) -> Episode:
    """One long window: straight at full speed to one random place after the other, with a pause now and then."""
    position, track, target = 0.0, [0.0], float(rng.uniform(-1, 1))
    for _ in range(steps):
        if abs(target - position) < 0.05:
            target = float(rng.uniform(-1, 1))
        pause = rng.random() < 0.15
        position += 0.0 if pause else float(np.clip(target - position, -0.1, 0.1))
        track.append(position)
    achieved = np.array(track)[:, None]
    window = Option(
        0, steps, np.zeros(2), np.zeros(1), float(steps), testing=False, reached=False, reason=TerminationReason.EXPIRED
    )
    return Episode(
        observation=states(achieved).astype(np.float32),
        achieved_goal=achieved,
        desired_goal=np.full((steps + 1, 1), 0.5),
        actions=np.zeros((steps, 1), np.float32),
        states=np.zeros((steps, 2), np.float32),
        next_states=np.zeros((steps, 2), np.float32),
        rewards=np.full(steps, -1.0),
        options=(window,),
        terminated=False,
        success=False,
    )


def pair_buffer(size: int = 10_000, episodes: int = 30) -> Any:
    buffer = low_buffer(size, hindsight=3, reach_pairs=True)
    rng = np.random.default_rng(0)
    for _ in range(episodes):
        buffer.extend(low_level_steps(wandering(rng), SPARSE))
    return buffer


@pytest.fixture(scope="module")
def learnt() -> Reachability:
    estimate = Reachability(ENV.subgoals, unit=10.0, horizon=20, learning_rate=3e-3, seed=0)
    estimate.train_on(pair_buffer(), 500)
    return estimate


def test_pairs_are_steps_apart_and_never_leave_the_episode() -> None:
    buffer = pair_buffer(size=250, episodes=4)  # the ring has wrapped: half an episode is overwritten
    pairs = buffer.sample_pairs(5000, 40, np.random.default_rng(0))
    assert pairs.steps.min() == 1
    assert 20 < pairs.steps.max() <= 40
    assert (np.abs(pairs.goal - pairs.here)[:, 0] <= 0.1 * pairs.steps + 0.05).all()  # speed limit, threshold


def test_a_point_passed_twice_is_as_far_as_the_first_time() -> None:
    """There and back again: every label is the distance, whichever visit was drawn."""
    there = np.concatenate([np.arange(0, 9), np.arange(9, -1, -1)]) * 0.1
    back = wandering(np.random.default_rng(0), steps=18)
    back.achieved_goal[:] = there[:, None]
    buffer = low_buffer(100, hindsight=3, reach_pairs=True)
    buffer.extend(low_level_steps(back, SPARSE))
    pairs = buffer.sample_pairs(2000, 40, np.random.default_rng(0))
    outward = (pairs.here[:, 0] < 0.05) & (pairs.goal[:, 0] > 0.05)
    np.testing.assert_allclose(pairs.steps[outward], pairs.goal[outward, 0] / 0.1, atol=1e-3)
    assert outward.any()


def test_estimate_ranks_and_scales(learnt: Reachability) -> None:
    rng = np.random.default_rng(1)
    here, goal = rng.uniform(-0.9, 0.9, (2, 400, 1))
    truth, estimated = reach_time(here, goal), learnt.steps(states(here), here, goal)
    assert spearmanr(truth, estimated).statistic > 0.95
    far = truth > 3
    assert 0.9 < np.median(estimated[far] / truth[far]) < 1.4, np.median(estimated[far] / truth[far])
    assert estimated.min() >= 0


def test_a_low_expectile_leans_toward_the_short_way() -> None:
    buffer, here = pair_buffer(), np.zeros((1, 1))
    estimates = {}
    for expectile in (0.1, 0.9):
        estimate = Reachability(ENV.subgoals, 10.0, 20, expectile=expectile, learning_rate=3e-3, seed=0)
        estimate.train_on(buffer, 120)
        estimates[expectile] = estimate.steps(states(here), here, np.full((1, 1), 0.5))[0]
    assert estimates[0.1] < 0.8 * estimates[0.9]
    with pytest.raises(ValueError, match="expectile"):
        Reachability(ENV.subgoals, 10.0, 40, expectile=1.0)


def test_the_window_follows_kappa_within_its_bounds(learnt: Reachability) -> None:
    here = np.zeros((4, 1))
    goal = np.array([[0.01], [0.4], [0.6], [0.9]])
    reach = learnt.steps(states(here), here, goal)
    for kappa in (0.6, 1.0, 1.2, 3.0):
        windows = ReachRule(LAYOUT, RULES, learnt, kappa).steps(states(here), here, goal)
        np.testing.assert_allclose(windows, np.clip(kappa * reach, 2.0, 20.0), rtol=1e-6)
        assert (np.diff(windows) >= 0).all()
    assert ReachRule(LAYOUT, RULES, learnt, 3.0).steps(states(here), here, goal)[-1] == 20.0
    with pytest.raises(ValueError, match="kappa"):
        ReachRule(LAYOUT, RULES, learnt, 0.0)


def make(**kwargs: Any) -> TBCHRL:
    settings = {"high": LEVEL, "low": LEVEL, "max_options": 5, "gradient_ratio": 0.1, "compile": False, "seed": 0}
    return TBCHRL("MultiInputPolicy", Corridor(), **{**settings, **kwargs})


def exact(model: TBCHRL, monkeypatch: pytest.MonkeyPatch) -> TBCHRL:
    """The model with the true reach time in place of its estimate."""
    monkeypatch.setattr(model.reachability, "steps", lambda local, here, goal: reach_time(here, goal))
    return model


@pytest.mark.parametrize("kappa", [0.7, 1.2])
def test_rule_executes_its_windows(kappa: float, monkeypatch: pytest.MonkeyPatch) -> None:
    model = exact(make(duration="rule", kappa=kappa, dt_max=9.0, dt_min=2.0, gradient_ratio=0.0), monkeypatch)
    assert model.high.action_space.shape == (1,)  # no time in the action
    model.learn(150)
    data, n = model.replay_buffer.low.data, model.replay_buffer.low.size()
    first = np.flatnonzero((data["position"][:n, 0] == 0) & (data["to_end"][:n, 0] >= 9))
    expected = np.clip(kappa * reach_time(data["here"][first], data["subgoal"][first]), 2.0, 9.0)
    np.testing.assert_allclose(data["time_left"][first, 0], expected, atol=1e-4)
    np.testing.assert_allclose(data["length"][first, 0], np.ceil(expected - 1e-4))
    assert len(np.unique(data["length"][first, 0])) > 2


def test_predict_and_evaluation_use_the_rule(monkeypatch: pytest.MonkeyPatch) -> None:
    model = exact(make(duration="rule", kappa=1.1), monkeypatch)
    observation, _ = Corridor().reset(seed=0)
    _, state = model.predict(observation, deterministic=True)
    assert state is not None
    assert state[1][0] == pytest.approx(min(1.1 * abs(state[0][0, 0]) / 0.1, 10.0))
    assert evaluate_hierarchical(model, Corridor(), 2, seed=0).lengths.min() >= 1


def test_estimate_is_saved_with_the_agent(tmp_path: Path) -> None:
    model = make(duration="rule", kappa=0.9).learn(150)
    model.save(tmp_path / "model.zip")
    loaded = TBCHRL.load(tmp_path / "model.zip", env=Corridor())
    here, goal = np.zeros((1, 1)), np.full((1, 1), 0.7)
    assert loaded.reachability.steps(states(here), here, goal) == model.reachability.steps(states(here), here, goal)
    assert loaded.kappa == 0.9
    assert loaded.schedule is not None
    assert loaded.reachability.optimizer.state_dict()["state"]


@pytest.mark.parametrize("settings", [{"duration": "rule"}, {"duration_loss_coef": 0.1}])
def test_learning_goes_on_without_the_replay_buffer(settings: dict[str, Any], tmp_path: Path) -> None:
    """Its updates wait for the first episode, as those of the levels do for a batch."""
    model = make(**settings).learn(200, callback=StopTrainingOnMaxEpisodes(2))
    assert model._burst_due
    model.save(tmp_path / "model.zip")
    loaded = TBCHRL.load(tmp_path / "model.zip", env=Corridor())
    loaded.learn(60, reset_num_timesteps=False)
    assert loaded._updated_at > model.num_timesteps
    done = next(iter(loaded.reachability.optimizer.state.values()))["step"]
    assert done == loaded._updated_at // UPDATE_EVERY


def test_episodes_too_short_for_an_update_log_no_loss(tmp_path: Path) -> None:
    model = make(duration="rule", max_options=3, dt_max=3.0)
    model.set_env(Corridor(3, goal=5.0))
    model.set_logger(configure(str(tmp_path), ["csv"]))
    model.learn(30, log_interval=1)
    losses = [row["reachability/loss"] for row in csv.DictReader((tmp_path / "progress.csv").open())]
    assert losses.count("") == 3  # of ten episodes of three steps, with an update for every fourth step
    assert all(float(loss) > 0 for loss in losses if loss)


@pytest.mark.parametrize(("steps", "whole"), [(1, 1), (2.5, 3), (10, 10), (13, 13), (37.037, 38)])
def test_fixed_windows_last_whole_steps(steps: float, whole: int) -> None:
    rules = OptionRules(dt_max=37.037, dt_min=0.0, max_options=27)
    unit = FixedWindows(rules, steps)(np.zeros((3, 2)), {})
    assert unit.shape == (3, 3)
    budget = rules.budget(unit[:, -1])
    assert np.ceil(budget).tolist() == [whole] * 3


def test_fixed_duration_outside_of_its_bounds() -> None:
    with pytest.raises(ValueError, match=r"fixed_duration must lie between max\(1, dt_min=0\) and dt_max=10"):
        make(duration="fixed", fixed_duration=11)
    with pytest.raises(ValueError, match="duration must be one of 'joint', 'rule', 'fixed', got 'free'"):
        make(duration="free")
    with pytest.raises(ValueError, match="use duration='joint'"):
        make(duration="rule", duration_loss_coef=1.0)


def test_fixed_windows_are_executed() -> None:
    model = make(duration="fixed", fixed_duration=7, gradient_ratio=0.0, max_options=20, dt_max=10)
    model.env.envs[0].unwrapped.fixed_goal = 5.0
    model.env.reset()
    model.learn(100)
    data, n = model.replay_buffer.low.data, model.replay_buffer.low.size()
    assert set(data["length"][:n, 0]) == {7.0, 1.0}  # fifty steps: seven windows and one cut off


def test_teacher_labels_are_the_rule_for_the_subgoals_of_the_mean(monkeypatch: pytest.MonkeyPatch) -> None:
    model = exact(make(duration_loss_coef=0.5, kappa=0.8, dt_max=9.0), monkeypatch)
    seen = [Corridor().reset(seed=s)[0] for s in range(3)]
    batch = {key: np.stack([o[key] for o in seen]) for key in seen[0]}
    here = batch["achieved_goal"]
    labels = DurationTeacher(model.replay_buffer.high.teacher.rule, model.high.acting)(
        model.layout.high(batch), batch["observation"], here
    )
    _, state = model.predict(batch, deterministic=True)  # before any update the average is the actor
    assert state is not None
    expected = np.clip(0.8 * reach_time(here, state[0]), 0.0, 9.0)
    np.testing.assert_allclose(model.rules.budget(labels), expected, rtol=1e-4, atol=1e-4)


def test_duration_loss_draws_the_budget_to_the_rule(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(Reachability, "steps", lambda self, local, here, goal: np.full(len(here), 8.0))
    level = {**LEVEL, "learning_rate": 3e-3, "ent_coef": 0.001}
    budgets = {}
    for coef in (0.0, 100.0):
        model = make(duration_loss_coef=coef, kappa=1.0, dt_max=10.0, high=level, gradient_ratio=0.0).learn(150)
        model.high.train(300, 16)
        seen = model.replay_buffer.high.data["observations"][:5]
        unit, _ = model.high.acting.act(seen, np.zeros((5, 0), np.float32), True, np.random.default_rng(0))
        budgets[coef] = float(model.rules.budget(unit[:, -1]).mean())
    assert budgets[100.0] == pytest.approx(8.0, abs=1.0)
    assert abs(budgets[0.0] - 8.0) > abs(budgets[100.0] - 8.0)


def test_labels_need_a_teacher() -> None:
    model = make()
    with pytest.raises(RuntimeError, match="teacher"):
        model.replay_buffer.high.sample_labelled(1, 1)
