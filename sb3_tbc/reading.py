"""Reading files from outside within limits; whatever is wrong with a text file is a :class:`.ConfigError`."""

from __future__ import annotations

import io
import json
import re
import zipfile
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import yaml

from sb3_tbc.aliases import PlainMapping
from sb3_tbc.arrays import Arrays
from sb3_tbc.errors import ConfigError
from sb3_tbc.outside import one_line

MAX_BYTES = 4 * 2**20
"""Largest text file that is read; configurations have some 10,000 bytes."""
MAX_VALUES = 100_000
"""Most values of a YAML text once its aliases are written out; without a limit, a few bytes could mean billions."""
MAX_DEPTH = 50
FLOAT = re.compile(r"[+-]?(\d+\.?\d*|\.\d+)([eE][+-]?\d+)?$")
UNNAMED = ' in "<unicode string>"'
MAX_GROWTH = 2000
SMALL = 2**26
"""Most bytes that a file of arrays may unpack to: ``MAX_GROWTH`` times its size plus ``SMALL``. The factor is large
because an empty replay buffer is all zeros.
"""


def read_text(path: Path, most: int = MAX_BYTES) -> str:
    """A text file.

    :param most: bytes that it may have
    :raises ConfigError: if it is missing, too large, or no UTF-8
    """
    try:
        with path.open("rb") as file:  # of a pipe or a device, as /dev/zero, no size tells how much it gives
            content = file.read(most + 1)
        if len(content) > most:
            raise ConfigError(f"{path} has more than {most} bytes; at most these are read")
        return content.decode("utf-8").replace("\r\n", "\n").replace("\r", "\n")
    except FileNotFoundError as error:
        raise ConfigError(f"cannot read {path}: there is no such file") from error
    except UnicodeDecodeError as error:
        raise ConfigError(
            f"cannot read {path}: it is no UTF-8 text ({error.reason} at byte {error.start}); save it as such"
        ) from error
    except (OSError, ValueError) as error:
        raise ConfigError(f"cannot read {path}: {one_line(error)}") from error


class SettingsLoader(yaml.SafeLoader):
    """YAML 1.1 in which ``3e-4`` is a number, as people write it in settings; in quotes it is a text as ever."""


class SettingsDumper(yaml.SafeDumper):
    """Puts texts in quotes that :class:`SettingsLoader` would read as numbers."""


for _kind in (SettingsLoader, SettingsDumper):
    _kind.add_implicit_resolver("tag:yaml.org,2002:float", FLOAT, list("+-.0123456789"))


def settings_yaml(data: PlainMapping) -> str:
    """YAML of settings, which :func:`read_yaml` reads as the same data with :class:`SettingsLoader`."""
    return yaml.dump(dict(data), Dumper=SettingsDumper, sort_keys=False)


def parse_yaml(text: str, what: str, kind: type[yaml.SafeLoader] = yaml.SafeLoader) -> Any:
    """Plain data of a YAML text; tags that would make other objects are refused.

    :param what: what the text is, for messages
    :param kind: how plain scalars are read
    :raises ConfigError: if it is no YAML, or too large or too deep when its aliases are written out
    """

    def parse() -> Any:
        loader = kind(text)  # not the parser in C, which crashes on deep nesting
        try:
            node = loader.get_single_node()
            if node is None:
                return None
            _size(node, {}, 0)
            return loader.construct_document(node)
        finally:
            loader.dispose()

    return _parsed(parse, what, "YAML")


def read_yaml(path: Path, kind: type[yaml.SafeLoader] = yaml.SafeLoader) -> Any:
    """Plain data of a YAML file.

    :param kind: how plain scalars are read
    :raises ConfigError: if it cannot be read
    """
    return parse_yaml(read_text(path), str(path), kind)


def read_json(path: Path) -> Any:
    """Plain data of a JSON file.

    :raises ConfigError: if it cannot be read
    """
    text = read_text(path)
    return _parsed(lambda: json.loads(text), str(path), "JSON")


def _parsed(parse: Callable[[], Any], what: str, form: str) -> Any:
    try:
        return parse()
    except ConfigError:
        raise
    except RecursionError as error:
        raise ConfigError(f"cannot read {what}: nested too deeply") from error
    except Exception as error:  # dates, numbers and keys that make no sense raise many kinds
        raise ConfigError(f"cannot read {what}: it is no {form}: {one_line(error).replace(UNNAMED, '')}") from error


def _size(node: yaml.Node, known: dict[int, int], depth: int) -> int:
    """Values in a node with its aliases written out.

    :raises ConfigError: if they are too many, nested too deeply, or a node holds itself
    """
    if depth > MAX_DEPTH:
        raise ConfigError("cannot read YAML: nested too deeply")
    if id(node) in known:
        if known[id(node)] < 0:
            raise ConfigError("cannot read YAML: an alias refers to a node that contains it")
        return known[id(node)]
    known[id(node)] = -1
    inner = node.value if isinstance(node, yaml.CollectionNode) else []
    parts = [part for item in inner for part in (item if isinstance(item, tuple) else (item,))]
    size = 1 + sum(_size(part, known, depth + 1) for part in parts)
    if size > MAX_VALUES:
        raise ConfigError(f"cannot read YAML: more than {MAX_VALUES} values once its aliases are written out")
    known[id(node)] = size
    return size


def read_arrays(path: str | Path | io.BufferedIOBase) -> Arrays:
    """The arrays of a file that :func:`~sb3_tbc.files.write_arrays` wrote; nothing is unpickled.

    :param path: of the file, or an open file
    :raises ValueError: if it is damaged, holds other things than plain arrays, or unpacks to far more than its size
    """
    try:
        with zipfile.ZipFile(path) as archive:
            sizes = [(member.compress_size, member.file_size) for member in archive.infolist()]
            if sum(size for _, size in sizes) > MAX_GROWTH * sum(packed for packed, _ in sizes) + SMALL:
                raise ValueError("it would unpack to far more than its size")
        if hasattr(path, "seek"):
            path.seek(0)
        with np.load(path, allow_pickle=False) as arrays:
            return {name: arrays[name] for name in arrays.files}
    except FileNotFoundError:
        raise
    except Exception as error:  # zipfile, zlib and NumPy raise many kinds for a broken file
        raise ValueError(f"{path} is no whole file of arrays: {one_line(error)}") from error
