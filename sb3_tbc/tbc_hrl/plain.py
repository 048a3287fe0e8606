"""Objects of agents as plain JSON and back: nothing is unpickled, and nothing is made but what is listed here.

SB3 pickles whatever JSON does not know: spaces, classes, schedules, the last observation. Unpickling runs whatever a
stranger put into the file. Here each such object is written as a table with one key that says what it is.
"""

from __future__ import annotations

import dataclasses
import importlib
import sys
from collections import OrderedDict, deque
from collections.abc import Callable, Mapping
from enum import Enum
from functools import partial
from types import FunctionType
from typing import Any

import numpy as np
from gymnasium import spaces
from stable_baselines3.common.buffers import BaseBuffer
from stable_baselines3.common.policies import BasePolicy
from stable_baselines3.common.type_aliases import TrainFreq, TrainFrequencyUnit
from stable_baselines3.common.utils import ConstantSchedule, FloatSchedule, LinearSchedule
from torch import nn

from sb3_tbc.aliases import Plain
from sb3_tbc.arrays import AnyArray, FloatArray
from sb3_tbc.smdp.spaces import SubgoalSpace

SCHEDULES = (ConstantSchedule, FloatSchedule, LinearSchedule)
CLASSES = (BasePolicy, BaseBuffer, nn.Module)
"""Kinds of classes that an agent may name."""
HOMES = ("sb3_tbc.", "stable_baselines3.", "torch.nn.modules.")
"""Modules whose classes and functions an agent may name; naming one imports it, so they must be our own or SB3's."""
PLAIN = "plain"
MAX_DEPTH = 50


class NotPlainError(ValueError):
    """An object that cannot be written without pickle, or a table that describes none; the message names it."""


def encode(value: object) -> Any:
    """An object as plain data.

    :raises NotPlainError: if it holds something that is not listed here
    """
    for kinds, name, write in WRITERS:
        if isinstance(value, kinds):
            return {PLAIN: name, **write(value)} if name else write(value)
    if isinstance(value, SubgoalSpace) or _is_own_data(type(value)):
        return {PLAIN: "object", "class": reference(type(value)), "fields": encode(dict(_fields(value)))}
    raise NotPlainError(f"{type(value).__module__}.{type(value).__qualname__} has no plain form")


def decode(data: object, depth: int = 0) -> Any:
    """The object that :func:`encode` described.

    :raises NotPlainError: if the data describes none
    """
    if depth > MAX_DEPTH:
        raise NotPlainError("nested too deeply")
    if isinstance(data, list):
        return [decode(item, depth + 1) for item in data]
    if not isinstance(data, dict):
        return data
    if PLAIN not in data:
        return {key: decode(item, depth + 1) for key, item in data.items()}
    name = data[PLAIN]
    if not isinstance(name, str) or name not in READERS:
        raise NotPlainError(f"unknown kind {name!r}")
    parts = {key: decode(item, depth + 1) for key, item in data.items() if key != PLAIN}
    try:
        return READERS[name](**parts)
    except NotPlainError:
        raise
    except Exception as error:  # the parts come from a stranger
        raise NotPlainError(f"{name}: {error}") from error


# --------------------------------------------------------------------------------------------- by reference


def reference(thing: type | FunctionType) -> str:
    """Module and name of a class or function.

    :raises NotPlainError: if it is not found under that name, or its module belongs to another package
    """
    name = f"{thing.__module__}:{thing.__qualname__}"
    if find(name) is not thing:
        raise NotPlainError(f"{name} is not found by its name")
    return name


