"""Names for types that many modules use."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import gymnasium as gym

Plain = dict[str, Any]
"""Plain values by name: the content of a JSON or YAML file, the ``info`` of a step, keyword arguments."""

PlainMapping = Mapping[str, Any]
"""The same, where it is only read."""

Env = gym.Env[Any, Any]
"""An environment, with observations and actions of any type."""

Wrapper = gym.Wrapper[Any, Any, Any, Any]
"""A wrapper around such an environment."""

Space = gym.Space[Any]
"""A space of observations or actions."""
