"""What makes an environment a goal environment, seen from its spaces. NumPy and Gymnasium only."""

from __future__ import annotations

import numpy as np
from gymnasium import spaces

from sb3_tbc.aliases import PlainMapping, Space
from sb3_tbc.arrays import AnyArray, Arrays, BoolArray, Indices

GOAL_KEYS = ("observation", "achieved_goal", "desired_goal")
"""The parts of a goal environment's observation."""


def goal_space_problems(observation: Space, action: Space | None = None) -> list[str]:
    """What keeps a hierarchical agent from acting in an environment with these spaces; empty if nothing.

    :param observation: the environment's observation space
    :param action: and its action space; None to look at the observations alone
    :return: one sentence for each problem, "its ..."
    """
    found = [] if action is None else _action_problems(action)
    if not isinstance(observation, spaces.Dict) or any(key not in observation.spaces for key in GOAL_KEYS):
        keys = sorted(observation.spaces) if isinstance(observation, spaces.Dict) else type(observation).__name__
        return [*found, f"its observation must be a Dict with the keys {sorted(GOAL_KEYS)}, got {keys}"]
    for key in GOAL_KEYS:
        part = observation.spaces[key]
        if not isinstance(part, spaces.Box) or len(part.shape) != 1:
            got = part if isinstance(part, spaces.Box) else type(part).__name__
            found.append(f"its observation[{key!r}] must be a Box with one dimension, got {got}; flatten it")
    achieved, desired = observation["achieved_goal"].shape, observation["desired_goal"].shape
    if achieved != desired:
        found.append(f"its achieved_goal {achieved} and desired_goal {desired} must have one shape")
    return found


def _action_problems(action: Space) -> list[str]:
    if not isinstance(action, spaces.Box) or len(action.shape) != 1:
        return [f"its actions must be a Box action space with one dimension, got {action}"]
    return box_problems(action)


def box_problems(action: spaces.Box) -> list[str]:
    """What keeps a Gaussian policy from acting in a box of actions, one sentence for each problem, "its ..."."""
    if action.dtype.kind != "f":  # cast to the space's type, all but the highest unit action would lose its fraction
        return [
            f"its actions must be real numbers, got {action}: an agent's actions lie anywhere between the bounds; "
            "declare Box(..., dtype=numpy.float32), and round them in the environment's step"
        ]
    with np.errstate(over="ignore", invalid="ignore"):
        span = action.high - action.low  # not finite either where both bounds are the type's largest numbers
    if not np.isfinite(span).all():
        return [
            f"its action bounds must be finite, and so must the distance between them, got {action}: declare the "
            "largest actions that make sense; gymnasium's ClipAction takes bounds away, leave it out, as an agent's "
            "actions never leave theirs"
        ]
    return []


def check_goal_space(observation: Space, action: Space | None = None) -> spaces.Dict:
    """Return the observation space if it is that of a goal environment.

    :param action: the action space, to look at that too
    :raises ValueError: naming every problem
    """
    problems = goal_space_problems(observation, action)
    if problems or not isinstance(observation, spaces.Dict):
        raise ValueError(
            "a hierarchical agent needs a goal environment with continuous actions, and this is not one: "
            f"{'; '.join(problems)}. Derive it from gymnasium_robotics.core.GoalEnv."
        )
    return observation


def goal_parts(space: Space) -> Space:
    """What of an observation an agent with two levels sees; another space as it is."""
    if not isinstance(space, spaces.Dict) or any(key not in space.spaces for key in GOAL_KEYS):
        return space
    return spaces.Dict({key: space[key] for key in GOAL_KEYS})


def rows_of(observation: PlainMapping, where: Indices | BoolArray | int) -> Arrays:
    """Goal observations of some environments out of those of all, copied; of one, as a view, for a single number."""
    return {key: observation[key][where] for key in GOAL_KEYS}


def width(space: spaces.Dict, key: str) -> int:
    """Number of entries of a part of a goal observation."""
    return int(np.prod(space.spaces[key].shape or ()))


def said_success(info: PlainMapping) -> bool | None:
    """Success by the entry ``is_success`` or ``success`` of an ``info``; None if there is neither, or it says nothing.

    :param info: of a step
    """
    said = np.asarray(info.get("is_success", info.get("success")))
    if said.dtype.kind not in "biuf" or not said.size or not np.isfinite(said).all():
        return None  # None, a text, NaN
    return bool(said.all())


class UnitActions:
    """Between an action space's own units and coordinates in [-1, 1].

    :param space: the environment's actions, with finite bounds
    """

    def __init__(self, space: spaces.Box) -> None:
        self.low, self.high, self.dtype = space.low, space.high, space.dtype
        self.width = space.high - space.low
        self.centre, self.half = 0.5 * (space.low + space.high), 0.5 * (space.high - space.low)

    def unscale(self, unit: AnyArray) -> AnyArray:
        """The environment's actions for unit ones, of the action space's type; exported code rounds the same way."""
        # rounded, low + (high - low) may lie above high, which environments that check their actions refuse
        actions = np.minimum(self.low + 0.5 * (unit + 1.0) * self.width, self.high)
        return np.asarray(actions, dtype=self.dtype)

    def scale(self, actions: AnyArray) -> AnyArray:
        """Unit coordinates of the environment's actions."""
        return np.asarray((actions - self.centre) / self.half)
