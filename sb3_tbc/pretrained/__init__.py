"""Trained agents that come with the package, each with its model card; ``make pretrained`` trains them again."""

from __future__ import annotations

import argparse
from pathlib import Path
from typing import TYPE_CHECKING, Any

from sb3_tbc.commands import given_path
from sb3_tbc.errors import ConfigError, nearest

if TYPE_CHECKING:
    from sb3_tbc.tbc_hrl.evaluation import Agent

FOLDER = Path(__file__).parent
PREFIX = "pretrained:"


def pretrained_names() -> list[str]:
    """Tasks for which there is a trained agent."""
    return sorted(path.stem for path in FOLDER.glob("*.zip"))


def pretrained_path(name: str) -> Path:
    """The ``.zip`` of a trained agent; its model card lies beside it, with the ending ``.md``.

    :param name: a task's short name, e.g. ``"Pendulum"``
    :raises ConfigError: if there is none, naming the nearest one
    """
    names = pretrained_names()
    if name not in names:
        raise ConfigError(f"no trained agent {name!r} comes with the package; {nearest(str(name), names)}")
    return FOLDER / f"{name}.zip"


def load_pretrained(name: str, env: Any = None, device: str = "cpu") -> Agent:
    """Load a trained agent that comes with the package.

    :param name: a task's short name, e.g. ``"Pendulum"``
    :param env: environments to act in, for further training
    :param device: torch device
    :raises ConfigError: if there is none, naming the nearest one
    """
    from sb3_tbc.zoo.algorithms import load_model

    return load_model(pretrained_path(name), env, device)


def is_pretrained(path: Path) -> bool:
    """Whether a file is an agent of the package, beside which nothing should be written."""
    return path.parent == FOLDER


def model_path(text: str) -> Path:
    """A command's ``MODEL`` argument: a path, or ``pretrained:TASK`` for an agent that comes with the package.

    :raises argparse.ArgumentTypeError: if there is no such agent, or the text is empty
    """
    if not text.startswith(PREFIX):
        return given_path(text)
    try:
        return pretrained_path(text.removeprefix(PREFIX))
    except ConfigError as error:
        raise argparse.ArgumentTypeError(str(error)) from error
