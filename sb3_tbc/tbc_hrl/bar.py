"""SB3's progress bar, as far as what takes long before the first step is to be seen on it."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any

from stable_baselines3.common.callbacks import BaseCallback, CallbackList, ProgressBarCallback


def progress_bar_of(callback: BaseCallback) -> Any | None:
    """The bar that SB3 shows while learning; None without one.

    :param callback: what ``learn`` calls, its training started
    """
    if isinstance(callback, CallbackList):
        return next(filter(None, map(progress_bar_of, callback.callbacks)), None)
    return callback.pbar if isinstance(callback, ProgressBarCallback) else None


@contextmanager
def described(bar: Any | None, text: str) -> Iterator[None]:
    """Show a text on the bar for a while.

    :param bar: a tqdm bar, or None: nothing is shown
    :param text: what is going on
    """
    if bar is None or not text:
        yield
        return
    bar.set_description(text)
    try:
        yield
    finally:
        bar.set_description(None)
