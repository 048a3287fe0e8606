"""Stopping on a signal: it sets a flag, and the work stops at the next point from which it can be resumed exactly."""

from __future__ import annotations

import contextlib
import signal
import sys
import threading
from collections.abc import Callable, Iterator
from types import FrameType

from stable_baselines3.common.vec_env import VecEnv, VecEnvWrapper
from stable_baselines3.common.vec_env.base_vec_env import VecEnvObs, VecEnvStepReturn

SIGNALS = ("SIGINT", "SIGTERM", "SIGHUP")
"""Ctrl-C, a polite kill or a shutdown, and a lost connection."""


class StopRequest:
    """Whether this process was asked to stop; once true, it stays true."""

    def __init__(self) -> None:
        self.signal: str | None = None
        self._tell: Callable[[], None] | None = None

    def calls(self, tell: Callable[[], None]) -> None:
        """Register what to call on a request to stop (at once if there was one already); it may only set a flag."""
        self._tell = tell
        if self:
            tell()

    def __bool__(self) -> bool:
        return self.signal is not None

    def ask(self, number: int, frame: FrameType | None = None) -> None:
        """Record a signal. Further ones change nothing, so that an impatient second Ctrl-C loses no work."""
        again, self.signal = self.signal is not None, signal.Signals(number).name
        if self._tell is not None:
            self._tell()
        with contextlib.suppress(OSError, ValueError, RuntimeError):  # the terminal may be gone, or writing already
            print(
                f"\n{self.signal}: stopping already; `kill -9` ends it without saving"
                if again
                else f"\n{self.signal}: stopping at the next point from which the run can be resumed",
                file=sys.stderr,
                flush=True,
            )


class StopEvaluation(Exception):
    """The user asked to stop while episodes run that can be repeated."""


class StoppableVecEnv(VecEnvWrapper):
    """Environments of an evaluation, which is given up where a stop is asked for.

    :param venv: the environments
    :param stop: tells whether the user asked to stop; then the next step raises :class:`StopEvaluation`
    """

    def __init__(self, venv: VecEnv, stop: StopRequest) -> None:
        super().__init__(venv)
        self.stop = stop

    def reset(self) -> VecEnvObs:
        """Begin new episodes."""
        return self.venv.reset()

    def step_wait(self) -> VecEnvStepReturn:
        """Finish the step.

        :raises StopEvaluation: when stopped
        """
        result = self.venv.step_wait()  # processes are waiting for nothing when this one ends
        if self.stop:
            raise StopEvaluation
        return result


@contextlib.contextmanager
def stop_request() -> Iterator[StopRequest]:
    """Let signals set a flag within the block; before and after it they do what they did.

    In a thread other than the main one signals cannot be caught: the flag stays unset.
    """
    request = StopRequest()
    before = {}
    if threading.current_thread() is threading.main_thread():
        for name in SIGNALS:
            number = getattr(signal, name, None)  # Windows has no SIGHUP
            if number is not None and signal.getsignal(number) != signal.SIG_IGN:  # nohup, a script's background
                before[number] = signal.signal(number, request.ask)
    try:
        yield request
    finally:
        for number, handler in before.items():
            signal.signal(number, handler)
