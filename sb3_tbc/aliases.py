"""Names for types that many modules use."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import gymnasium as gym

Plain = dict[str, Any]
"""Plain data by name: what JSON and YAML hold, an ``info``, keyword arguments."""

PlainMapping = Mapping[str, Any]
"""The same, to be read only."""

Env = gym.Env[Any, Any]
"""An environment, whatever it shows and takes."""

Space = gym.Space[Any]
"""A space of observations or actions."""
