"""Hierarchical reinforcement learning with timed subgoals and bionic circuit networks, on Stable-Baselines3."""

from sb3_tbc.tasks import register_tasks

__version__ = "0.1.0"

register_tasks()