def find(name: str) -> type | FunctionType:
    """The class or function of a reference.

    :raises NotPlainError: if the module belongs to another package, or holds no class or function of that name
    """
    module, _, path = str(name).partition(":")
    if not (module.startswith(HOMES) or _running(module)) or not all(
        part.isidentifier() for part in (*module.split("."), *path.split("."))
    ):
        raise NotPlainError(f"{name} is not part of this package, Stable-Baselines3, torch.nn, or code of yours in use")
    try:
        home = importlib.import_module(module)
        thing: object = home
        for part in path.split("."):
            thing = vars(thing)[part]
    except (ImportError, KeyError, TypeError) as error:
        raise NotPlainError(f"{name} does not exist here") from error
    # a former name leads to a module of another name
    if not isinstance(thing, type | FunctionType) or thing.__module__ != home.__name__ or thing.__qualname__ != path:
        raise NotPlainError(f"{name} is no class or function of {home.__name__}")
    return thing


def _class(name: str) -> type:
    found = find(name)
    if not isinstance(found, type) or not issubclass(found, CLASSES):
        raise NotPlainError(f"{name} is no class that an agent is made of")
    return found


def _function(name: str) -> FunctionType:
    found = find(name)
    ours = name.startswith("sb3_tbc.tasks.")
    if not isinstance(found, FunctionType) or not (ours or _running(found.__module__)):
        raise NotPlainError(f"{name} is no function of a task")
    return found


def _running(module: str) -> bool:
    """Whether a module is the user's own and imported already; installed packages and Python's own are not."""
    origin = getattr(sys.modules.get(module), "__file__", None) or ""
    top = module.partition(".")[0]
    installed = "site-packages" in origin or "dist-packages" in origin or top in sys.stdlib_module_names
    return bool(origin) and not installed and not module.startswith("sb3_tbc")


def _named(read: Callable[[str], object], thing: type | FunctionType) -> str:
    """The reference of a thing, after reading it as loading will."""
    name = reference(thing)
    read(name)
    return name


def _is_own_data(kind: type) -> bool:
    """Whether a class holds plain data of this package."""
    return kind.__module__.startswith("sb3_tbc.") and dataclasses.is_dataclass(kind)


def _fields(value: object) -> Plain:
    if hasattr(value, "to_dict"):  # settings: written by name, checked when read
        return dict(value.to_dict())
    return dict(vars(value))


def _object(fields: Plain, **parts: str) -> object:
    kind = find(parts["class"])
    if not (isinstance(kind, type) and (kind is SubgoalSpace or _is_own_data(kind))):
        raise NotPlainError(f"{parts['class']} holds no plain data")
    if hasattr(kind, "from_dict"):
        return kind.from_dict(fields)
    made: object = object.__new__(kind)
    vars(made).update(fields)
    check = getattr(made, "_check", None) or getattr(made, "__post_init__", None)
    if check is not None:
        check()
    return made


# --------------------------------------------------------------------------------------------- what there is


def _array(value: AnyArray | np.generic) -> Plain:
    array = np.asarray(value)
    if array.dtype.kind not in "biuf":
        raise NotPlainError(f"an array of {array.dtype} has no plain form")
    flat = [v if array.dtype.kind != "f" or np.isfinite(v) else repr(v) for v in array.ravel().tolist()]
    return {"dtype": array.dtype.str, "shape": list(array.shape), "values": flat}


def _read_array(dtype: str, shape: list[int], values: list[float | str]) -> AnyArray:
    kind = np.dtype(dtype)
    if kind.kind not in "biuf":
        raise NotPlainError(f"no plain array holds {dtype}")
    plain = [float(v) if isinstance(v, str) else v for v in values]
    return np.array(plain, dtype=kind).reshape(shape)


def _read_scalar(dtype: str, shape: list[int], values: list[float | str]) -> object:
    return _read_array(dtype, shape, values)[()]


def _write_box(box: spaces.Box) -> Plain:
    return {"low": encode(box.low), "high": encode(box.high)}


def _read_box(low: FloatArray, high: FloatArray) -> spaces.Box:
    return spaces.Box(low, high, dtype=low.dtype)


