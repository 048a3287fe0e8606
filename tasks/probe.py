"""Random episodes in a goal environment: its observations and rewards, from which its properties are measured."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from typing import NamedTuple, SupportsFloat

import numpy as np
from gymnasium import spaces
from numpy.typing import NDArray

from sb3_tbc.aliases import Env
from sb3_tbc.smdp.goal_spaces import GOAL_KEYS, said_success
from sb3_tbc.smdp.spaces import GoalObservation

Floats = NDArray[np.float64]


class Probe(NamedTuple):
    """What random episodes showed; ``n`` observations, the first of each episode included, and ``m`` steps."""

    seen: dict[str, Floats]  # (n, dim) for each of GOAL_KEYS
    after: NDArray[np.intp]  # (m,) index into ``seen`` of what each step led to
    rewards: Floats  # (m,)
    terminated: NDArray[np.bool_]  # (m,)
    successes: list[bool | None]  # (m,) what ``info`` says; None where it does not say

    @property
    def achieved(self) -> Floats:
        """Achieved goals after the steps, ``(m, goal_dim)``."""
        return self.seen["achieved_goal"][self.after]

    @property
    def desired(self) -> Floats:
        """Desired goals after the steps, ``(m, goal_dim)``."""
        return self.seen["desired_goal"][self.after]


def run_probe(env: Env, n_steps: int, seed: int = 0, episode_steps: int = 50) -> Probe:
    """Run random actions, each held for five steps, in short episodes.

    The environment's own random stream is put back afterwards. The last episode is left unfinished, so that the
    environment has to be reset before it is used. A step whose values are not finite, or not of their space's shapes,
    is left out and ends its episode: the agent's setting ``on_bad_step`` says what becomes of such steps.

    :param env: a goal environment; arrays are copied, because some environments hand out the same ones every step
    :param n_steps: steps together
    :param seed: of the first reset and of the actions
    :param episode_steps: longest episode
    :raises ValueError: if a reset, or every step, gives such values
    """
    rng, actions = np.random.default_rng(seed), env.action_space
    assert isinstance(actions, spaces.Box)
    with _random_stream_kept(env):
        seen = [_first(env, seed)]
        after, rewards, terminations, successes = [], [], [], []
        action, ended, wrong = actions.low, False, None
        for step in range(n_steps):
            if ended or step % episode_steps == episode_steps - 1:
                seen.append(_first(env))
            if step % 5 == 0:
                action = rng.uniform(actions.low, actions.high).astype(actions.dtype)
            observation, reward, terminated, truncated, info = env.step(action)
            wrong = _what_is_wrong(env, observation, reward)
            ended = bool(terminated or truncated or wrong)
            if wrong is None:
                after.append(len(seen))
                seen.append(_copied(observation))
                rewards.append(float(reward))
                terminations.append(bool(terminated))
                successes.append(said_success(info))
    if not after:
        raise ValueError(f"{wrong} in every step of random episodes")
    stacked = {key: np.stack([observation[key] for observation in seen]) for key in GOAL_KEYS}
    return Probe(stacked, np.array(after), np.array(rewards), np.array(terminations), successes)


def _first(env: Env, seed: int | None = None) -> dict[str, Floats]:
    """What a reset shows.

    :raises ValueError: if it is not finite, or of another shape than its space says
    """
    observation, _ = env.reset(seed=seed)
    wrong = _what_is_wrong(env, observation)
    if wrong is not None:
        raise ValueError(f"{wrong} at a reset in random episodes")
    return _copied(observation)


def _what_is_wrong(env: Env, observation: GoalObservation, reward: SupportsFloat = 0.0) -> str | None:
    """What is not finite, or of another shape than its space says; None if nothing is."""
    assert isinstance(env.observation_space, spaces.Dict)
    whose = f"of {type(env.unwrapped).__name__}"
    for key in GOAL_KEYS:
        shape = env.observation_space[key].shape
        given = np.shape(observation[key]) if key in observation else None
        if given != shape:
            return f"observation[{key!r}] {whose} has shape {given}, not {shape} as its space says,"
        if not np.isfinite(observation[key]).all():
            return f"observation[{key!r}] {whose} is not finite"
    if shape := np.asarray(reward).shape:
        return f"the reward {whose} is no number but an array of shape {shape}"
    return None if np.isfinite(float(reward)) else f"the reward {whose} is {reward}"


def _copied(observation: GoalObservation) -> dict[str, Floats]:
    return {key: np.array(observation[key], dtype=np.float64) for key in GOAL_KEYS}


@contextmanager
def _random_stream_kept(env: Env) -> Iterator[None]:
    inner = env.unwrapped
    generator, seed = inner._np_random, inner._np_random_seed
    try:
        yield
    finally:
        inner._np_random, inner._np_random_seed = generator, seed
