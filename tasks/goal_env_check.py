"""Checks a goal environment with the calls that training makes; each problem is reported with its cure."""

from __future__ import annotations

import warnings
from collections.abc import Callable

import numpy as np

from sb3_tbc.aliases import Env
from sb3_tbc.smdp.goal_spaces import GOAL_KEYS, goal_space_problems

from .probe import Floats, Probe, run_probe
from .success_test import compute_reward_of
from .time_limit import time_limit


def goal_env_problems(env: Env, n_steps: int = 20) -> list[str]:
    """What keeps a hierarchical agent from acting in an environment, each with a cure; empty if nothing.

    :param env: any environment; it is reset and stepped ``n_steps`` times
    """
    problems = goal_space_problems(env.observation_space, env.action_space)
    if not env.has_wrapper_attr("compute_reward"):
        problems.append("it has no compute_reward(achieved_goal, desired_goal, info), which relabelling goals needs")
    if time_limit(env) is None:
        problems.append(
            "its episodes have no time limit; pass gymnasium.make(..., max_episode_steps=N), or on the command line "
            "--hyperparams env_kwargs.max_episode_steps:N"
        )
    return problems or reward_problems(env, run_probe(env, n_steps))


def check_goal_env(env: Env) -> None:
    """Explain what an environment lacks for hierarchical, goal-conditioned learning.

    Warns if two runs from one seed differ: then randomness comes from elsewhere than ``np_random``, and no run can be
    repeated.

    :param env: any environment; it is reset and stepped a few times
    :raises ValueError: listing every problem with its cure
    """
    problems = goal_env_problems(env)
    if problems:
        raise ValueError(f"{name_of(env)} cannot be used as a goal environment: {'; '.join(problems)}")
    if not repeats(env):
        warnings.warn(
            f"{name_of(env)} differs between two episodes with the same seed and actions: it draws random numbers from "
            "elsewhere than self.np_random, or keeps something over a reset. Runs in it cannot be repeated.",
            stacklevel=2,
        )


def name_of(env: Env) -> str:
    """Id of an environment, or the name of its class."""
    return env.spec.id if env.spec is not None else type(env.unwrapped).__name__


def repeats(env: Env, n_steps: int = 10) -> bool:
    """Whether the same seed and actions lead to the same observations and rewards, to about six digits."""
    one, other = run_probe(env, n_steps), run_probe(env, n_steps)
    if any(one.seen[key].shape != other.seen[key].shape for key in GOAL_KEYS):
        return False
    pairs = [(one.seen[key], other.seen[key]) for key in GOAL_KEYS] + [(one.rewards, other.rewards)]
    return all(np.allclose(a, b, rtol=1e-5, atol=1e-5, equal_nan=True) for a, b in pairs)


def reward_problems(env: Env, probe: Probe) -> list[str]:
    """Whether rewards can be recomputed without a step's info, singly and in batches, for relabelled goals too.

    :param probe: what random episodes in the environment showed
    """
    compute = compute_reward_of(env)
    going = ~probe.terminated  # the last step of an episode may pay for more than the goal, e.g. for a crash
    achieved, desired = probe.achieved, probe.desired
    try:
        single = _singly(compute, achieved, desired)
        other = _singly(compute, achieved, achieved[::-1])
    except Exception as error:  # A user's function may fail in any way.
        return [
            f"compute_reward(achieved_goal, desired_goal, {{}}) fails ({type(error).__name__}: {error}); there is no "
            "step's info for a relabelled goal, so let it depend on the goals alone"
        ]
    problems = []
    if not np.allclose(single[going], probe.rewards[going], atol=1e-5):
        worst = int(np.argmax(np.where(going, np.abs(single - probe.rewards), 0.0)))
        problems.append(
            f"compute_reward(achieved_goal, desired_goal, {{}}) gives {single[worst]:.6g} where the step gave "
            f"{probe.rewards[worst]:.6g}; the two must agree, and must not depend on info or on wrappers"
        )
    return problems + _batch_problems(compute, achieved, desired, single, other)


def _singly(compute: Callable[[Floats, Floats], Floats], achieved: Floats, desired: Floats) -> Floats:
    return np.array([float(compute(a, d)) for a, d in zip(achieved, desired, strict=True)])


def _batch_problems(
    compute: Callable[[Floats, Floats], Floats], achieved: Floats, desired: Floats, single: Floats, other: Floats
) -> list[str]:
    for wanted, expected in ((desired, single), (achieved[::-1], other)):
        try:
            batch = compute(achieved, wanted)
        except Exception as error:  # As above.
            return [f"compute_reward fails on a batch ({type(error).__name__}: {error}); vectorise it"]
        if batch.shape != expected.shape:
            return [
                f"compute_reward gives shape {batch.shape} for a batch of {len(expected)} goals, not "
                f"{expected.shape}; vectorise it"
            ]
        if not np.allclose(batch, expected, atol=1e-5):
            i = int(np.argmax(np.abs(batch - expected)))
            return [f"compute_reward gives {batch[i]:.6g} in a batch, {expected[i]:.6g} singly; vectorise it"]
    return []
