"""Tracing and compiling an update, with a clear choice between compiled and eager."""

from __future__ import annotations

import logging
import os
import shlex
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager

import torch as th
from torch import fx
from torch.fx.experimental.proxy_tensor import make_fx

logger = logging.getLogger(__name__)

INDUCTOR = {"cpp_wrapper": True}
"""Options of the compiler: kernels are called from C++ too, not only written in it."""


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

    The compiled function checks neither types nor shapes of its arguments: they must be those of ``example``.

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
        try:
            return _compile(step, example)
        except Exception as error:  # whatever a half-installed toolchain brings up
            if compile is True:
                raise
            problem = f"compiling failed with {type(error).__name__}: {_reason(str(error))}"
    if compile is True:
        raise RuntimeError(f"compile=True, but {problem}; install g++ or clang++, or use compile='auto' or False")
    logger.warning("updates run eagerly, several times slower than compiled: %s", problem)
    return step


def _reason(message: str) -> str:
    """The line of a compiler's long message that says what is wrong, else the first one."""
    lines = message.strip().splitlines()
    return next((line.strip() for line in lines if "error:" in line or "cannot find" in line), "".join(lines[:1]))


@contextmanager
def libraries_found() -> Iterator[None]:
    """Let the compiler find torch's libraries in a folder with a space in its name.

    Torch quotes the folders of headers on the compiler's command line, but not that of libraries.
    """
    from torch.utils import cpp_extension

    path = cpp_extension.TORCH_LIB_PATH
    if os.name == "posix":  # elsewhere torch quotes both
        cpp_extension.TORCH_LIB_PATH = shlex.quote(path)
    try:
        yield
    finally:
        cpp_extension.TORCH_LIB_PATH = path


def _compile(step: Callable[..., None], example: Sequence[th.Tensor]) -> Callable[..., None]:
    start = time.perf_counter()
    copies = [x.detach().clone() for x in example]
    graph = make_fx(step)(*copies)
    split_bias_from_products(graph)
    merge_repeated(graph)
    for node in graph.graph.nodes:
        node.meta.clear()  # the compiler derives shapes itself and refuses those of another tracer
    from torch._inductor import standalone_compile

    options = {"config_patches": dict(INDUCTOR)}
    with libraries_found():
        compiled = standalone_compile(graph, [*copies], dynamic_shapes="from_example_inputs", options=options)
    logger.info("compiled an update in %.1f s", time.perf_counter() - start)
    return compiled


def split_bias_from_products(graph: fx.GraphModule) -> None:
    """Turn products with a bias into product and sum.

    With a bias, the library first copies the bias over the whole output; alone, the sum melts into the activation that
    follows. A fifth of a small network's update is such copies.
    """
    aten, nodes = th.ops.aten, graph.graph
    for node in list(nodes.nodes):
        if node.target not in (aten.addmm.default, aten.baddbmm.default) or node.kwargs:
            continue
        bias, left, right = node.args
        with nodes.inserting_before(node):
            if node.target is aten.baddbmm.default:
                product = nodes.call_function(aten.bmm.default, (left, right))
                total = nodes.call_function(aten.add.Tensor, (product, bias))
            else:  # through a third dimension, or the compiler would fuse the two again
                product = nodes.call_function(aten.mm.default, (left, right))
                lifted = nodes.call_function(aten.unsqueeze.default, (product, 0))
                total = nodes.call_function(aten.squeeze.dim, (nodes.call_function(aten.add.Tensor, (lifted, bias)), 0))
        node.replace_all_uses_with(total)
        nodes.erase_node(node)
    graph.recompile()


def merge_repeated(graph: fx.GraphModule) -> None:
    """Compute once what is computed twice between two changes in place (the circuit's conductances, for example)."""
    seen: dict[object, fx.Node] = {}
    for node in list(graph.graph.nodes):
        if node.op != "call_function":
            continue
        schema = getattr(node.target, "_schema", None)
        key = (node.target, repr(node.args), repr(node.kwargs))
        if node.target is th.ops.aten.detach.default:
            node.replace_all_uses_with(node.args[0])
            graph.graph.erase_node(node)
        elif schema is not None and schema.is_mutable:
            seen.clear()
        elif key in seen:
            node.replace_all_uses_with(seen[key])
            graph.graph.erase_node(node)
        else:
            seen[key] = node
    graph.recompile()
