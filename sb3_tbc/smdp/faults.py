"""Errors for environments that raise, die or hang: one line that names the environment and the step."""

from __future__ import annotations

import time
from multiprocessing.process import BaseProcess

from stable_baselines3.common.vec_env import SubprocVecEnv, VecEnv
from stable_baselines3.common.vec_env.base_vec_env import VecEnvStepReturn

from sb3_tbc.arrays import AnyArray
from sb3_tbc.errors import ConfigError, EnvironmentFault, HierarchyError, NonFiniteError

STEP_TIMEOUT = 60.0
"""Seconds that a worker process of a ``SubprocVecEnv`` may take for a step or a reset before it counts as hanging."""
PASSED_ON = (EnvironmentFault, NonFiniteError, ConfigError, HierarchyError)


def fault(index: int, step: int, error: Exception) -> Exception:
    """The error to raise when an environment raised ``error``: it names the environment and the step of its episode."""
    if isinstance(error, PASSED_ON):
        return error
    doing = f"at step {step} of its episode" if step else "at its reset"
    return EnvironmentFault(f"environment {index} failed {doing}: {type(error).__name__}: {error}")


def step_or_name(venv: VecEnv, actions: AnyArray, steps: AnyArray) -> VecEnvStepReturn:
    """Step a vector of environments; a worker process that died or hangs is named instead of waited for.

    :param steps: steps of the running episodes so far, ``(n_envs,)``, for the message
    :raises EnvironmentFault: naming environment and step
    """
    workers = venv.unwrapped
    if not isinstance(workers, SubprocVecEnv):
        return venv.step(actions)
    try:
        venv.step_async(actions)
        _wait(workers, steps)
        return venv.step_wait()
    except (EOFError, ConnectionError) as error:
        raise EnvironmentFault(_dead(workers, steps)) from error


def _wait(workers: SubprocVecEnv, steps: AnyArray) -> None:
    until = time.monotonic() + STEP_TIMEOUT
    for index, (remote, process) in enumerate(zip(workers.remotes, workers.processes, strict=True)):
        while not remote.poll(min(max(until - time.monotonic(), 0.0), 0.5)):
            if not process.is_alive():  # its end of the pipe may live on in processes that were forked later
                raise EOFError
            if time.monotonic() >= until:
                raise EnvironmentFault(
                    f"environment {index} hangs at step {steps[index] + 1} of its episode: its process gave no answer "
                    f"for {STEP_TIMEOUT:.0f} s"
                )


def _dead(workers: SubprocVecEnv, steps: AnyArray) -> str:
    processes: list[BaseProcess] = workers.processes
    until = time.monotonic() + 1.0  # a process that has just closed its pipe takes a moment to be gone
    while time.monotonic() < until and all(process.is_alive() for process in processes):
        time.sleep(0.01)
    for index, process in enumerate(processes):
        if not process.is_alive():
            code = process.exitcode or 0
            how = f"was killed by signal {-code}" if code < 0 else f"ended with exit status {code}"
            return (
                f"the process of environment {index} {how} at step {steps[index] + 1} of its episode; an error of the "
                "environment is printed above"
            )
    return "the process of an environment closed its connection"
