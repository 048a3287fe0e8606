"""Tracing and compiling an update, with a clear choice between compiled and eager."""

from __future__ import annotations

import logging
from collections.abc import Callable, Sequence

import torch as th
from torch.fx.experimental.proxy_tensor import make_fx

logger = logging.getLogger(__name__)


def compiler_problem() -> str | None:
    """Why nothing can be compiled here, or None if a C++ compiler is found."""
    from torch._inductor.cpp_builder import get_cpp_compiler
    from torch._inductor.exc import InvalidCxxCompiler

    try:
        get_cpp_compiler()
    except InvalidCxxCompiler as error:
        return str(error).splitlines()[0]
    return None


def compile_step(step: Callable[..., None], example: Sequence[th.Tensor], compile: bool | str) -> Callable[..., None]:
    """Compile a function that changes its tensor arguments in place.

    :param step: the function; all arguments are tensors
    :param example: arguments of the shapes to compile for; they are not changed
    :param compile: True, False, or "auto": compile if there is a C++ compiler, else say so in the log and run eagerly
    :return: the compiled function, or ``step`` itself
    :raises ValueError: for another value of ``compile``
    :raises RuntimeError: if ``compile=True`` and there is no C++ compiler
    """
    if compile not in (True, False, "auto"):
        raise ValueError(f"compile must be 'auto', True or False, got {compile!r}")
    if compile is False:
        return step
    problem = compiler_problem()
    if problem is None:
        graph = make_fx(step)(*(x.clone() for x in example))
        compiled: Callable[..., None] = th.compile(graph, fullgraph=True, dynamic=False, options={"cpp_wrapper": True})
        return compiled
    if compile is True:
        raise RuntimeError(f"compile=True, but {problem}; install g++ or clang++, or use compile='auto' or False")
    logger.warning("updates run eagerly, about 4 times slower than compiled: %s", problem)
    return step
