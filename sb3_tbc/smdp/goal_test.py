"""A task's own reward and termination as functions of achieved and desired goals, as hindsight needs them."""

from __future__ import annotations

import warnings
from copy import deepcopy
from functools import cached_property

import numpy as np
from numpy.typing import ArrayLike
from stable_baselines3.common.vec_env import VecEnv

from sb3_tbc.aliases import Plain, PlainMapping
from sb3_tbc.arrays import AnyArray, BoolArray, FloatArray
from sb3_tbc.errors import ConfigError, NonFiniteError
from sb3_tbc.outside import one_line
from sb3_tbc.smdp.goal_spaces import GOAL_KEYS, check_goal_space, goal_space_problems, said_success
from sb3_tbc.smdp.hindsight import GoalTest

TRIED = 3
"""Goals on which a task's functions are tried before learning begins; one more where goals have as many entries."""


def goal_test_of(venv: VecEnv) -> GoalTest:
    """The task's reward and termination, asked of the first environment, as SB3's hindsight replay does.

    A task needs ``compute_reward(achieved_goal, desired_goal, info)`` alone, for batches; ``info`` is empty. Without
    ``compute_terminated`` a goal ends the task where its reward is as high as that of the goal itself.
    """

    def ask(method: str, achieved: FloatArray, desired: FloatArray) -> AnyArray:
        answer = np.asarray(venv.env_method(method, achieved, desired, {}, indices=[0])[0])
        if answer.shape != (len(achieved),):
            raise ConfigError(
                f"{method}(achieved_goal, desired_goal, info) must give one value for each of {len(achieved)} goals, "
                f"got shape {answer.shape}. Vectorise it: goals are arrays (n, goal_dim)"
            )
        return answer

    def reward(achieved: FloatArray, desired: FloatArray) -> FloatArray:
        rewards = ask("compute_reward", achieved, desired).astype(np.float64)
        if not np.isfinite(rewards).all():
            row = int(np.flatnonzero(~np.isfinite(rewards))[0])
            raise NonFiniteError(
                f"compute_reward gives {rewards[row]} for achieved_goal {achieved[row].tolist()} and desired_goal "
                f"{desired[row].tolist()}"
            )
        return rewards

    def as_good_as_the_goal(achieved: FloatArray, desired: FloatArray) -> BoolArray:
        return np.asarray(reward(achieved, desired) >= reward(desired, desired))

    def flags(answers: ArrayLike) -> BoolArray:
        array = np.asarray(answers)
        if array.dtype != np.bool_ and not (array.dtype.kind in "iuf" and np.isin(array, (0, 1)).all()):
            raise ConfigError(
                "compute_terminated(achieved_goal, desired_goal, info) must give True or False for each goal, got "
                f"{one_line(array.tolist(), 100)}"
            )
        return array.astype(bool)

    def terminated(achieved: FloatArray, desired: FloatArray) -> BoolArray:
        answer = venv.env_method("compute_terminated", achieved, desired, {}, indices=[0])[0]
        if np.shape(answer) == ():  # the mazes of Gymnasium-Robotics take one pair at a time
            pairs = zip(achieved, desired, strict=True)
            return flags([venv.env_method("compute_terminated", a, d, {}, indices=[0])[0] for a, d in pairs])
        return flags(ask("compute_terminated", achieved, desired))

    return GoalTest(reward, terminated if venv.has_attr("compute_terminated") else as_good_as_the_goal)


