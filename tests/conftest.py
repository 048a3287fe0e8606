"""One torch thread and one BLAS thread: more are slower on small networks and make timings depend on the machine."""

from __future__ import annotations

import os
import signal

os.environ.setdefault("OMP_NUM_THREADS", "1")
os.environ.setdefault("MPLBACKEND", "Agg")
os.environ.setdefault("PYTHONHASHSEED", "0")

import pytest
import torch as th

th.set_num_threads(1)
signal.signal(signal.SIGINT, signal.default_int_handler)  # ignored where a shell runs the tests in the background


@pytest.fixture(autouse=True)
def one_thread() -> None:
    """Some libraries raise the thread count when imported."""
    th.set_num_threads(1)
