"""The smallest possible time of a training step: the environment's own step and the matrix products of the updates."""

from __future__ import annotations

import math
import time
from collections import Counter
from collections.abc import Callable
from typing import Any, NamedTuple

import torch as th
from torch.utils._python_dispatch import TorchDispatchMode

from sb3_tbc.aliases import Plain
from sb3_tbc.level.level import SACLevel

Shape = tuple[int, int, int, int]
"""Shape of a product: batch size, rows, length of the sums, columns."""

LARGE = 1024
"""Size of the square matrices whose product measures the machine's highest rate."""


class ProductCounter(TorchDispatchMode):
    """Counts the matrix products that run while it is active, by shape."""

    def __init__(self) -> None:
        super().__init__()  # type: ignore[no-untyped-call]
        self.shapes: Counter[Shape] = Counter()

    def __torch_dispatch__(self, func: Any, types: Any, args: tuple[Any, ...] = (), kwargs: Plain | None = None) -> Any:
        aten = th.ops.aten
        if func in (aten.mm.default, aten.addmm.default, aten.bmm.default, aten.baddbmm.default):
            left, right = args[-2:]
            at_once = left.shape[0] if left.dim() == 3 else 1
            self.shapes[(at_once, left.shape[-2], left.shape[-1], right.shape[-1])] += 1
        return func(*args, **kwargs or {})


class Products(NamedTuple):
    """The matrix products of one update."""

    number: int
    flops: float
    microseconds: float  # of all of them, each at the rate that its shape allows here


def products(level: SACLevel, batch_size: int, rounds: int) -> Products:
    """Count and time the products of one update of a level; the level is not changed."""
    with ProductCounter() as counter:
        level._update.rehearse(batch_size, level._ent_coef_state())
    seconds = sum(count * _time_product(shape, rounds) for shape, count in counter.shapes.items())
    flops = sum(2.0 * count * math.prod(shape) for shape, count in counter.shapes.items())
    return Products(sum(counter.shapes.values()), flops, 1e6 * seconds)


def gemm_rate(rounds: int) -> float:
    """The machine's highest rate: floating-point operations per second of a large product, one thread."""
    return 2.0 * LARGE**3 / _time_product((1, LARGE, LARGE, LARGE), rounds, repeats=3)


def _time_product(shape: Shape, rounds: int, repeats: int = 100) -> float:
    """CPU seconds of one product of float32 matrices, the best of several rounds."""
    at_once, rows, inner, columns = shape
    left, right = th.rand(at_once, rows, inner), th.rand(at_once, inner, columns)
    out = th.empty(at_once, rows, columns)
    if at_once == 1:
        left, right, out = left[0], right[0], out[0]
    multiply: Callable[..., th.Tensor] = th.mm if at_once == 1 else th.bmm
    best = math.inf
    with th.inference_mode():
        for _ in range(rounds):
            start = time.process_time()
            for _ in range(repeats):
                multiply(left, right, out=out)
            best = min(best, time.process_time() - start)
    return best / repeats
