"""Events of a task: they return control to the high level at once, and hindsight goals may come from them alone."""

from __future__ import annotations

from typing import Any

import gymnasium as gym
import numpy as np
import pytest
from corridor import Corridor, achieved, local
from stable_baselines3.common.vec_env import DummyVecEnv

from sb3_tbc import HAC, TBCHRL
from sb3_tbc.smdp.goal_vec_env import GoalVecEnv
from sb3_tbc.smdp.hindsight import check_goal_strategy, goal_pairs
from sb3_tbc.smdp.options import TerminationReason
from sb3_tbc.smdp.spaces import SubgoalSpace
from sb3_tbc.tbc_hrl.flat_sac import FlatSAC
from sb3_tbc.tbc_hrl.option_env import OptionEnv

LEVEL: dict[str, Any] = {"batch_size": 16, "policy_kwargs": {"net_arch": [8, 8]}}
FLAG, EVENT = 3, 17


class Bell(Corridor):
    """A corridor where a bell rings at step 17, and in no other; a fourth entry of the observation says so."""

    def __init__(self, rings: bool = True) -> None:
        super().__init__(goal=5.0)  # out of reach: every episode runs its 50 steps
        self.rings = rings
        self.observation_space["observation"] = gym.spaces.Box(-np.inf, np.inf, (4,), np.float64)
        self.subgoals = SubgoalSpace(
            [-1.0], [1.0], [0.05], achieved, local, [1.0, 50.0, 100.0, 1.0], ["position"], event=FLAG
        )

    def _observation(self) -> dict[str, Any]:
        observation = super()._observation()
        rang = float(self.rings and self.steps == EVENT)
        return {**observation, "observation": np.append(observation["observation"], rang)}


def make(env: Any, algo: type[TBCHRL] = TBCHRL, **settings: Any) -> TBCHRL:
    defaults = {"high": LEVEL, "low": LEVEL, "max_options": 30, "dt_max": 12.0, "compile": False, "seed": 0}
    return algo("MultiInputPolicy", env, **{**defaults, "gradient_ratio": 0.02, **settings})


@pytest.mark.parametrize("window_end", ["timed", "reached"])
def test_an_event_ends_every_option(window_end: str) -> None:
    model = make(GoalVecEnv([Bell, Bell]), window_end=window_end, gradient_ratio=0.0)
    model.learn(600)
    reasons = []
    for _ in range(300):
        for episode in model.collector.step().episodes.values():
            ends = [option.start + option.duration for option in episode.options]
            assert EVENT in ends
            cut = episode.options[ends.index(EVENT)]
            if cut.reason is TerminationReason.EVENT:
                assert cut.duration < cut.time_budget
                assert not cut.reached
            reasons += [option.reason for option in episode.options if option is not cut]
            reasons.append(cut.reason)
    assert TerminationReason.EVENT in reasons


def test_an_event_that_ends_the_last_option_is_told_as_the_event() -> None:
    """The option was not cut off by the episode's end: its end was the episode's."""
    model = make(Bell(), max_options=1, dt_max=40.0, dt_min=30.0)
    model.learn(100)
    told = []
    for episode in (e for _ in range(60) for e in model.collector.step().episodes.values()):
        assert episode.budget_exhausted
        told += [(option.reason, option.duration) for option in episode.options]
    assert set(told) == {(TerminationReason.EVENT, EVENT)}
    env = OptionEnv(DummyVecEnv([Bell]), model)
    env.reset()
    _, _, dones, infos = env.step(np.array([[0.0, 1.0]]))
    assert dones[0]
    assert (infos[0]["option"]["reason"], infos[0]["option"]["duration"]) == ("event", EVENT)


def test_predict_begins_a_new_option_at_an_event_too() -> None:
    model = make(Bell(), dt_min=10.0)  # without the event the second option would begin at 10 to 12, the third past 20
    env, state, begun = Bell(), None, []
    observation, _ = env.reset(seed=0)
    for step in range(50):
        _, state = model.predict(observation, state, np.array([step == 0]), deterministic=True)
        begun += [step] * int(state[2][0] == 1)  # steps since the option began
        observation = env.step(np.array([0.5]))[0]
    assert begun[0] == 0
    assert 10 <= begun[1] <= 12
    assert begun[2] == EVENT


def test_all_options_get_the_events_outcome_as_their_goal() -> None:
    rng = np.random.default_rng(0)
    assert goal_pairs(4, 3, "event", rng, 2).tolist() == [[0, 2], [1, 2], [2, 2], [3, 2]]
    assert goal_pairs(4, 3, "event", rng, None).shape == (0, 2)


