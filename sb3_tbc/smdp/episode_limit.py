"""Lets the environment itself end an episode when the high level's decisions are used up.

Only the agent knows when that is, but everything that watches episodes (``Monitor``, ``VecMonitor``, any wrapper) has
to see an ordinary truncation. So the agent announces the last window of an episode when the window begins, and the
environment truncates the step that ends it.
"""

from __future__ import annotations

import time
from typing import Any, NamedTuple, SupportsFloat

import gymnasium as gym
import numpy as np
from gymnasium import spaces
from gymnasium.utils import RecordConstructorArgs
from stable_baselines3.common.vec_env import DummyVecEnv, SubprocVecEnv, VecEnv, VecEnvWrapper
from stable_baselines3.common.vec_env.base_vec_env import VecEnvIndices, VecEnvObs, VecEnvStepReturn

from sb3_tbc.aliases import Env, Plain, Wrapper
from sb3_tbc.arrays import Arrays, BoolArray, FloatArray
from sb3_tbc.errors import ConfigError
from sb3_tbc.outside import one_line
from sb3_tbc.smdp.copyable import CopyableVecEnvWrapper
from sb3_tbc.smdp.faults import fault
from sb3_tbc.smdp.goal_spaces import GOAL_KEYS, goal_space_problems
from sb3_tbc.smdp.shapes import BAD_STEP, receive_checked, reset_checked, shapes_of, wrong_shape
from sb3_tbc.smdp.spaces import GoalObservation, SubgoalSpace

ANNOUNCE = "announce_last_window"
"""Method of an environment that can end an episode for the agent."""

BUDGET_EXHAUSTED = "budget_exhausted"
"""Key of ``info``: the episode ended with this step because the high level's decisions are used up."""

RESETS = "sb3_tbc.resets"
"""Key of ``info``: how often the task was reset so far, which tells whether someone else has begun an episode in it."""


class LastWindow(NamedTuple):
    """The last window that an episode may have.

    Steps are the agent's own, which a wrapper may make of several of the task's (frames that are skipped). So the agent
    itself counts them, and announces the very last one.

    :param ends_now: whether the window ends with the next step
    :param subgoals: to see whether it ends earlier; None: it runs to the end of its budget
    :param subgoal: what was asked for; None where reaching it does not end the window
    """

    ends_now: bool
    subgoals: SubgoalSpace | None = None
    subgoal: FloatArray | None = None

    def over(self, seen: GoalObservation) -> bool:
        """Whether the window is over.

        :param seen: what its last step led to
        """
        if self.ends_now or self.subgoals is None:
            return self.ends_now
        if bool(self.subgoals.happened(seen)):
            return True
        if self.subgoal is None:
            return False
        return bool(self.subgoals.reached(self.subgoals.achieved(seen), self.subgoal))


def announce(venv: VecEnv, index: int, window: LastWindow) -> None:
    """Tell one environment of a vector which window is the last of its episode."""
    venv.env_method(ANNOUNCE, window, indices=[index])


