"""Vectors of environments as each level sees them."""

from sb3_tbc.smdp.hierarchical_vec_env import HierarchicalVecEnv

__all__ = ["HierarchicalVecEnv"]
