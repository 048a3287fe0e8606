"""What a goal environment offers, seen through the wrappers that ``gymnasium.make`` adds."""

from __future__ import annotations

from typing import Any

from gymnasium.utils import RecordConstructorArgs

from sb3_tbc.aliases import Env, Wrapper


class GoalAccess(Wrapper, RecordConstructorArgs):
    """Shows the attributes of the environments below, such as ``compute_reward`` and ``subgoals``, as its own.

    Gymnasium's wrappers no longer do that, but SB3's ``check_env`` and older code ask ``env.compute_reward``.
    """

    def __init__(self, env: Env) -> None:
        RecordConstructorArgs.__init__(self)
        super().__init__(env)

    def __getattr__(self, name: str) -> Any:
        """An attribute that this wrapper does not have itself; private names and ``env`` are never passed on."""
        if name.startswith("_") or name == "env":
            raise AttributeError(f"{type(self).__name__} has no attribute {name!r}")
        return self.env.get_wrapper_attr(name)
