"""Options: windows, rewards and hindsight, and the vector of environments that runs them. No networks."""

from sb3_tbc.smdp.hierarchical_vec_env import HierarchicalVecEnv

__all__ = ["HierarchicalVecEnv"]
