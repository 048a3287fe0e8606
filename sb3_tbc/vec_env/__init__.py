"""Vectors of environments as each level sees them."""

from sb3_tbc.vec_env.hierarchical_vec_env import HierarchicalVecEnv

__all__ = ["HierarchicalVecEnv"]
