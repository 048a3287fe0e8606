"""Evaluation: by the means of both levels, episode after episode, with the rules of training."""

from __future__ import annotations

import inspect
from collections.abc import Callable
from typing import Any

import gymnasium as gym
import numpy as np
import pytest
from corridor import Corridor
from gymnasium.spaces import Box, Dict
from stable_baselines3.common.vec_env import DummyVecEnv, VecNormalize

from sb3_tbc import TBCHRL, HiTS
from sb3_tbc.errors import NonFiniteError
from sb3_tbc.tbc_hrl.evaluation import evaluate_agent, evaluate_flat, evaluate_hierarchical
from sb3_tbc.tbc_hrl.flat_sac import FlatSAC
from sb3_tbc.tbc_hrl.policy import TwoLevelState

LEVEL: dict[str, Any] = {"batch_size": 16, "policy_kwargs": {"net_arch": [8, 8]}}


class Same(Corridor):
    """A corridor whose episodes all begin alike: one goal, no serial number to see."""

    def __init__(self, goal: float = 0.8) -> None:
        super().__init__(goal=goal)

    def reset(self, **kwargs: Any) -> Any:
        self.episode = 0
        return super().reset(**kwargs)


def make(**kwargs: Any) -> TBCHRL:
    settings = {"high": LEVEL, "low": LEVEL, "max_options": 5, "compile": False, "seed": 0}
    return TBCHRL("MultiInputPolicy", Corridor(), **{**settings, **kwargs})


@pytest.mark.parametrize("window_end", ["timed", "reached"])
def test_deterministic_evaluations_draw_nothing(window_end: str) -> None:
    """Episodes that begin alike are the same, where there is no noise on either level."""
    model = make(window_end=window_end)
    env = Same()
    result = evaluate_hierarchical(model, env, 6, seed=0)
    for name in ("lengths", "rewards", "mean_window", "decisions", "subgoal_success"):
        assert len(set(getattr(result, name))) == 1, name
    noisy = evaluate_hierarchical(model, env, 6, seed=0, deterministic=False)
    assert len(set(noisy.mean_window)) > 1


def test_the_high_level_alone_is_deterministic_too(monkeypatch: pytest.MonkeyPatch) -> None:
    model = make()
    asked: list[bool] = []
    propose = model.actor.propose

    def listen(observations: Any, deterministic: bool, rng: Any) -> Any:
        asked.append(deterministic)
        return propose(observations, deterministic, rng)

    monkeypatch.setattr(model.actor, "propose", listen)
    evaluate_agent(model, Corridor(), 2, seed=0)
    assert asked
    assert all(asked)


def test_flat_evaluations_draw_nothing() -> None:
    model = FlatSAC("MultiInputPolicy", Corridor(), buffer_size=100, seed=0)
    env = Same(goal=0.2)
    assert len(set(evaluate_agent(model, env, 4, seed=0).rewards)) == 1
    noisy = evaluate_agent(model, env, 4, seed=0, deterministic=False)
    assert len(set(zip(noisy.lengths, noisy.rewards, strict=True))) > 1


@pytest.mark.parametrize("flat", [False, True])
def test_either_kind_of_agent_is_evaluated_as_it_was_asked(flat: bool) -> None:
    model = FlatSAC("MultiInputPolicy", Corridor(), buffer_size=100, seed=0) if flat else make()
    evaluate = evaluate_flat if flat else evaluate_hierarchical
    for deterministic in (True, False):
        model.set_random_seed(0)
        one = evaluate_agent(model, Corridor(), 1, 7, deterministic)
        model.set_random_seed(0)
        other = evaluate(model, Corridor(), 1, seed=7, deterministic=deterministic)
        assert [c.tolist() for c in one[:3]] == [c.tolist() for c in other[:3]]
        assert [c.dtype.kind for c in one] == list("bifffib")
    with pytest.raises(ValueError, match="n_eval_episodes must be a whole number of at least 1, got 0"):
        evaluate_agent(model, Corridor(), 0)


@pytest.mark.parametrize("evaluate", [evaluate_agent, evaluate_flat, evaluate_hierarchical])
def test_the_paper_evaluates_a_hundred_episodes(evaluate: Callable[..., Any]) -> None:
    assert inspect.signature(evaluate).parameters["n_eval_episodes"].default == 100