class EpisodeLimit(Wrapper, RecordConstructorArgs):
    """Truncates the step that ends the announced last window; refuses observations and infos of the wrong form.

    :param env: the task itself; wrappers belong around this one, so that they see the end of the episode
    :param index: its number in the vector, for messages
    """

    def __init__(self, env: Env, index: int = 0) -> None:
        RecordConstructorArgs.__init__(self, index=index)
        gym.Wrapper.__init__(self, env)
        self.index = index
        self.task_space = space = env.observation_space
        self._parts = dict(space.spaces) if isinstance(space, spaces.Dict) else {}
        self._shapes = shapes_of(space)
        self._last: LastWindow | None = None
        self._steps = self._resets = 0

    def announce_last_window(self, window: LastWindow) -> None:
        """End the episode with this window."""
        self._last = window

    def reset(self, **kwargs: Any) -> tuple[object, Plain]:
        """Begin an episode, and forget what was announced."""
        self._last, self._steps = None, 0
        self._resets += 1
        try:
            observation, info = self.env.reset(**kwargs)
        except Exception as error:  # a task's own code may fail in any way
            raise fault(self.index, self._steps, error) from error
        wrong = self._wrong(observation, info)
        if wrong is not None:
            return self._blank(), {BAD_STEP: wrong, RESETS: self._resets}
        return observation, {**info, RESETS: self._resets}

    def step(self, action: object) -> tuple[object, SupportsFloat, bool, bool, Plain]:
        """Step; the last observation of an episode is copied, as some environments reuse their arrays.

        Where something is not as it was declared, nothing of the step is handed on: ``info`` says what was wrong, and
        the agent's :class:`.Guard` decides what follows.

        :raises EnvironmentFault: if the task's own code fails, naming environment and step
        """
        self._steps += 1
        try:
            observation, reward, terminated, truncated, info = self.env.step(action)
        except Exception as error:  # a task's own code may fail in any way
            raise fault(self.index, self._steps, error) from error
        wrong = self._wrong(observation, info, reward, terminated, truncated)
        if wrong is not None:
            return self._blank(), 0.0, False, False, {BAD_STEP: wrong, RESETS: self._resets}
        info = {**info, RESETS: self._resets}
        if self._last is not None and not (terminated or truncated):
            truncated = self._last.over(self._as_declared(observation))
            if truncated:
                info[BUDGET_EXHAUSTED] = True
        if (terminated or truncated) and isinstance(observation, dict):
            observation = {key: np.array(part) for key, part in observation.items()}
        return observation, reward, terminated, truncated, info

    def _wrong(
        self,
        observation: object,
        info: object,
        reward: object = 0.0,
        terminated: object = False,
        truncated: object = False,
    ) -> str | None:
        """What is not as it was declared; None if all is."""
        found = wrong_shape(observation, self._shapes)
        if found is None and not isinstance(info, dict):
            found = f"info must be a dictionary, got {info!r}"
        if found is None and not _is_number(reward):
            found = f"its reward must be a number, got {one_line(repr(reward), 100)}"
        for name, value in (("terminated", terminated), ("truncated", truncated)):
            if found is None and not _is_flag(value):  # a text or NaN would count as true, and end the episode
                found = f"{name} must be True or False, got {one_line(repr(value), 100)}"
        return found

    def _blank(self) -> Plain:
        return {key: np.zeros(shape or (), self._parts[key].dtype) for key, shape in self._shapes}

    def _as_declared(self, observation: GoalObservation) -> GoalObservation:
        """The observation in the precision in which vectors of environments hand it on; empty where it is no goal's."""
        if not all(key in self._parts for key in GOAL_KEYS):  # wrappers of the vector make the goals: steps count alone
            return {}
        return {key: np.asarray(observation[key], dtype=self._parts[key].dtype) for key in GOAL_KEYS}


def _is_number(value: object) -> bool:
    return isinstance(value, float | int | np.floating | np.integer) or (
        isinstance(value, np.ndarray) and value.size == 1 and value.dtype.kind in "fiub"
    )


def _is_flag(value: object) -> bool:
    return isinstance(value, bool | np.bool_) or (_is_number(value) and bool(value in (0, 1)))


class LimitingVecEnv(CopyableVecEnvWrapper):
    """As :class:`EpisodeLimit`, for environments that cannot be wrapped one by one, e.g. those in other processes.

    Whatever is wrapped around this vector sees the end of the episode.
    """

    def __init__(self, venv: VecEnv) -> None:
        super().__init__(venv)
        self._last: dict[int, LastWindow] = {}
        self._returns = np.zeros(venv.num_envs)
        self._lengths = np.zeros(venv.num_envs, dtype=np.int64)
        self._resets = np.zeros(venv.num_envs, dtype=np.int64)
        self._began = time.time()
        self._shapes = shapes_of(venv.observation_space)

    def has_attr(self, attr_name: str) -> bool:
        """Whether the environments have an attribute."""
        return attr_name == ANNOUNCE or super().has_attr(attr_name)

    def env_method(
        self, method_name: str, *method_args: Any, indices: VecEnvIndices = None, **method_kwargs: object
    ) -> list[object]:
        """Call a method of the environments; announcements end here."""
        if method_name != ANNOUNCE:
            answers = super().env_method(method_name, *method_args, indices=indices, **method_kwargs)
            for index in self._get_indices(indices) if method_name == "reset" else ():
                self._begin(index)
            return answers
        for index in self._get_indices(indices):
            self._last[index] = method_args[0]
        return []

    def reset(self) -> VecEnvObs:
        """Begin an episode everywhere."""
        if isinstance(self.venv, SubprocVecEnv):
            observation = reset_checked(self.venv, self._shapes)
        else:
            observation = self.venv.reset()
        for index in range(self.num_envs):
            self._begin(index)
        return observation

    def step_wait(self) -> VecEnvStepReturn:
        """Step; end the episodes whose last window is over."""
        there = isinstance(self.venv, SubprocVecEnv)
        observation, rewards, dones, infos = (
            receive_checked(self.venv, self._shapes) if there else self.venv.step_wait()  # type: ignore[arg-type]
        )
        self._returns += rewards
        self._lengths += 1
        for index, info in enumerate(infos):
            info[RESETS] = int(self._resets[index])
        for index, window in list(self._last.items()):
            seen: GoalObservation = {}
            if isinstance(observation, dict):
                seen = {key: observation[key][index] for key in GOAL_KEYS if key in observation}
            if not dones[index] and window.over(seen):
                self._end(index, observation, dones, infos[index])  # type: ignore[arg-type]
        for ended in np.flatnonzero(dones):
            self._begin(int(ended))
        return observation, rewards, dones, infos

    def _begin(self, index: int) -> None:
        """An episode has begun: forget what was announced, and count it where the agent looks."""
        self._last.pop(index, None)
        self._returns[index], self._lengths[index] = 0.0, 0
        self._resets[index] += 1
        told = self.venv.reset_infos
        told[index] = {**(told[index] or {}), RESETS: int(self._resets[index])}

    def _end(self, index: int, observation: Arrays, dones: BoolArray, info: Plain) -> None:
        episode = {"r": float(self._returns[index]), "l": int(self._lengths[index]), "t": time.time() - self._began}
        info |= {BUDGET_EXHAUSTED: True, "TimeLimit.truncated": True, "episode": episode}
        info["terminal_observation"] = {key: np.array(part[index]) for key, part in observation.items()}
        try:
            fresh, self.venv.reset_infos[index] = self.venv.env_method("reset", indices=[index])[0]
        except NotImplementedError as error:
            raise ConfigError(
                f"{type(self.venv).__name__} cannot reset one environment alone, which ends an episode whose decisions "
                "are used up: implement env_method('reset', indices=[i]), or set max_options and dt_max so that "
                "windows outlast episodes"
            ) from error
        for key, part in observation.items():
            part[index] = fresh[key]
        dones[index] = True


