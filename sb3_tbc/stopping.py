"""Stopping on a signal: it sets a flag, and the work stops at the next point from which it can be resumed exactly."""

from __future__ import annotations

import contextlib
import signal
import sys
import threading
from collections.abc import Callable, Iterator
from types import FrameType

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
