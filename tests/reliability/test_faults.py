"""Environments that raise, die or hang are named, with the step of their episode."""

from __future__ import annotations

import os
import signal
from collections.abc import Iterator
from functools import partial

import numpy as np
import pytest
from corridor import Corridor
from stable_baselines3.common.vec_env import SubprocVecEnv

from sb3_tbc.errors import EnvironmentFault
from sb3_tbc.smdp import faults
from sb3_tbc.smdp.goal_vec_env import GoalVecEnv


class Failing(Corridor):
    """Its third step fails."""

    taken = 0

    def step(self, action):
        self.taken += 1
        if self.taken == 3:
            raise RuntimeError("simulator lost")
        return super().step(action)


@pytest.fixture
def workers() -> Iterator[SubprocVecEnv]:
    env = SubprocVecEnv([Corridor, Corridor], start_method="fork")
    env.reset()
    yield env
    for process in env.processes:
        os.kill(process.pid, signal.SIGKILL) if process.is_alive() else None


def actions(env: GoalVecEnv | SubprocVecEnv) -> np.ndarray:
    return np.zeros((2, *env.action_space.shape), np.float32)


def test_one_that_raises() -> None:
    env = GoalVecEnv([partial(Corridor, goal=0.9), partial(Failing, goal=0.9)])  # too far to be met by chance
    env.reset()
    for _ in range(2):
        env.step(actions(env))
    with pytest.raises(
        EnvironmentFault, match=r"environment 1 failed at step 3 of its episode: RuntimeError: simulator"
    ):
        env.step(actions(env))


def test_a_process_that_dies(workers: SubprocVecEnv) -> None:
    faults.step_or_name(workers, actions(workers), np.array([0, 0]))
    os.kill(workers.processes[1].pid, signal.SIGKILL)
    with pytest.raises(EnvironmentFault, match="process of environment 1 was killed by signal 9 at step 5"):
        faults.step_or_name(workers, actions(workers), np.array([4, 4]))


def test_a_process_that_hangs(workers: SubprocVecEnv, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(faults, "STEP_TIMEOUT", 0.5)
    os.kill(workers.processes[0].pid, signal.SIGSTOP)
    with pytest.raises(EnvironmentFault, match="environment 0 hangs at step 2 of its episode"):
        faults.step_or_name(workers, actions(workers), np.array([1, 1]))
