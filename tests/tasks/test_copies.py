"""Copies of tasks, made at any moment of an episode, are independent and go on exactly as the original does."""

import copy
import pickle

import cloudpickle
import gymnasium as gym
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from making import make, random_actions
from sb3_tbc.tasks import TASKS

WAYS = {
    "deepcopy": copy.deepcopy,
    "pickle": lambda env: pickle.loads(pickle.dumps(env)),
    "cloudpickle": lambda env: pickle.loads(cloudpickle.dumps(env)),
}


def walk(env, actions):
    """Everything that ``actions`` lead to; episodes follow one another."""
    trace = []
    for action in actions:
        observation, *rest = env.step(action)
        trace.append((*(part.tobytes() for part in observation.values()), repr(rest), state_of(env)))
        if rest[1] or rest[2]:
            trace.append(tuple(part.tobytes() for part in env.reset()[0].values()))
    return trace


def state_of(env):
    return {name: array.tobytes() for name, array in env.unwrapped.task_state().items()}


@pytest.mark.parametrize("task", TASKS)
@settings(max_examples=6, deadline=None)
@given(
    way=st.sampled_from(sorted(WAYS)),
    layout=st.sampled_from(["paper", "compact"]),
    legacy=st.booleans(),
    episodes=st.integers(0, 2),
    steps=st.integers(0, 80),
    seed=st.integers(0, 2**31),
)
def test_a_copy_goes_on_exactly(task, way, layout, legacy, episodes, steps, seed):
    env = make(task, layout, legacy_quirks=legacy, max_episode_steps=110)
    env.reset(seed=seed)
    for episode in range(episodes):
        walk(env, random_actions(env, 30, seed + episode))
        env.reset()
    before = random_actions(env, steps, seed + 9)
    walk(env, before)
    twin = WAYS[way](env)
    assert state_of(twin) == state_of(env)
    after = random_actions(env, 60, seed + 10)
    first = walk(env, after)
    assert walk(twin, after) == first  # each has a random stream of its own, from the same state


@pytest.mark.parametrize("way", sorted(WAYS))
@pytest.mark.parametrize("task", TASKS)
def test_a_copy_is_independent(task, way):
    env = make(task)
    env.reset(seed=1)
    walk(env, random_actions(env, 5, 0))
    before = state_of(env)
    twin = WAYS[way](env)
    walk(twin, random_actions(twin, 20, 1))
    assert state_of(env) == before
    assert state_of(twin) != before
    if names := env.unwrapped.dynamics_names:
        changed, same = WAYS[way](env), WAYS[way](env)
        changed.unwrapped.set_dynamics({name: 1.7 for name in names})
        pairs = []
        for one in (env, same, changed):
            one.reset(seed=3)
            pairs.append(walk(one, random_actions(env, 40, 2)))
        assert pairs[0] == pairs[1] != pairs[2]


@pytest.mark.parametrize("task", TASKS)
def test_a_copy_before_the_first_reset_and_of_a_perturbed_task(task):
    fresh = copy.deepcopy(make(task))
    with pytest.raises(gym.error.ResetNeeded):
        fresh.step(np.zeros(fresh.action_space.shape))
    env = make(task, perturb={"observation_noise": 0.1, "action_delay": 3})
    env.reset(seed=5)
    walk(env, random_actions(env, 10, 0))
    twin = copy.deepcopy(env)
    actions = random_actions(env, 20, 1)
    assert walk(env, actions) == walk(twin, actions)


@pytest.mark.parametrize("task", ["Pendulum", "UR5Reacher"])
def test_what_was_drawn_is_no_part_of_a_copy(task):
    env = make(task, render_mode="rgb_array")
    env.reset(seed=0)
    try:
        picture = env.render()
    except RuntimeError as error:
        pytest.skip(str(error))
    twin = pickle.loads(pickle.dumps(env))
    np.testing.assert_array_equal(twin.render(), picture)
    twin.close()
    np.testing.assert_array_equal(env.render(), picture)
    env.close()
