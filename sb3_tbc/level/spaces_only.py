"""Spaces without an environment, for algorithms that are fed from outside."""

from __future__ import annotations

from collections.abc import Sequence

from stable_baselines3.common.vec_env import VecEnv
from stable_baselines3.common.vec_env.base_vec_env import VecEnvObs, VecEnvStepReturn

from sb3_tbc.aliases import Space
from sb3_tbc.errors import HierarchyError


class SpacesOnlyVecEnv(VecEnv):
    """Spaces without an environment: SB3's algorithms ask an environment for nothing else before they step it."""

    def __init__(self, observation_space: Space, action_space: Space) -> None:
        super().__init__(1, observation_space, action_space)

    def _refuse(self) -> HierarchyError:
        return HierarchyError("a level has no environment of its own; call learn on the model that owns the level")

    def reset(self) -> VecEnvObs:
        """A level's environment cannot be reset."""
        raise self._refuse()

    def step_async(self, actions: object) -> None:
        """A level's environment cannot be stepped."""
        raise self._refuse()

    def step_wait(self) -> VecEnvStepReturn:
        """A level's environment cannot be stepped."""
        raise self._refuse()

    def close(self) -> None:
        """Nothing to close."""

    def seed(self, seed: int | None = None) -> Sequence[None]:
        """Nothing to seed."""
        return [None]

    def get_attr(self, attr_name: str, indices: object = None) -> list[None]:
        """Attributes of the environment: it can only say that it does not render."""
        if attr_name == "render_mode":
            return [None]
        raise AttributeError(f"a level has no environment and thus no attribute {attr_name!r}")

    def set_attr(self, attr_name: str, value: object, indices: object = None) -> None:
        """A level's environment has no attributes."""
        raise self._refuse()

    def env_method(self, method_name: str, *args: object, indices: object = None, **kwargs: object) -> list[None]:
        """A level's environment has no methods."""
        raise self._refuse()

    def env_is_wrapped(self, wrapper_class: type, indices: object = None) -> list[bool]:
        """Not wrapped."""
        return [False]
