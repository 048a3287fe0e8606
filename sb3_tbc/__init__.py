"""Hierarchical reinforcement learning with timed subgoals and bionic circuit networks, on Stable-Baselines3."""

from sb3_tbc.buffers import OptionReplayBuffer, SubgoalReplayBuffer
from sb3_tbc.evaluation import evaluate_hierarchical
from sb3_tbc.ndbc import NDBCNet, NDBCWiring
from sb3_tbc.spaces import SubgoalSpace
from sb3_tbc.tasks import register_tasks
from sb3_tbc.tbc_hrl import HAC, TBCHRL, HiTS, TBCPolicy
from sb3_tbc.vec_env import HierarchicalVecEnv

__version__ = "0.1.0"

__all__ = [
    "HAC",
    "TBCHRL",
    "HiTS",
    "HierarchicalVecEnv",
    "NDBCNet",
    "NDBCWiring",
    "OptionReplayBuffer",
    "SubgoalReplayBuffer",
    "SubgoalSpace",
    "TBCPolicy",
    "evaluate_hierarchical",
]

register_tasks()
