"""Checks that what an environment shows has the shapes that its space says, before a vector stacks it."""

from __future__ import annotations

from typing import cast

import numpy as np
from gymnasium import spaces
from numpy.typing import ArrayLike
from stable_baselines3.common.vec_env import SubprocVecEnv
from stable_baselines3.common.vec_env.base_vec_env import VecEnvObs, VecEnvStepReturn

from sb3_tbc.aliases import Plain, Space
from sb3_tbc.arrays import Arrays

BAD_STEP = "bad_step"
"""Key of ``info``: what is wrong with what this step, or this reset, gave; the observation is not to be used then."""

Shapes = list[tuple[str, tuple[int, ...] | None]]
"""Names of the parts of an observation with their shapes."""


def shapes_of(space: Space) -> Shapes:
    """The parts of a goal environment's observation with their shapes; none of another space."""
    return [(key, part.shape) for key, part in space.spaces.items()] if isinstance(space, spaces.Dict) else []


def wrong_shape(observation: object, shapes: Shapes) -> str | None:
    """What of an observation has another shape than its space says; None if nothing has.

    :param shapes: names of its parts with their shapes
    """
    parts = observation if isinstance(observation, dict) else {}
    for key, shape in shapes:
        part = parts.get(key)
        if getattr(part, "shape", None) == shape:  # an array, the usual case
            continue
        if part is None or _shape(part) != shape:
            got = "nothing" if part is None else f"shape {_shape(part)}"
            return f"observation[{key!r}] must have shape {shape} as its space says, got {got}"
    return None


def _shape(part: ArrayLike) -> tuple[int, ...] | None:
    """Shape of an array or nested list; None for one that has none."""
    try:
        return np.shape(part)
    except ValueError:
        return None


def reset_checked(workers: SubprocVecEnv, shapes: Shapes) -> VecEnvObs:
    """``SubprocVecEnv.reset``, but an observation of a wrong shape is told of in its ``reset_infos``."""
    for remote, seed, options in zip(workers.remotes, workers._seeds, workers._options, strict=True):
        remote.send(("reset", (seed, options)))
    results = [remote.recv() for remote in workers.remotes]
    told = [checked(observation, info, shapes) for observation, info in results]
    workers.reset_infos = [info for _, info in told]
    workers._reset_seeds()
    workers._reset_options()
    return _stacked([observation for observation, _ in told], workers)


def receive_checked(workers: SubprocVecEnv, shapes: Shapes) -> VecEnvStepReturn:
    """``SubprocVecEnv.step_wait``, but an observation of a wrong shape is told of in ``info``."""
    results = [remote.recv() for remote in workers.remotes]
    workers.waiting = False
    observations, rewards, dones, infos, reset_infos = (list(column) for column in zip(*results, strict=True))
    for index, done in enumerate(dones):
        if not done:
            observations[index], infos[index] = checked(observations[index], infos[index], shapes)
            continue
        last, infos[index] = checked(infos[index]["terminal_observation"], infos[index], shapes)
        infos[index]["terminal_observation"] = last
        observations[index], reset_infos[index] = checked(observations[index], reset_infos[index], shapes)
    workers.reset_infos = reset_infos
    return _stacked(observations, workers), np.stack(rewards), np.stack(dones), infos


def checked(observation: VecEnvObs, info: Plain, shapes: Shapes) -> tuple[Arrays, Plain]:
    """What an environment shows, or zeros and an ``info`` that says which shape is wrong.

    :param shapes: names of its parts with their shapes
    """
    wrong = wrong_shape(observation, shapes)
    if wrong is None:
        return cast(Arrays, observation), info
    return {key: np.zeros(shape or ()) for key, shape in shapes}, {BAD_STEP: wrong}


def _stacked(observations: list[Plain], workers: SubprocVecEnv) -> VecEnvObs:
    space = workers.observation_space
    if not isinstance(space, spaces.Dict):
        return np.stack(observations)  # type: ignore[arg-type]
    return {key: np.stack([seen[key] for seen in observations]) for key in space.spaces}