def test_hac_takes_the_low_levels_goals_from_the_future() -> None:
    """An event gives goals to the high level alone."""
    model = make(Bell(), HAC, goal_strategy="event")
    assert model.store.hindsight.goal_strategy == "event"
    assert model.replay_buffer.low.hindsight == "future"


@pytest.mark.parametrize("rings", [True, False])
def test_the_high_level_learns_from_the_event_alone(rings: bool) -> None:
    model = make(GoalVecEnv([lambda: Bell(rings)]), goal_strategy="event", gradient_ratio=0.0, testing_fraction=0.0)
    model.learn(200)
    buffer = model.replay_buffer.high
    data = {name: array[: buffer.size()] for name, array in buffer.data.items()}
    goals = data["observations"][:, 0]
    copies = goals != 5.0
    assert copies.sum() * 2 == (len(goals) if rings else 0)  # one copy of each transition, or none
    met = data["dones"][copies, 0] == 1
    at_event = data["next_observations"][copies, 1 + FLAG] == 1
    assert (met | ~at_event).all()  # whoever ends in the event has met the goal it gave


def test_flat_hindsight_takes_its_goals_from_the_event() -> None:
    model = FlatSAC(
        "MultiInputPolicy", Bell(), gradient_ratio=0.01, n_hindsight_goals=1000, goal_strategy="event", batch_size=16,
        buffer_size=130, learning_starts=10, policy_kwargs={"net_arch": [8]}, seed=0,
    ).learn(300)  # fmt: skip
    buffer = model.replay_buffer
    samples = buffer.sample(400)
    position = buffer.next_observations["achieved_goal"][:, 0, 0]
    events = position[buffer.next_observations["observation"][:, 0, FLAG] > 0.5]
    goals = np.unique(samples.observations["desired_goal"].numpy())
    assert set(goals) <= {np.float32(5.0), *events}
    assert len(set(goals) & set(events)) >= 2  # of several episodes


class Precipice(Bell):
    """The corridor ends in a fall, which costs 7."""

    def step(self, action: Any) -> Any:
        observation, reward, terminated, truncated, info = super().step(action)
        fell = self.steps == 9
        return observation, -7.0 if fell else reward, terminated or fell, truncated, info


def test_flat_samples_that_keep_their_goal_keep_their_reward() -> None:
    """No bell has rung before the fall: one step and goal had two rewards, -7 as stored and -1 where it was sampled."""
    model = FlatSAC(
        "MultiInputPolicy", Precipice(), gradient_ratio=0.0, n_hindsight_goals=3, goal_strategy="event",
        buffer_size=200, policy_kwargs={"net_arch": [8]}, seed=0,
    ).learn(90)  # fmt: skip
    samples = model.replay_buffer.sample(400)
    fell = samples.next_observations["observation"][:, 1] == 9
    assert fell.any()
    assert (samples.rewards[fell] == -7).all()
    assert (samples.rewards[~fell] == -1).all()


def test_tennis_has_one_event_in_an_episode() -> None:
    pytest.importorskip("Box2D")
    env = gym.make("sb3_tbc/Tennis2D-v0", observation="compact")
    space = env.unwrapped.subgoals
    for seed in range(5):
        observation, _ = env.reset(seed=seed)
        assert not space.happened(observation)
        events, over = 0, False
        while not over:
            observation, _, terminated, truncated, _ = env.step(np.zeros(3, dtype=np.float32))
            events += int(space.happened(observation))
            over = terminated or truncated
        assert events == 1


def test_mistakes() -> None:
    for wrong in (-1, "bell", 1.5):
        with pytest.raises(ValueError, match="event must be the index of a flag"):
            SubgoalSpace([-1.0], [1.0], [0.05], achieved, local, [1.0], ["position"], event=wrong)
    with pytest.raises(ValueError, match="this task names none"):
        check_goal_strategy("event", Corridor().subgoals)
    with pytest.raises(ValueError, match="this task names none"):
        make(Corridor(), goal_strategy="event")
    with pytest.raises(ValueError, match="this task names none"):
        FlatSAC("MultiInputPolicy", Corridor(), goal_strategy="event")
    with pytest.raises(ValueError, match=r"one of 'future', 'episode', 'event', got 'final'"):
        make(Corridor(), goal_strategy="final")
