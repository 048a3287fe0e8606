"""One reading of time limits: ``gymnasium.make``, ``TimeLimit`` wrappers and the tasks themselves agree."""

import gymnasium as gym
import numpy as np
import pytest
from gymnasium.wrappers import FlattenObservation, TimeAwareObservation, TimeLimit
from making import make
from sb3_tbc.tasks import TASKS
from sb3_tbc.tasks.time_limit import declared_limit, time_limit


def length(env):
    env.reset(seed=0)
    steps = 0
    while True:
        steps += 1
        _, _, terminated, truncated, _ = env.step(np.zeros(env.action_space.shape))
        assert not terminated
        if truncated:
            return steps


@pytest.mark.parametrize("task", TASKS)
def test_the_registry_knows_every_tasks_limit(task):
    env = make(task)
    limit = env.unwrapped.max_episode_steps
    assert gym.spec(f"sb3_tbc/{task}-v0").max_episode_steps == env.spec.max_episode_steps == limit
    assert time_limit(env) == limit
    assert TimeAwareObservation(FlattenObservation(env)).observation_space.shape[0] > 0


@pytest.mark.parametrize("limit", [7, 1300])
def test_another_limit_is_honoured_be_it_shorter_or_longer(limit):
    env = make("Pendulum", max_episode_steps=limit)
    assert time_limit(env) == env.spec.max_episode_steps == length(env) == limit
    assert make("Drawbridge", max_episode_steps=limit).reset()[0]["observation"][-2] == -1.0  # its clock is its own


def test_of_several_limits_the_smallest_counts():
    for env in (TimeLimit(make("Pendulum"), 9), TimeLimit(make("Pendulum", max_episode_steps=9), 2000)):
        assert time_limit(env) == length(env) == 9
    alone = make("Pendulum").unwrapped.__class__()
    assert time_limit(alone) == 1000
    assert length(alone) == 1000
    assert time_limit(TimeLimit(alone, 2000)) == 1000


def test_no_limit_is_none():
    assert time_limit(make("Pendulum", max_episode_steps=-1)) is None
    assert time_limit(gym.make("CartPole-v1", max_episode_steps=-1)) is None
    assert time_limit(gym.make("CartPole-v1")) == 500


@pytest.mark.parametrize(
    ("declared", "own", "keeps", "limit"),
    [
        (100, None, True, 100),
        (None, 50, True, 50),
        (100, 50, True, 50),
        (2000, 1000, False, 2000),
        (None, None, True, None),
    ],
)
def test_the_same_from_attributes_alone(declared, own, keeps, limit):
    spec = None if declared is None else gym.spec("CartPole-v1")
    if spec is not None:
        spec = type(spec)(id="A-v0", max_episode_steps=declared)
    assert declared_limit(spec, own, keeps) == limit
