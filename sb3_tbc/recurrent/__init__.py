"""A flat SAC with memory: NDBC circuits, GRU, LTC and CfC cells in Stable-Baselines3's own algorithm."""

from sb3_tbc.recurrent.ndbc_sac import NDBCSAC, RecurrentSACPolicy
from sb3_tbc.recurrent.sequences import SequenceReplayBuffer

__all__ = ["NDBCSAC", "RecurrentSACPolicy", "SequenceReplayBuffer"]