def check_goal_test(venv: VecEnv, listed_infos: bool = False) -> None:
    """Try the calls that learning makes, on goals from the task's own goal space, before anything is learnt.

    :param listed_infos: also try a list of empty infos, one for each goal, as SB3's hindsight replay gives it
    :raises ConfigError: if the task does not have the functions, or they do not take batches
    """
    if not venv.has_attr("compute_reward"):
        raise ConfigError(
            "the environment has no compute_reward(achieved_goal, desired_goal, info), which learning in hindsight "
            "needs; derive it from gymnasium_robotics.core.GoalEnv"
        )
    _refuse_other_goals(venv)
    space = deepcopy(check_goal_space(venv.observation_space)["achieved_goal"])
    space.seed(0)
    # as many goals as entries would look alike to a function that takes a batch for one goal
    n = TRIED + (space.shape == (TRIED,))
    achieved, desired = (np.stack([space.sample() for _ in range(n)]).astype(np.float64) for _ in range(2))
    try:
        test = goal_test_of(venv)
        given = achieved.copy(), desired.copy()
        test.reward(achieved, desired)
        test.terminated(achieved, desired)
        if listed_infos:
            venv.env_method("compute_reward", achieved, desired, [{}] * n, indices=[0])
        if not (np.array_equal(given[0], achieved) and np.array_equal(given[1], desired)):
            raise ConfigError(
                "compute_reward or compute_terminated changes the goals that it is given (as 'achieved_goal -= ...' "
                "does), which are what is learnt from: let it work on new arrays, achieved_goal - desired_goal"
            )
    except (ConfigError, NonFiniteError):
        raise
    except Exception as error:  # a task's own code may fail in any way
        raise ConfigError(
            f"compute_reward or compute_terminated fails on a batch of {n} goals with an empty info"
            f"{', or a list of empty ones as SB3 gives it' if listed_infos else ''}: {type(error).__name__}: {error}. "
            "Vectorise it: goals are arrays (n, goal_dim). Learning in hindsight asks for rewards of goals that were "
            "never the task's, of whose steps there is no info: let them depend on the goals alone"
        ) from error


def _refuse_other_goals(venv: VecEnv) -> None:
    """Refuse goals of another size than the task's own, which is asked about them.

    :raises ConfigError: if a wrapper of the vector has changed them
    """
    task = venv.unwrapped.observation_space
    if goal_space_problems(task):  # a wrapper of the vector has made the goals
        return
    for key in GOAL_KEYS[1:]:
        own, given = task[key].shape, venv.observation_space[key].shape  # type: ignore[index]
        if own != given:
            raise ConfigError(
                f"a wrapper of the vector (VecFrameStack) makes {key} of shape {given}, that of the task is {own}, "
                "whose compute_reward hindsight asks: it would take parts of earlier goals for the present one. Leave "
                "goals as they are: wrap each environment in one that changes 'observation' alone"
            )


class RewardComparison:
    """Warns, once, where an episode's rewards are not those that ``compute_reward`` gives.

    Hindsight asks ``compute_reward`` for the rewards of other goals, so that an agent would learn from both kinds.
    """

    def __init__(self) -> None:
        self._done = False

    def __call__(self, goal_test: GoalTest, achieved: FloatArray, desired: FloatArray, rewards: FloatArray) -> None:
        """Look at the first episode that has more than one step.

        :param achieved: goals after the steps, ``(n, goal_dim)``
        :param desired: the task's at these moments
        :param rewards: of the steps, ``(n,)``; the last may pay for more than the goal, as for a fall
        """
        if self._done or len(rewards) < 2:
            return
        self._done = True
        given = np.asarray(rewards[:-1], dtype=np.float64)
        computed = goal_test.reward(achieved[:-1], desired[:-1])
        off = ~np.isclose(given, computed, rtol=1e-4, atol=1e-5)
        if off.any():
            step = int(off.argmax())
            warnings.warn(
                f"step {step + 1} of the first episode gave the reward {given[step]:.6g}, compute_reward gives "
                f"{computed[step]:.6g}: learning in hindsight mixes the two. If a wrapper changes rewards "
                "(TransformReward, NormalizeReward), leave it out, or let compute_reward change them alike.",
                stacklevel=2,
            )


class EpisodeJudge:
    """Says whether episodes ended at their goals.

    :param venv: the environments
    """

    def __init__(self, venv: VecEnv) -> None:
        self._venv = venv
        self._warned = False

    def __getstate__(self) -> Plain:
        """The state without the goal test: a copy asks its own environments."""
        return {name: value for name, value in self.__dict__.items() if name != "goal_test"}

    @cached_property
    def goal_test(self) -> GoalTest:
        """The task's own reward and end for any goals."""
        return goal_test_of(self._venv)

    def succeeded(self, info: PlainMapping) -> bool:
        """Whether an episode succeeded: as the task says in ``info``, else as its functions judge the last goals.

        :param info: of the step that ended the episode
        """
        said = said_success(info)
        if said is not None:
            return said
        if self._venv.has_attr("compute_reward"):
            last = info["terminal_observation"]
            achieved, desired = (np.asarray(last[key], dtype=np.float64)[None] for key in GOAL_KEYS[1:])
            return bool(self.goal_test.terminated(achieved, desired)[0])
        if not self._warned:
            warnings.warn(
                "the environment does not say whether its episodes succeed (no info['is_success'], no compute_reward): "
                "a success rate of 0 means that nothing is known",
                stacklevel=2,
            )
            self._warned = True
        return False
