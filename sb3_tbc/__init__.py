"""Hierarchical reinforcement learning with timed subgoals and bionic circuit networks, on Stable-Baselines3."""

from sb3_tbc import former_names, interruption  # noqa: F401  (an interruption of the imports below)
from sb3_tbc.hub import load_from_hub, push_to_hub
from sb3_tbc.ndbc import NDBCNet, NDBCWiring
from sb3_tbc.pretrained import load_pretrained
from sb3_tbc.recurrent import NDBCSAC
from sb3_tbc.replay.buffers import OptionReplayBuffer, SubgoalReplayBuffer
from sb3_tbc.smdp import HierarchicalVecEnv
from sb3_tbc.smdp.spaces import SubgoalSpace
from sb3_tbc.tasks import register_tasks
from sb3_tbc.tbc_hrl import HAC, TBCHRL, HiTS, TBCPolicy
from sb3_tbc.tbc_hrl.evaluation import evaluate_hierarchical

__version__ = "0.1.0"

__all__ = [
    "HAC",
    "NDBCSAC",
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
    "load_from_hub",
    "load_pretrained",
    "push_to_hub",
]

former_names.install()
register_tasks()