def _write_dict(table: Mapping[object, object]) -> Plain:
    if not all(isinstance(key, str) and key != PLAIN for key in table):
        return {PLAIN: "pairs", "pairs": [[encode(key), encode(item)] for key, item in table.items()]}
    return {str(key): encode(item) for key, item in table.items()}


def _write_partial(call: partial[object]) -> Plain:
    return {"call": encode(call.func), "arguments": encode(list(call.args)), "named": encode(dict(call.keywords))}


def _read_partial(call: object, arguments: list[object], named: Plain) -> partial[object]:
    if not isinstance(call, FunctionType) or not call.__module__.startswith("sb3_tbc.tasks."):
        raise NotPlainError("only functions of tasks can have arguments filled in")
    return partial(call, *arguments, **named)


def _read_schedule(name: str, fields: Plain) -> object:
    kind = next((kind for kind in SCHEDULES if kind.__name__ == name), None)
    if kind is None:
        raise NotPlainError(f"unknown schedule {name!r}")
    made = object.__new__(kind)
    vars(made).update(fields)
    return made


WRITERS: tuple[tuple[type | tuple[type, ...], str, Callable[[Any], Any]], ...] = (
    ((type(None), bool, str), "", lambda value: value),
    (np.generic, "number", _array),
    (Enum, "unit", lambda value: {"name": TrainFrequencyUnit(value).name}),
    (int, "", int),
    (float, "", float),
    (np.ndarray, "array", _array),
    (spaces.Box, "box", _write_box),
    (spaces.Discrete, "discrete", lambda value: {"n": int(value.n), "start": int(value.start)}),
    (spaces.MultiBinary, "binary", lambda value: {"n": encode(value.n)}),
    (spaces.MultiDiscrete, "discretes", lambda value: {"nvec": encode(value.nvec), "start": encode(value.start)}),
    (spaces.Dict, "spaces", lambda value: {"parts": encode(dict(value.spaces))}),
    (TrainFreq, "train_freq", lambda value: {"frequency": value.frequency, "unit": encode(value.unit)}),
    (tuple, "tuple", lambda value: {"items": [encode(item) for item in value]}),
    (list, "", lambda value: [encode(item) for item in value]),
    (deque, "deque", lambda value: {"items": [encode(item) for item in value], "longest": value.maxlen}),
    (OrderedDict, "ordered", lambda value: {"pairs": [[encode(k), encode(v)] for k, v in value.items()]}),
    (dict, "", _write_dict),
    (slice, "slice", lambda value: {"ends": encode([value.start, value.stop, value.step])}),
    (SCHEDULES, "schedule", lambda value: {"name": type(value).__name__, "fields": encode(dict(vars(value)))}),
    (partial, "partial", _write_partial),
    (FunctionType, "function", lambda value: {"name": _named(_function, value)}),
    (type, "class", lambda value: {"name": _named(_class, value)}),
)
"""Kinds of objects, the name under which each is written (empty: as JSON's own type), and the function that writes it.
The first kind that fits is used.
"""

READERS: dict[str, Callable[..., object]] = {
    "number": _read_scalar,
    "array": _read_array,
    "box": _read_box,
    "discrete": lambda n, start: spaces.Discrete(n, start=start),
    "binary": spaces.MultiBinary,
    "discretes": lambda nvec, start: spaces.MultiDiscrete(nvec, start=start),
    "spaces": lambda parts: spaces.Dict(list(parts.items())),  # of a dictionary it would sort the keys
    "unit": lambda name: TrainFrequencyUnit[name],
    "train_freq": TrainFreq,
    "tuple": lambda items: tuple(items),
    "deque": lambda items, longest: deque(items, maxlen=longest),
    "ordered": lambda pairs: OrderedDict(pairs),
    "pairs": lambda pairs: dict(pairs),
    "slice": lambda ends: slice(*ends),
    "schedule": _read_schedule,
    "partial": _read_partial,
    "function": _function,
    "class": _class,
    "object": _object,
}
