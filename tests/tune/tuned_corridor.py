"""Registers the corridor under an id, for commands that import the module which does so."""

from __future__ import annotations

import gymnasium as gym

ENV_ID = "TunedCorridor-v0"
if ENV_ID not in gym.registry:
    gym.register(ENV_ID, "corridor:Corridor", disable_env_checker=True)
