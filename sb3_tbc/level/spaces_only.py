"""Spaces without an environment, for algorithms that are fed from outside."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

from stable_baselines3.common.vec_env import VecEnv

from sb3_tbc.aliases import Space
from sb3_tbc.errors import HierarchyError


class SpacesOnlyVecEnv(VecEnv):
    """Spaces without an environment: SB3's algorithms ask an environment for nothing else before they step it."""

    def __init__(self, observation_space: Space, action_space: Space) -> None:
        super().__init__(1, observation_space, action_space)

    def _refuse(self) -> HierarchyError:
        return HierarchyError("a level has no environment of its own; call learn on the model that owns the level")

    def reset(self) -> Any:
        """A level's environment cannot be reset."""
        raise self._refuse()

    def step_async(self, actions: Any) -> None:
        """A level's environment cannot be stepped."""
        raise self._refuse()

    def step_wait(self) -> Any:
        """A level's environment cannot be stepped."""
        raise self._refuse()

    def close(self) -> None:
        """Nothing to close."""

    def seed(self, seed: int | None = None) -> Sequence[None]:
        """Nothing to seed."""
        return [None]

    def get_attr(self, attr_name: str, indices: Any = None) -> list[Any]:
        """Attributes of the environment: it can only say that it does not render."""
        if attr_name == "render_mode":
            return [None]
        raise AttributeError(f"a level has no environment and thus no attribute {attr_name!r}")

    def set_attr(self, attr_name: str, value: Any, indices: Any = None) -> None:
        """A level's environment has no attributes."""
        raise self._refuse()

    def env_method(self, method_name: str, *args: Any, indices: Any = None, **kwargs: Any) -> list[Any]:
        """A level's environment has no methods."""
        raise self._refuse()

    def env_is_wrapped(self, wrapper_class: Any, indices: Any = None) -> list[bool]:
        """Not wrapped."""
        return [False]
