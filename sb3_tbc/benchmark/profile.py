"""Times of the parts of a training step: a stopwatch around the functions that a step calls."""

from __future__ import annotations

import time
from collections import Counter
from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager
from typing import ParamSpec, TypeVar

from stable_baselines3.common.vec_env import VecEnv

from sb3_tbc.level.level import SACLevel
from sb3_tbc.smdp import HierarchicalVecEnv
from sb3_tbc.tbc_hrl.collection import Collector, EpisodeStore
from sb3_tbc.tbc_hrl.tbc_hrl import TBCHRL

PARTS = ("environment", "wrappers", "acting", "bookkeeping", "storing", "batches", "updates")
"""The task's own ``step`` and ``reset``; Gymnasium's and SB3's wrappers around it; both levels' actions; options,
recording and the loop; relabelling and storing finished episodes; drawing batches with hindsight; the updates."""

OUTSIDE = ("wrappers", "acting", "bookkeeping", "storing")
"""Parts that are neither updates, nor drawing batches, nor the environment's own step."""

P = ParamSpec("P")
Result = TypeVar("Result")


class Stopwatch:
    """Time spent in each of several parts, without the time of other parts that they call."""

    def __init__(self) -> None:
        self.seconds: dict[str, float] = {}
        self.calls: Counter[tuple[str, str]] = Counter()  # by caller's part and own
        self._open: list[str] = []
        self._since = 0.0

    def enter(self, part: str) -> None:
        """Charge time to this part from now on."""
        now = time.perf_counter()
        if self._open:
            self._charge(now)
            self.calls[self._open[-1], part] += 1
        self._open.append(part)
        self._since = now

    def leave(self) -> None:
        """Charge time to the calling part again."""
        now = time.perf_counter()
        self._charge(now)
        self._open.pop()
        self._since = now

    def _charge(self, now: float) -> None:
        part = self._open[-1]
        self.seconds[part] = self.seconds.get(part, 0.0) + now - self._since

    def timed(self, part: str, function: Callable[P, Result]) -> Callable[P, Result]:
        """The function, charged to a part."""

        def run(*args: P.args, **kwargs: P.kwargs) -> Result:
            self.enter(part)
            try:
                return function(*args, **kwargs)
            finally:
                self.leave()

        return run

    @contextmanager
    def watching(self, owner: object, name: str, part: str) -> Iterator[None]:
        """Charge calls of ``owner.name`` to a part, for a while."""
        own = vars(owner).get(name)
        setattr(owner, name, self.timed(part, getattr(owner, name)))
        try:
            yield
        finally:
            if own is None:
                delattr(owner, name)
            else:
                setattr(owner, name, own)


def watching_cost(rounds: int = 20_000) -> tuple[float, float]:
    """Seconds of CPU time that watching a call adds to the caller's part and to its own."""
    watch, nothing = Stopwatch(), int
    watched = watch.timed("own", nothing)
    cpu, begin = time.process_time(), time.perf_counter()
    for _ in range(rounds):
        nothing()
    bare = time.perf_counter() - begin
    watch.enter("caller")
    for _ in range(rounds):
        watched()
    watch.leave()
    on_cpu = (time.process_time() - cpu) / (time.perf_counter() - begin)
    return on_cpu * max(watch.seconds["caller"] - bare, 0.0) / rounds, on_cpu * watch.seconds["own"] / rounds


def profile(model: TBCHRL, steps: int) -> dict[str, float]:
    """Learn for some steps; microseconds per environment step in each of :data:`PARTS`, CPU time.

    Reading the CPU clock takes two microseconds, so parts are measured with the wall clock, which takes a seventh of
    that. The results are multiplied by the share of the time in which this process was on the CPU. The cost of the
    measurement itself, about a microsecond for each of ten calls per step, is measured and subtracted.

    :param steps: environment steps, in whole episodes if the parts are to add up
    """
    watch = Stopwatch()
    before, cpu, wall = model.num_timesteps, time.process_time(), time.perf_counter()
    with ExitStack() as stack:
        for owner, name, part in _watched(model):
            stack.enter_context(watch.watching(owner, name, part))
        model.learn(steps, reset_num_timesteps=False, log_interval=10)
    on_cpu = (time.process_time() - cpu) / (time.perf_counter() - wall)
    done = model.num_timesteps - before
    seconds = {part: on_cpu * watch.seconds.get(part, 0.0) for part in PARTS}
    outer, own = watching_cost()
    for (caller, part), calls in watch.calls.items():
        seconds[caller] -= outer * calls
        seconds[part] -= own * calls
    return {part: 1e6 * max(seconds[part], 0.0) / done for part in PARTS}


def _watched(model: TBCHRL) -> list[tuple[object, str, str]]:
    """The functions to measure, with their parts. Nested calls are charged to the innermost part."""
    venv = model.env
    if not isinstance(venv, VecEnv):
        raise ValueError("the model has no environment; profiling needs one")
    watched: list[tuple[object, str, str]] = [
        (Collector, "act", "acting"),
        (Collector, "propose", "acting"),
        (Collector, "step", "bookkeeping"),
        (HierarchicalVecEnv, "reset", "bookkeeping"),
        (TBCHRL, "collect_rollouts", "bookkeeping"),
        (TBCHRL, "dump_logs", "bookkeeping"),
        (EpisodeStore, "add", "storing"),
        (SACLevel, "train", "updates"),
        (TBCHRL, "train", "updates"),
        (model.replay_buffer.high, "sample_burst", "batches"),
        (model.replay_buffer.high, "sample_labelled", "batches"),  # with a duration loss
        (model.replay_buffer.low, "sample_burst", "batches"),
        (model.replay_buffer.low, "sample_pairs", "batches"),  # for the reachability estimate
        (venv, "step_async", "wrappers"),
        (venv, "step_wait", "wrappers"),
        (venv, "reset", "wrappers"),
    ]
    for env in venv.get_attr("unwrapped"):
        watched += [(env, "step", "environment"), (env, "reset", "environment")]
    return watched
