"""Base class of the tasks: goals, rewards, time limit, start states and observation dictionaries in one place."""

from __future__ import annotations

import contextlib
import io
from abc import abstractmethod
from collections.abc import Iterable, Mapping, Sequence
from typing import Any, ClassVar

import numpy as np
from gymnasium import logger, spaces
from gymnasium.envs.registration import EnvSpec
from gymnasium.error import ResetNeeded
from numpy.typing import ArrayLike, NDArray

from sb3_tbc.aliases import Plain, PlainMapping
from sb3_tbc.arrays import AnyArray
from sb3_tbc.smdp.spaces import SubgoalSpace

from .rendering import Overlay

with contextlib.redirect_stderr(io.StringIO()):  # Importing it prints a notice about environments not used here.
    from gymnasium_robotics.core import GoalEnv

Array = NDArray[np.float64]
Observation = dict[str, Array]
LAYOUTS = ("paper", "compact")


class GoalTask(GoalEnv):  # type: ignore[misc]
    """A goal-conditioned task with a sparse reward: 0 where the goal test holds after the step, -1 elsewhere.

    Success terminates an episode, the time limit truncates it, and ``info["is_success"]`` is there after every step.
    A task keeps its time limit itself unless ``gymnasium.make`` built it: then the ``TimeLimit`` wrapper does, so that
    ``gymnasium.make(id, max_episode_steps=100)`` is honoured. Actions outside the action space are clipped to it; NaN,
    infinite and wrongly shaped ones are refused. ``reset(options={"goal": ..., "state": {...}})`` puts the task into
    an exact start. A copy (``deepcopy``, ``pickle``), made in the middle of an episode too, is independent and goes on
    exactly as the original does.

    Subclasses set the class attributes, build their physics, and implement the methods marked abstract. They take
    keyword arguments only.

    :param observation: ``"paper"`` (sizes of the paper's table 1) or ``"compact"`` (the public benchmark's vector)
    :param legacy_quirks: reproduce the errors of the public implementation, listed in each task's docstring
    :param render_mode: ``None``, ``"rgb_array"`` or ``"human"``
    :raises ValueError: for an unknown layout or render mode, or ``legacy_quirks`` that is neither true nor false
    """

    metadata: ClassVar[Plain] = {"render_modes": ["rgb_array", "human"], "render_fps": 30}
    max_episode_steps: int
    """Steps after which an episode is truncated, unless a ``TimeLimit`` says otherwise."""
    truncates_itself: bool = True
    """Whether the task itself keeps the time limit; false where ``gymnasium.make`` adds a ``TimeLimit``."""
    reward_range: ClassVar[tuple[float, float]] = (-1.0, 0.0)
    """Lowest and highest reward of a step."""
    success_terminates: bool = True
    """Whether an episode ends with success; false only where the public implementation is followed to the letter."""
    achieved_in_observation: bool = True
    """Whether ``achieved_goal`` can be computed from ``observation``; if not, policies need to see it as well."""
    action_bound: ClassVar[tuple[float, ...]] = (1.0,)
    """Largest magnitude of each action entry; ranges are symmetric."""
    goal_low: ClassVar[tuple[float, ...]]
    goal_high: ClassVar[tuple[float, ...]]
    goal_tolerance: ClassVar[tuple[float, ...]]
    """Largest difference per goal coordinate that counts as success (inclusive), task units."""
    dynamics_names: ClassVar[tuple[str, ...]] = ()
    """Physical quantities that :meth:`set_dynamics` can scale."""
    velocity_entries: ClassVar[tuple[int, ...]] = ()
    """Entries of a frame of ``observation`` that are velocities, for tasks that have a variant without them."""
    goal_is_fixed: ClassVar[bool] = False
    """Whether every episode has the same desired goal."""
    observation_scale: Array
    """Typical magnitude of each entry: ``observation / observation_scale`` lies about in [-1, 1]."""
    goal_scale: Array
    """The same for ``achieved_goal`` and ``desired_goal``."""
    subgoals: SubgoalSpace
    _not_copied: ClassVar[tuple[str, ...]] = ("_viewer",)
    """Attributes that are not copied: windows, contexts, handles of engines."""

    def __init__(
        self, *, observation: str = "paper", legacy_quirks: bool = False, render_mode: str | None = None
    ) -> None:
        if observation not in LAYOUTS:
            raise ValueError(f"observation must be one of {LAYOUTS}, got {observation!r}")
        if render_mode is not None and render_mode not in self.metadata["render_modes"]:
            raise ValueError(f"render_mode must be None or one of {self.metadata['render_modes']}, got {render_mode!r}")
        if legacy_quirks not in (False, True):
            raise ValueError(f"legacy_quirks must be true or false, got {legacy_quirks!r}")
        self.layout = observation
        self.legacy_quirks = bool(legacy_quirks)
        self.render_mode = render_mode
        self.observation_scale, self.goal_scale, self.subgoals = self._describe()
        bound = np.asarray(self.action_bound, dtype=np.float32)
        self.action_space = spaces.Box(-bound, bound, dtype=np.float32)
        goal_space = spaces.Box(np.array(self.goal_low), np.array(self.goal_high), dtype=np.float64)
        size = len(self.observation_scale)
        self.observation_space = spaces.Dict(
            observation=spaces.Box(-np.inf, np.inf, (size,), dtype=np.float64),
            achieved_goal=goal_space,
            desired_goal=spaces.Box(goal_space.low, goal_space.high, dtype=np.float64),
        )
        self._action_shape = bound.shape
        self._action_limit = [float(b) for b in bound]
        self._elapsed = -1
        self._goal: Array = np.zeros(len(self.goal_low))
        self._goal_list: list[float] = self._goal.tolist()
        self._tolerance = np.asarray(self.goal_tolerance, dtype=np.float64)
        self._overlay = Overlay()
        self._viewer: Any = None
        self._spec: EnvSpec | None = None

    # -- what a task must give -------------------------------------------------------------------------------------

    @abstractmethod
    def _describe(self) -> tuple[Array, Array, SubgoalSpace]:
        """Observation scale (of the chosen layout), goal scale and subgoal space."""

    @abstractmethod
    def _sample_goal(self) -> Sequence[float]:
        """Draw a desired goal from ``self.np_random``."""

    @abstractmethod
    def _restart(self, state: dict[str, Array]) -> None:
        """Put the physics into the start state; ``state`` overrides what is otherwise drawn."""

    @abstractmethod
    def _advance(self, action: list[float]) -> None:
        """Advance the physics by one control step with a legal action."""

    @abstractmethod
    def _observe(self, first: bool) -> tuple[Array, list[float]]:
        """A fresh ``observation`` array and the achieved goal; ``first`` is true right after a reset."""

    @abstractmethod
    def task_state(self) -> dict[str, Array]:
        """The physical state as a flat dictionary of fresh arrays, in physical units."""

    @abstractmethod
    def _draw(self) -> NDArray[np.uint8]:
        """Draw the present state with its overlay, ``(height, width, 3)``."""

    def _state_shapes(self) -> dict[str, tuple[int, ...]]:
        """Names and shapes that ``options["state"]`` may hold."""
        return {}

    # -- Gymnasium interface ---------------------------------------------------------------------------------------

    @property
    def spec(self) -> EnvSpec | None:
        """How ``gymnasium.make`` built the task; None where it did not."""
        return self._spec

    @spec.setter
    def spec(self, spec: EnvSpec | None) -> None:
        self._spec = spec
        self.truncates_itself = spec is None

    def __getstate__(self) -> Plain:
        """Everything but windows and handles of engines, for ``copy`` and ``pickle``."""
        return {key: value for key, value in vars(self).items() if key not in self._not_copied}

    def __setstate__(self, state: Plain) -> None:
        """Restore what :meth:`__getstate__` gave, and connect it with an engine again."""
        self.__dict__.update(dict.fromkeys(self._not_copied), **state)
        self._reconnect()

    def _reconnect(self) -> None:
        """Make what cannot be copied, and put the physics into the state that the copied attributes describe."""

    def reset(self, *, seed: int | None = None, options: PlainMapping | None = None) -> tuple[Observation, Plain]:
        """Start an episode.

        :param seed: seeds the task's own random generator
        :param options: ``goal`` (desired goal) and ``state`` (dictionary of arrays); what is absent is drawn, as it
            would be without options
        :raises ValueError: for unknown keys, wrong shapes and values that are not finite
        :raises TypeError: for options, or a state in them, that are no dictionary
        """
        super().reset(seed=seed)
        goal, state = self._read_options(options or {})
        drawn = self._sample_goal()  # even where one is given, so that what follows from the seed stays the same
        self._goal = np.array(drawn if goal is None else goal, dtype=np.float64)
        self._goal_list = self._goal.tolist()
        self._overlay = Overlay()
        self._elapsed = 0
        self._restart(state)
        observation, achieved = self._observe(True)
        if self.render_mode == "human":
            self.render()
        return (
            {"observation": observation, "achieved_goal": np.array(achieved), "desired_goal": self._goal.copy()},
            {"is_success": self._holds(achieved, self._goal_list)},
        )

    def step(self, action: ArrayLike) -> tuple[Observation, float, bool, bool, Plain]:
        """Advance by one control step.

        :param action: in the units of ``action_space``; clipped to it
        :raises ValueError: for an action of the wrong shape or type, or one that is not finite
        :raises gymnasium.error.ResetNeeded: before the first reset
        """
        if self._elapsed < 0:
            raise ResetNeeded(f"{type(self).__name__}: call reset() before step()")
        self._advance(self._legal(action))
        self._elapsed += 1
        observation, achieved = self._observe(False)
        success = self._holds(achieved, self._goal_list)
        terminated = success and self.success_terminates
        if self.render_mode == "human":
            self.render()
        return (
            {"observation": observation, "achieved_goal": np.array(achieved), "desired_goal": self._goal.copy()},
            0.0 if success else -1.0,
            terminated,
            self._elapsed >= self.max_episode_steps and self.truncates_itself and not terminated,
            {"is_success": success},
        )

    def compute_reward(self, achieved_goal: ArrayLike, desired_goal: ArrayLike, info: object = None) -> Any:
        """Sparse reward: 0 where the goal test holds, else -1.

        :param achieved_goal: ``(goal_dim,)`` or ``(..., goal_dim)``
        :param desired_goal: the same shape
        :param info: ignored
        :return: a float, or an array ``(...)`` for a batch
        """
        success = self._holds_batch(*self._goal_pair(achieved_goal, desired_goal))
        return np.where(success, 0.0, -1.0) if np.ndim(success) else (0.0 if success else -1.0)

    def compute_terminated(self, achieved_goal: ArrayLike, desired_goal: ArrayLike, info: object = None) -> Any:
        """Whether the goal test holds: a bool, or an array for a batch. See :meth:`compute_reward`."""
        success = self._holds_batch(*self._goal_pair(achieved_goal, desired_goal)) & self.success_terminates
        return success if np.ndim(success) else bool(success)

    def compute_truncated(self, achieved_goal: ArrayLike, desired_goal: ArrayLike, info: object = None) -> Any:
        """Whether the task itself cuts the present step: at its time limit and without success."""
        terminated = self.compute_terminated(achieved_goal, desired_goal, info)
        at_limit = self.truncates_itself and self._elapsed >= self.max_episode_steps
        return ~terminated & at_limit if np.ndim(terminated) else (at_limit and not terminated)

    def render(self) -> NDArray[np.uint8] | None:
        """Return a picture (``"rgb_array"``) or show it in a window (``"human"``)."""
        if self.render_mode is None:
            logger.warn(f'{type(self).__name__}.render() does nothing: pass render_mode="rgb_array" or "human"')
            return None
        if self._elapsed < 0:
            raise ResetNeeded(f"{type(self).__name__}: call reset() before render()")
        picture = self._draw()
        if self.render_mode == "rgb_array":
            return picture
        if self._viewer is None:
            from .window import Window

            self._viewer = Window(f"sb3_tbc {type(self).__name__}", self.metadata["render_fps"])
        self._viewer.show(picture)
        return None

    def close(self) -> None:
        """Close the window, if there is one."""
        if self._viewer is not None:
            self._viewer.close()
            self._viewer = None

    def set_overlay(
        self,
        subgoal: ArrayLike | None = None,
        time_left: float | None = None,
        text: str | None = None,
        steps_left: int | None = None,
    ) -> None:
        """Set what an agent pursues, which :meth:`render` draws until the next reset.

        :param subgoal: live subgoal in task units, ``(subgoal_dim,)``
        :param time_left: remaining share of the time budget, 0 to 1
        :param text: a short line
        :param steps_left: the remaining time in environment steps
        """
        at = None if subgoal is None else np.array(subgoal, dtype=np.float64)
        self._overlay = Overlay(at, time_left, text, steps_left)

    @property
    def frame_dim(self) -> int:
        """Entries per frame where ``observation`` stacks several frames, else its length."""
        return len(self.observation_scale)

    def subgoals_without_velocities(self) -> SubgoalSpace:
        """The subgoal space of the variant that hides :attr:`velocity_entries`.

        :raises ValueError: if the task has no such variant
        """
        raise ValueError(
            f"hide_velocities must be false for {type(self).__name__}: Pendulum, UR5Reacher and UR5ReacherBullet have "
            "such a variant"
        )

    def switch_goal(self) -> None:
        """Draw another desired goal in the middle of an episode."""
        self._goal = np.array(self._sample_goal(), dtype=np.float64)
        self._goal_list = self._goal.tolist()

    def check_dynamics(self, names: Iterable[str]) -> None:
        """Refuse quantities that this task cannot scale.

        :raises ValueError: naming those it can
        """
        unknown = sorted(set(names) - set(self.dynamics_names))
        if unknown:
            raise ValueError(
                f"{type(self).__name__} cannot scale {unknown}; dynamics_scale may name {list(self.dynamics_names)}"
            )

    def set_dynamics(self, scales: Mapping[str, float]) -> None:
        """Multiply physical quantities by factors from the next reset on; quantities not named get their own value.

        :param scales: factors by name, see :attr:`dynamics_names`
        """
        self.check_dynamics(scales)
        self._apply_dynamics({name: scales.get(name, 1.0) for name in self.dynamics_names})

    def _apply_dynamics(self, scales: dict[str, float]) -> None:
        """Apply factors, one for each of :attr:`dynamics_names`."""

    def check_action(self, action: ArrayLike) -> None:
        """Refuse what :meth:`step` would refuse.

        :raises ValueError: for an action of the wrong shape or type, or one that is not finite
        """
        self._legal(action)

    # -- inner workings --------------------------------------------------------------------------------------------

    def _holds(self, achieved: list[float], desired: list[float]) -> bool:
        """Goal test of one pair in plain Python; agrees with :meth:`_holds_batch` to the bit."""
        # A plain loop, because all() over a generator takes twice as long.
        for a, d, tolerance in zip(achieved, desired, self.goal_tolerance):  # noqa: B905, SIM110
            if not abs(a - d) <= tolerance:
                return False
        return True

    def _holds_batch(self, achieved: Array, desired: Array) -> Any:
        return (np.abs(achieved - desired) <= self._tolerance).all(axis=-1)

    def _goal_pair(self, achieved: ArrayLike, desired: ArrayLike) -> tuple[Array, Array]:
        pair = np.asarray(achieved, dtype=np.float64), np.asarray(desired, dtype=np.float64)
        if pair[0].shape != pair[1].shape or pair[0].shape[-1:] != self._goal.shape:
            raise ValueError(
                f"achieved and desired goals must have one shape that ends with {self._goal.shape}, got "
                f"{pair[0].shape} and {pair[1].shape}"
            )
        return pair

    def _legal(self, action: ArrayLike) -> list[float]:
        """The action as plain floats inside the action space."""
        array = action if isinstance(action, np.ndarray) else np.asarray(action)
        if array.shape != self._action_shape or array.dtype.kind not in "fiub":
            raise ValueError(
                f"action must be numbers of shape {self._action_shape}, got shape {array.shape} of type {array.dtype}"
            )
        values: list[float] = array.tolist()
        # Chained comparisons in a loop are several times as fast as NumPy on so few numbers, and NaN fails them.
        for value, limit in zip(values, self._action_limit):  # noqa: B905 (the shape is checked above)
            if not -limit <= value <= limit:
                return self._clipped(array)
        return values

    def _clipped(self, array: AnyArray) -> list[float]:
        if not np.all(np.isfinite(array)):
            raise ValueError(f"action must be finite, got {array}. Has the policy diverged?")
        clipped: list[float] = np.clip(array.astype(np.float64), self.action_space.low, self.action_space.high).tolist()
        return clipped

    def _read_options(self, options: PlainMapping) -> tuple[Array | None, dict[str, Array]]:
        _check_keys("options", options, ("goal", "state"))
        goal = options.get("goal")
        if goal is not None:
            goal = _finite_array("options['goal']", goal, (len(self.goal_low),))
        shapes = self._state_shapes()
        state = options.get("state") or {}
        _check_keys("options['state']", state, tuple(shapes))
        return goal, {k: _finite_array(f"options['state'][{k!r}]", v, shapes[k]) for k, v in state.items()}


def _check_keys(what: str, given: PlainMapping, allowed: tuple[str, ...]) -> None:
    if not isinstance(given, Mapping):
        raise TypeError(f"{what} must be a dictionary with keys of {list(allowed)}, got {given!r}")
    unknown = sorted(set(given) - set(allowed), key=str)
    if unknown:
        raise ValueError(f"{what} has unknown keys {unknown}; allowed are {list(allowed)}")


def _finite_array(what: str, value: ArrayLike, shape: tuple[int, ...]) -> Array:
    try:
        array = np.array(value, dtype=np.float64)
    except (TypeError, ValueError):  # not numbers
        array = np.array(np.nan)
    if array.shape != shape or not np.all(np.isfinite(array)):
        raise ValueError(f"{what} must be finite numbers of shape {shape}, got {value!r}")
    return array