@pytest.mark.parametrize(("dt_min", "windows"), [(0.0, [1] * 8), (4.0, [1, 2, 3, 4, 1, 2, 3, 4])])
def test_predict_keeps_to_the_shortest_time_budget(
    dt_min: float, windows: list[int], monkeypatch: pytest.MonkeyPatch
) -> None:
    """The subgoal is where the point stands: only ``dt_min`` keeps a window from ending at once."""
    model = make(window_end="reached", dt_min=dt_min, dt_max=10.0)
    monkeypatch.setattr(model.actor, "propose", lambda seen, *_: np.tile([0.0, 1.0], (len(seen), 1)))
    observation, _ = Corridor(goal=5.0).reset(seed=0)
    state: Any = None
    elapsed = []
    for _ in windows:
        _, state = model.predict(observation, state=state, deterministic=True)
        elapsed.append(int(TwoLevelState(*state).elapsed[0]))
    assert elapsed == windows


def test_predict_asks_for_no_budget_below_the_shortest(monkeypatch: pytest.MonkeyPatch) -> None:
    model = make(dt_min=4.0, dt_max=10.0)
    monkeypatch.setattr(model.actor, "propose", lambda seen, *_: np.tile([0.0, -1.0], (len(seen), 1)))
    _, state = model.predict(Corridor().reset(seed=0)[0], deterministic=True)
    assert TwoLevelState(*state).time_budget.tolist() == [4.0]


@pytest.mark.parametrize("flat", [False, True])
def test_environments_that_the_agent_was_not_made_for_are_refused(flat: bool) -> None:
    model = FlatSAC("MultiInputPolicy", Corridor(), buffer_size=100, seed=0) if flat else make()
    with pytest.raises(ValueError, match="VecNormalize moves the subgoal space"):
        evaluate_agent(model, VecNormalize(DummyVecEnv([Corridor])), 1)
    with pytest.raises(ValueError, match="Observation spaces do not match"):
        evaluate_agent(model, gym.make("sb3_tbc/Pendulum-v0"), 1)


class Filmed(Same):
    """Shows a picture, too, which no level looks at."""

    def __init__(self) -> None:
        super().__init__()
        self.observation_space = Dict({**self.observation_space.spaces, "image": Box(0, 255, (40, 40, 3), np.uint8)})

    def _observation(self) -> dict[str, Any]:
        return {**super()._observation(), "image": np.zeros((40, 40, 3), np.uint8)}


def test_what_the_agent_does_not_see_may_differ() -> None:
    """SB3 turns the axes of pictures in the agent's own environments alone."""
    model = TBCHRL("MultiInputPolicy", Filmed(), max_options=5, compile=False, seed=0)
    filmed, plain = (evaluate_hierarchical(model, env, 3, seed=0) for env in (Filmed(), Same()))
    np.testing.assert_array_equal(filmed.rewards, plain.rewards)


def test_a_state_of_other_environments_is_refused() -> None:
    model = HiTS("MultiInputPolicy", Corridor(), max_options=5, compile=False, seed=0)
    seen = Corridor().reset(seed=0)[0]
    three = {key: np.stack([part] * 3) for key, part in seen.items()}
    for one, other, said in ((seen, three, "of 1 environments, the observation of 3"), (three, seen, "of 3 .* of 1")):
        _, state = model.predict(one)
        with pytest.raises(ValueError, match=f"state is {said}"):
            model.predict(other, state)
    _, state = model.predict(seen)
    assert state is not None
    for name in ("time_budget", "elapsed"):
        broken = TwoLevelState(*state)._replace(**{name: np.full(1, np.nan)})
        with pytest.raises(NonFiniteError, match=rf"state\.{name} is not finite: \[nan\]"):
            model.predict(seen, broken)


@pytest.mark.parametrize(
    ("given", "message"),
    [
        ({"n_eval_episodes": 2.5}, "n_eval_episodes must be a whole number of at least 1, got 2.5"),
        ({"n_eval_episodes": "3"}, "n_eval_episodes must be a whole number of at least 1, got '3'"),
        ({"seed": -1}, "seed must be a whole number from 0 to 4,294,967,295 or null, got -1"),
        ({"seed": 1.5}, "seed must be"),
    ],
)
def test_numbers_of_an_evaluation_are_looked_at_first(given: dict[str, Any], message: str) -> None:
    model = HiTS("MultiInputPolicy", Corridor(), max_options=5, compile=False, seed=0)
    with pytest.raises(ValueError, match=message):
        evaluate_hierarchical(model, Corridor(), **given)
