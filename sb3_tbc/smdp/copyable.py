"""Wrappers of vectors that can be copied."""

from __future__ import annotations

import inspect

from stable_baselines3.common.vec_env import VecEnvWrapper

from sb3_tbc.aliases import Plain


class CopyableVecEnvWrapper(VecEnvWrapper):
    """A wrapper that can be copied and pickled. SB3's cannot: it keeps a table of all attributes of its class."""

    def __getstate__(self) -> Plain:
        """The state without that table."""
        return {name: value for name, value in self.__dict__.items() if name != "class_attributes"}

    def __setstate__(self, state: Plain) -> None:
        self.__dict__.update(state, class_attributes=dict(inspect.getmembers(type(self))))
