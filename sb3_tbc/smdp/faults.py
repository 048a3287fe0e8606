"""Errors for environments that raise, die or hang: one line that names the environment and the step."""

from __future__ import annotations

import contextlib
import time
from collections.abc import Iterator
from multiprocessing.process import BaseProcess
from typing import Any

from stable_baselines3.common.vec_env import DummyVecEnv, SubprocVecEnv, VecEnv
from stable_baselines3.common.vec_env.base_vec_env import VecEnvObs, VecEnvStepReturn

from sb3_tbc.arrays import AnyArray
from sb3_tbc.errors import ConfigError, EnvironmentFault, HierarchyError, NonFiniteError

STEP_TIMEOUT = 60.0
"""Seconds that a worker process of a ``SubprocVecEnv`` may take for an answer before it counts as hanging."""
PASSED_ON = (EnvironmentFault, NonFiniteError, ConfigError, HierarchyError)


class WorkerFault(EnvironmentFault):
    """The process of an environment died or hangs.

    :param index: of the environment
    :param what: what became of it, before and after the words that say when
    """

    def __init__(self, index: int, what: tuple[str, str]) -> None:
        super().__init__(f"{what[0]}{what[1]}")
        self.index, self.what = index, what

    def at(self, step: int) -> EnvironmentFault:
        """The same, with the step of the episode; 0 is its reset."""
        after = " or at the reset after it" if step else ""  # which of the two, only the process knew
        return EnvironmentFault(f"{self.what[0]} {_when(step)}{after}{self.what[1]}")


class WatchedRemote:
    """The end of a pipe to a worker process, which does not wait for ever for an answer.

    :param remote: SB3's end
    :param process: at the other end
    :param index: of its environment
    """

    def __init__(self, remote: Any, process: BaseProcess, index: int) -> None:
        self._remote, self._process, self._index = remote, process, index

    def __getattr__(self, name: str) -> Any:
        """Everything else is the pipe's own."""
        return getattr(self._remote, name)

    def send(self, message: Any) -> None:
        """Send a command.

        :raises WorkerFault: if the process is dead
        """
        try:
            self._remote.send(message)
        except ConnectionError as error:
            raise self._dead() from error

    def recv(self) -> Any:
        """Wait for the answer.

        :raises WorkerFault: if the process is dead, or gives none within :data:`STEP_TIMEOUT`; it is ended then
        """
        until = time.monotonic() + STEP_TIMEOUT
        try:
            while not self._remote.poll(min(max(until - time.monotonic(), 0.0), 0.5)):
                if not self._process.is_alive():  # its end of the pipe may live on in processes that were forked later
                    raise EOFError
                if time.monotonic() >= until:
                    self._process.kill()  # so that closing the environments need not wait for it
                    silent = f": its process gave no answer for {STEP_TIMEOUT:.0f} s"
                    raise WorkerFault(self._index, (f"environment {self._index} hangs", silent))
            return self._remote.recv()
        except (EOFError, ConnectionError) as error:
            raise self._dead() from error

    def _dead(self) -> WorkerFault:
        self._process.join(1.0)  # one that has just closed its pipe takes a moment to be gone
        code = self._process.exitcode
        how = "closed its connection" if code is None else f"ended with exit status {code}"
        how = f"was killed by signal {-code}" if code is not None and code < 0 else how
        what = f"the process of environment {self._index} {how}", "; an error of the environment is printed above"
        return WorkerFault(self._index, what)


def watch(venv: VecEnv) -> None:
    """See that worker processes that die or hang are named instead of waited for; other vectors stay as they are."""
    workers = venv.unwrapped
    if isinstance(workers, SubprocVecEnv) and not isinstance(workers.remotes[0], WatchedRemote):
        ends = zip(workers.remotes, workers.processes, strict=True)
        workers.remotes = tuple(WatchedRemote(end, process, i) for i, (end, process) in enumerate(ends))


def fault(index: int, step: int, error: Exception) -> Exception:
    """The error to raise when an environment raised ``error``: it names the environment and the step of its episode."""
    if isinstance(error, PASSED_ON):
        return error
    return EnvironmentFault(f"environment {index} failed {_when(step)}: {type(error).__name__}: {error}")


def _when(step: int) -> str:
    return f"at step {step} of its episode" if step else "at its reset"


def step_or_name(venv: VecEnv, actions: AnyArray, steps: AnyArray) -> VecEnvStepReturn:
    """Step a vector of environments; a worker process that died or hangs is named instead of waited for.

    :param steps: steps of the running episodes so far, ``(n_envs,)``, for the message
    :raises EnvironmentFault: naming environment and step
    """
    watch(venv)
    try:
        return venv.step(actions)
    except WorkerFault as error:
        _give_up(venv)
        raise error.at(int(steps[error.index]) + 1) from error


def reset_or_name(venv: VecEnv) -> VecEnvObs:
    """Reset a vector of environments, likewise.

    :raises EnvironmentFault: naming the environment
    """
    with named_reset(venv):
        return venv.reset()


NOT_RESET: dict[str, Any] = {"not reset": True}
"""Stands for what the reset of an environment says, until it does."""


@contextlib.contextmanager
def named_reset(venv: VecEnv) -> Iterator[None]:
    """Name the environment that fails, dies or hangs while all of them are reset within the block.

    :raises EnvironmentFault: then
    """
    watch(venv)
    base: Any = venv.unwrapped
    if isinstance(base, DummyVecEnv):
        base.reset_infos = [NOT_RESET] * base.num_envs
    try:
        yield
    except WorkerFault as error:
        _give_up(venv)
        raise error.at(0) from error
    except Exception as error:  # a task's own code may fail in any way
        infos = list(getattr(base, "reset_infos", ()))
        if NOT_RESET not in infos:
            raise
        raise fault(infos.index(NOT_RESET), 0, error) from error


def _give_up(venv: VecEnv) -> None:
    """Nothing is waited for any more, so that the environments can be closed."""
    with contextlib.suppress(AttributeError):
        venv.unwrapped.waiting = False  # type: ignore[attr-defined]
