"""Stress variants of the tasks: sensor noise, late actions, altered physics, changing goals, hidden velocities."""

from __future__ import annotations

from collections import deque
from collections.abc import Mapping, Sequence
from numbers import Integral, Real
from typing import SupportsFloat, TypeGuard

import numpy as np
from gymnasium.envs.registration import EnvSpec
from numpy.typing import ArrayLike, NDArray

from sb3_tbc.aliases import Plain, Wrapper
from sb3_tbc.arrays import AnyArray

from .base import GoalTask

Scale = float | Sequence[float]


class Perturb(Wrapper):
    """Disturbs a task, reproducibly from the seed given to ``reset``; ``gym.make(id, perturb={...})`` adds it.

    Rewards, success and ``achieved_goal`` always are those of the true state.

    :param env: one of our tasks
    :param observation_noise: standard deviation of Gaussian noise on each entry of ``observation``, in units of the
        task's ``observation_scale``; a frame keeps its noise while it stays in a stacked observation
    :param action_delay: steps before an action takes effect, fewer than an episode of the task has; until the first
        arrives, the action is zero
    :param dynamics_scale: factors on physical quantities, e.g. ``{"mass": 1.2, "friction": [0.5, 1.5]}``; a pair is a
        range from which each episode draws. Every task lists its names in ``dynamics_names``
    :param goal_switch: probability per step that the desired goal is drawn anew before the step
    :param hide_velocities: show 0 in place of velocities (Pendulum, UR5Reacher), so that one observation does not tell
        the state; the low level does not see these entries at all, and subgoals are read from ``achieved_goal``
    :raises ValueError: for values out of range, unknown quantities, goal switches where the goal is fixed, and hidden
        velocities where the task has no such variant
    :raises TypeError: for a ``dynamics_scale`` that is no dictionary
    """

    def __init__(
        self,
        env: GoalTask,
        observation_noise: float = 0.0,
        action_delay: int = 0,
        dynamics_scale: Mapping[str, Scale] | None = None,
        goal_switch: float = 0.0,
        hide_velocities: bool = False,
    ) -> None:
        super().__init__(env)
        self._task: GoalTask = env
        self._noise = _number("observation_noise", observation_noise, 0.0, np.inf)
        self._switch = _number("goal_switch", goal_switch, 0.0, 1.0)
        longest = env.max_episode_steps - 1
        if not isinstance(action_delay, Integral) or isinstance(action_delay, bool) or not 0 <= action_delay <= longest:
            raise ValueError(
                f"action_delay must be a whole number of steps from 0 to {longest}, the episode's length less one (a "
                f"longer delay lets no action take effect), got {action_delay!r}"
            )
        self._delay: int = int(action_delay)
        if not isinstance(dynamics_scale or {}, Mapping):
            raise TypeError(
                f"dynamics_scale must map names of {list(env.dynamics_names)} to factors, got {dynamics_scale!r}"
            )
        self._scales: dict[str, tuple[float, float]] = {
            name: _range(name, scale) for name, scale in (dynamics_scale or {}).items()
        }
        env.check_dynamics(self._scales)
        if self._switch > 0 and env.goal_is_fixed:
            raise ValueError(f"goal_switch must be 0 for {type(env).__name__}: its goal is always the same")
        if hide_velocities not in (False, True):
            raise ValueError(f"hide_velocities must be true or false, got {hide_velocities!r}")
        self._hidden: list[int] = []
        if hide_velocities:
            self.subgoals = env.subgoals_without_velocities()
            frames = range(0, len(env.observation_scale), env.frame_dim)
            self._hidden = [first + entry for first in frames for entry in env.velocity_entries]
        self._rng: np.random.Generator = np.random.default_rng()
        self._pending: deque[AnyArray] = deque()
        self._noise_stack: NDArray[np.float64] = np.zeros(len(env.observation_scale))

    @property
    def spec(self) -> EnvSpec | None:  # type: ignore[override]
        """The task's own spec: it holds ``perturb`` among its arguments."""
        return self.env.spec

    @property
    def bit_generators(self) -> list[np.random.BitGenerator]:
        """Its own randomness, which an episode that is to be repeated needs beside the task's."""
        return [self._rng.bit_generator]

    def reset(
        self, *, seed: int | None = None, options: Plain | None = None
    ) -> tuple[dict[str, NDArray[np.float64]], Plain]:
        """Start an episode; draws this episode's physics first."""
        if seed is not None:
            self._rng = np.random.default_rng([seed, 1])  # apart from the task's own stream
        if self._scales:
            self._task.set_dynamics({name: self._rng.uniform(*span) for name, span in self._scales.items()})
        self._pending.clear()
        self._pending.extend(np.zeros(self._task.action_space.shape) for _ in range(self._delay))
        observation, info = self.env.reset(seed=seed, options=options)
        return self._noisy(observation, first=True), info

    def step(self, action: ArrayLike) -> tuple[dict[str, NDArray[np.float64]], SupportsFloat, bool, bool, Plain]:
        """Step with the action of ``action_delay`` steps ago."""
        if self._delay:
            self._task.check_action(action)
            self._pending.append(np.array(action))
            action = self._pending.popleft()
        if self._switch and self._rng.random() < self._switch:
            self._task.switch_goal()
        observation, *rest = self.env.step(action)
        return self._noisy(observation, first=False), *rest  # type: ignore[return-value]

    def _noisy(self, observation: Plain, first: bool) -> Plain:
        if self._noise:
            stack, frame = self._noise_stack, self._task.frame_dim
            fresh = self._rng.normal(0.0, self._noise, frame) * self._task.observation_scale[-frame:]
            stack[:] = np.tile(fresh, len(stack) // frame) if first else np.concatenate([stack[frame:], fresh])
            observation["observation"] += stack
        if self._hidden:
            observation["observation"][self._hidden] = 0.0
        return observation


def _is_real(value: object) -> TypeGuard[float]:
    """Whether it is a number of Python or NumPy; true and false are none, which YAML makes of yes and no."""
    return isinstance(value, Real) and not isinstance(value, bool)


def _number(name: str, value: object, low: float, high: float) -> float:
    if not _is_real(value) or not low <= value < np.inf or not value <= high:
        raise ValueError(f"{name} must be a number from {low} to {high}, got {value!r}")
    return float(value)


def _range(name: str, scale: Scale) -> tuple[float, float]:
    pair = list(scale) if isinstance(scale, Sequence | np.ndarray) and not isinstance(scale, str) else [scale, scale]
    if len(pair) != 2 or not all(_is_real(v) and 0 < v < np.inf for v in pair) or pair[0] > pair[1]:
        raise ValueError(f"dynamics_scale[{name!r}] must be a positive factor or a [low, high] range, got {scale!r}")
    return float(pair[0]), float(pair[1])
