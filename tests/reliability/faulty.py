"""Corridors that fail: in what they give, or altogether; at a chosen step of an episode, or at its reset."""

from __future__ import annotations

import os
import signal
import time
from typing import Any, NamedTuple

import gymnasium as gym
import numpy as np
from corridor import Corridor
from gymnasium import spaces

KEYS = ("observation", "achieved_goal", "desired_goal")
VALUES = {"nan": np.nan, "infinite": np.inf}


class Fault(NamedTuple):
    """What goes wrong, once.

    :param kind: ``nan``, ``infinite``, ``shape``, ``raise``, ``hang`` or ``die``
    :param key: which part; ``reward`` for the reward
    :param episode: of the environment, counted from 1
    :param step: of that episode; 0 for its reset
    """

    kind: str
    key: str = "observation"
    episode: int = 3
    step: int = 4
    always: bool = False  # from then on, not once


class Faulty(Corridor):
    """A corridor of 12 steps with a fault.

    Its observation does not depend on the number of its episode, so that a run that is gone on with can be compared
    with one that nothing happened to.
    """

    def __init__(self, fault: Fault | None = None) -> None:
        super().__init__(max_episode_steps=12)
        box = spaces.Box(-np.inf, np.inf, (2,), np.float64)
        self.observation_space = spaces.Dict(
            observation=spaces.Box(-np.inf, np.inf, (3,), np.float64), achieved_goal=box, desired_goal=box
        )
        self.subgoals = _subgoals()
        self.fault, self.begun = fault, 0

    def _observation(self) -> dict[str, Any]:
        seen = super()._observation()
        seen["observation"][2] = 1.0
        return {k: v if k == "observation" else np.append(v, 0.0) for k, v in seen.items()}

    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None) -> Any:
        self.begun += 1
        observation, info = super().reset(seed=seed, options=options)
        return (self._spoilt(observation, 0.0)[0] if self._now() else observation), info

    def step(self, action: Any) -> Any:
        observation, reward, *rest = super().step(action)
        if self._now():
            observation, reward = self._spoilt(observation, reward)
        return observation, reward, *rest

    def _now(self) -> bool:
        if self.fault is None:
            return False
        here, at = (self.begun, self.steps), (self.fault.episode, self.fault.step)
        return here >= at if self.fault.always else here == at

    def _spoilt(self, observation: dict[str, Any], reward: float) -> tuple[Any, Any]:
        assert self.fault is not None
        kind, key = self.fault.kind, self.fault.key
        if kind == "raise":
            raise RuntimeError("simulator lost")
        if kind == "die":
            os.kill(os.getpid(), signal.SIGKILL)
        if kind == "hang":
            time.sleep(3600)
        if key == "reward":
            return observation, [1.0, 2.0] if kind == "shape" else VALUES[kind]
        observation[key] = np.zeros(1) if kind == "shape" else np.full(observation[key].shape, VALUES[kind])
        return observation, reward


def _subgoals() -> Any:
    from sb3_tbc.smdp.spaces import SubgoalSpace

    return SubgoalSpace.from_slices(
        [-1.0], [1.0], [0.05], [("achieved_goal", 0, 1)], local_scale=[1.0, 50.0, 100.0], names=["position"]
    )


class Once(Faulty):
    """As a registered environment: its fault is named in words."""

    def __init__(self, kind: str = "", key: str = "observation", episode: int = 12, **_: Any) -> None:
        super().__init__(Fault(kind, key, episode) if kind else None)


if "FaultyCorridor-v0" not in gym.registry:
    gym.register("FaultyCorridor-v0", Once)
