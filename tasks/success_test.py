"""Finds out when another package's task counts a goal as reached, from its reward or success test at observed goals."""

from __future__ import annotations

from collections.abc import Callable
from operator import attrgetter
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from sb3_tbc.aliases import Env
from sb3_tbc.smdp.spaces import SubgoalSpace

from .probe import Floats, Probe

Test = Callable[[Floats, Floats], NDArray[np.bool_]]
"""Maps achieved and desired goals ``(n, goal_dim)`` to whether each goal is reached, ``(n,)``."""

OWN_TESTS = ("_is_success", "task.is_success")
"""Names of success tests in unwrapped environments: of Gymnasium-Robotics and highway-env, and of panda-gym."""


class SuccessTest(NamedTuple):
    """What tells that a goal of a task is reached, and the reward at the goal."""

    best: float
    own: str | None = None  # one of OWN_TESTS
    vectorised: bool = True  # whether the own test takes batches
    worst: float | None = None  # the reward away from the goal, if it is the same everywhere
    near: SubgoalSpace | None = None  # thresholds that the user gave; without own and near the reward tells

    def function_for(self, env: Env) -> Test:
        """The test as a function that asks an environment."""
        if self.near is not None:
            return self.near.reached
        if self.own is None:
            compute, least = compute_reward_of(env), self.best - _slack(self.best)
            return lambda achieved, desired: np.asarray(compute(achieved, desired) >= least)
        own = attrgetter(self.own)(env.unwrapped)
        if self.vectorised:
            return lambda achieved, desired: np.asarray(own(achieved, desired)).astype(bool)
        return lambda achieved, desired: np.array([bool(own(a, d)) for a, d in zip(achieved, desired, strict=True)])


def compute_reward_of(env: Env) -> Callable[[Floats, Floats], Floats]:
    """The reward of achieved and desired goals ``(n, goal_dim)``, asked as training asks it: without a step's info."""
    compute = env.get_wrapper_attr("compute_reward")
    return lambda achieved, desired: np.asarray(compute(achieved.copy(), desired.copy(), {}), dtype=np.float64)


def success_test_of(env: Env, probe: Probe, near: SubgoalSpace | None, seed: int = 0) -> SuccessTest:
    """Find out when a task counts a goal as reached.

    A reward of two values is its own test: the higher one is paid at the goal. A dense reward does not tell, so that
    the task's success test is used, see :data:`OWN_TESTS`, or the thresholds that the user gives.

    :param env: a goal environment
    :param probe: what random episodes in it showed
    :param near: a subgoal space with given thresholds, to be used where nothing else tells
    :param seed: draws the pairs of observed goals that are asked about
    :raises ValueError: if the answers contradict each other, or nothing tells when a goal is reached
    """
    compute = compute_reward_of(env)
    best = _best_reward(compute, probe)
    achieved, desired = _pairs(probe, np.random.default_rng(seed))
    rewards = compute(achieved, desired)
    if np.any(rewards > best + _slack(best)):
        raise ValueError(f"its reward is {rewards.max():.6g} away from a goal, but only {best:.6g} at the goal")
    values = np.unique(np.append(np.round(rewards, 6), round(best, 6)))
    if len(values) == 1:
        raise ValueError(f"its reward is {best:.6g} for every observed pair of goals, as if all goals were the same")
    found = SuccessTest(best, worst=float(values[0])) if len(values) == 2 else _own_test(env, best, probe, near)
    wrong = 0 if found.near else _disagreements(found.function_for(env), probe)
    if wrong:
        raise ValueError(
            f"its info contradicts its {found.own or 'reward'} on whether the goal is reached, in {wrong} of "
            f"{len(probe.after)} random steps"
        )
    return found


def _slack(best: float) -> float:
    return 1e-6 * max(1.0, abs(best))


def _best_reward(compute: Callable[[Floats, Floats], Floats], probe: Probe) -> float:
    """The reward where achieved and desired goal coincide."""
    goals = np.concatenate([_some(probe.seen["desired_goal"]), _some(probe.achieved)])
    at_goal = compute(goals, goals)
    low, high = float(at_goal.min()), float(at_goal.max())
    if not np.isclose(low, high, atol=1e-4):
        raise ValueError(
            f"its reward at the goal is not the same everywhere: from {low:.6g} to {high:.6g} at observed goals"
        )
    return high


def _some(goals: Floats, n: int = 100) -> Floats:
    """At most ``n`` of the goals, evenly spaced."""
    chosen: Floats = goals[np.unique(np.linspace(0, len(goals) - 1, n).astype(int))]
    return chosen


def _pairs(probe: Probe, rng: np.random.Generator, n: int = 1000) -> tuple[Floats, Floats]:
    """Achieved goals with the desired ones of any moment, and with goals achieved at another."""
    i, j, k = rng.integers(len(probe.achieved), size=(3, n))
    achieved, desired = probe.achieved, probe.desired
    return np.concatenate([achieved[i], achieved[i]]), np.concatenate([desired[j], achieved[k]])


def _own_test(env: Env, best: float, probe: Probe, near: SubgoalSpace | None) -> SuccessTest:
    """The success test of a task with a dense reward.

    :raises ValueError: if it has none
    """
    some = _some(probe.achieved, 20), _some(probe.desired, 20)
    for name in OWN_TESTS:
        try:
            attrgetter(name)(env.unwrapped)
        except AttributeError:
            continue
        singly = SuccessTest(best, name, False).function_for(env)(*some)
        try:
            vectorised = np.array_equal(SuccessTest(best, name).function_for(env)(*some), singly)
        except Exception:  # A function of the task's own may fail in any way on a batch.
            vectorised = False
        return SuccessTest(best, name, vectorised)
    if near is not None:
        return SuccessTest(best, near=near)
    raise ValueError(
        "its reward is dense, and no success test of its own tells when a goal is reached; use its sparse variant, or "
        "give the distances that count as reached: thresholds=..., with a command --hyperparams subgoals.thresholds:0.1"
    )


def _disagreements(test: Test, probe: Probe) -> int:
    """In how many steps a test contradicts what ``info`` said."""
    told = [i for i, said in enumerate(probe.successes) if said is not None]
    if not told:
        return 0
    found = test(probe.achieved[told], probe.desired[told])
    return int(sum(bool(f) != probe.successes[i] for f, i in zip(found, told, strict=True)))
