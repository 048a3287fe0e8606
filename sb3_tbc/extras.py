"""Optional packages: import one, or say which extra of ``sb3_tbc`` installs it."""

from __future__ import annotations

from importlib import import_module
from types import ModuleType

from sb3_tbc.errors import ConfigError


class MissingExtraError(ConfigError, ImportError):
    """An optional package is not installed; the message says how to install it."""


def require(module: str, *, extra: str, what: str) -> ModuleType:
    """Import an optional package.

    :param module: its import name, e.g. ``"imageio.v2"``
    :param extra: the extra of ``sb3_tbc`` that installs it, as ``setup.cfg`` names it
    :param what: what needs it, as the beginning of a sentence, e.g. ``"a film"``
    :return: the imported module
    :raises MissingExtraError: if it cannot be imported; commands print this as one line, and Python code may catch it
        as an ``ImportError``
    """
    try:
        return import_module(module)
    except ImportError as error:
        package = module.partition(".")[0]
        raise MissingExtraError(
            f"{what} needs the package {package}, which cannot be imported ({error}). "
            f"Install it with: pip install 'sb3_tbc[{extra}]'"
        ) from error