class PutLimit:
    """Puts the limit around a task in another process, beneath all its wrappers.

    ``VecEnv.env_is_wrapped`` takes an object of ours there: the process asks whether its outermost wrapper is an
    instance of the class that it is sent. This one is sent in the place of a class, and puts the limit in when asked.

    :param index: the environment's number in the vector
    """

    def __init__(self, index: int) -> None:
        self.index = index

    def __instancecheck__(self, env: Env) -> bool:
        """Put it in, and say yes, so that no wrapper beneath is asked."""
        _put_limit(env, self.index)
        return True


def with_episode_limit(venv: VecEnv) -> VecEnv:
    """Make the environments of a vector able to end an episode for the agent, and return the vector to use.

    The limit goes around each task itself where it can be reached: in this process, and beneath its wrappers in another
    one. Elsewhere it goes around the innermost vector.
    """
    if venv.has_attr(ANNOUNCE):
        return venv
    base: VecEnv = venv
    around: VecEnvWrapper | None = None
    while isinstance(base, VecEnvWrapper):
        around = base
        base = base.venv
    if isinstance(base, DummyVecEnv):
        base.envs = [_put_limit(env, index) for index, env in enumerate(base.envs)]
    elif isinstance(base, SubprocVecEnv) and base.has_attr("class_name"):  # there are wrappers
        for index in range(base.num_envs):
            base.env_is_wrapped(PutLimit(index), indices=[index])  # type: ignore[arg-type]
    elif around is None:
        return LimitingVecEnv(base)
    else:
        around.venv = LimitingVecEnv(base)
    return venv


def can_tell(venv: VecEnv) -> bool:
    """Whether the limit sees what the agent sees, so that it can tell that a subgoal is reached or an event happened.

    :param venv: what the agent acts in, with :func:`with_episode_limit`
    """
    base = venv
    while isinstance(base, VecEnvWrapper) and not isinstance(base, LimitingVecEnv):
        base = base.venv
    if isinstance(base, LimitingVecEnv):
        return bool(base.observation_space == venv.observation_space)
    same = all(space == venv.observation_space for space in venv.get_attr("task_space"))
    return same and not any(venv.env_is_wrapped(gym.ObservationWrapper))  # such a wrapper may keep the space


def _put_limit(env: Env, index: int) -> Env:
    """Put the limit around the task, beneath the wrappers of a goal environment; the outermost environment."""
    layers = [env]
    while isinstance(layers[-1], gym.Wrapper):
        layers.append(layers[-1].env)
    goals = [place for place, layer in enumerate(layers) if not goal_space_problems(layer.observation_space)]
    task = max(goals, default=len(layers) - 1)  # a wrapper may have made the goals
    limited = EpisodeLimit(layers[task], index)
    if task == 0:
        return limited
    holder: Any = layers[task - 1]
    holder.env = limited
    return env
