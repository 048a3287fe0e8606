"""Subgoal spaces: what the high level may ask for and when it counts as reached. NumPy and Gymnasium only."""

from __future__ import annotations

import pickle
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass
from numbers import Integral
from typing import NamedTuple

import numpy as np
from gymnasium import spaces
from numpy.typing import ArrayLike

from sb3_tbc.aliases import Plain, Space
from sb3_tbc.arrays import AnyArray, BoolArray, FloatArray
from sb3_tbc.smdp.goal_spaces import GOAL_KEYS

GoalObservation = Mapping[str, AnyArray]
"""A goal environment's observation: ``observation``, ``achieved_goal``, ``desired_goal``, single or batched."""

Part = str | Sequence[str | int | None]
"""Entries of a goal observation: the name of a part, or ``(name, start, stop)``."""


class Slice(NamedTuple):
    """Neighbouring entries of one part of a goal observation."""

    key: str
    start: int = 0
    stop: int | None = None  # the first entry left out; None: to the end


@dataclass(frozen=True)
class Slices:
    """A map from goal observations to vectors that is plain data: it can be compared, saved, and sent anywhere.

    :param parts: the entries, laid end to end
    """

    parts: tuple[Slice, ...]

    def __post_init__(self) -> None:
        """Slices that come from a file are tuples."""
        object.__setattr__(self, "parts", tuple(Slice(*part) for part in self.parts))

    def __call__(self, observation: GoalObservation) -> FloatArray:
        """The entries, laid end to end, ``(..., n)``."""
        found = [observation[part.key][..., part.start : part.stop] for part in self.parts]
        return found[0] if len(found) == 1 else np.concatenate(found, axis=-1)

    @classmethod
    def from_parts(cls, given: Iterable[Part]) -> Slices:
        """From names of parts and ``(name, start, stop)``.

        :raises ValueError: if a part has another form
        """
        return cls(tuple(map(_slice, given)))


def _slice(given: Part) -> Slice:
    key, *numbers = (given,) if isinstance(given, str) else given if len(given) else (None,)
    if len(numbers) > 2 or not isinstance(key, str) or not all(n is None or type(n) is int for n in numbers):
        raise ValueError(f"a slice is the name of an observation's part, or (name, start, stop), got {given!r}")
    return Slice(key, *numbers)  # type: ignore[arg-type]


class SubgoalSpace:
    """The box of subgoals of a task, the map from observations into it, and the test for having reached one.

    All methods take single observations or batches (any leading dimensions, kept in the result).

    :param low: lower bounds of a subgoal, in task units, shape ``(subgoal_dim,)``
    :param high: upper bounds, same shape
    :param thresholds: a subgoal is reached at a distance below these, one per entry of ``groups``, in task units
    :param achieved: maps a goal observation to the subgoal-space point it lies at, ``(..., subgoal_dim)``
    :param local: maps a goal observation to what the low level sees of it, ``(..., local_dim)``
    :param local_scale: fixed task scales that bring ``local`` to about [-1, 1], shape ``(local_dim,)``
    :param names: a name for each coordinate
    :param groups: coordinate groups whose Euclidean distance is compared with a threshold; by default each
        coordinate is a group of its own
    :param rotations: which of ``groups`` are unit quaternions: their distance is the angle between the rotations [rad],
        so that a quaternion and its negative are the same
    :param event: index into the task's ``observation`` of a flag that is 1 in just the step of a decisive event, at
        which control returns to the high level and which gives the goal of hindsight where ``goal_strategy`` is
        ``"event"``; None where the task has no such event
    :raises ValueError: if bounds, thresholds and groups do not fit together, or the event is no index
    """

    event: int | None = None  # on the class: agents saved before this attribute existed have it, too
    rotations: tuple[int, ...] = ()  # likewise

    def __init__(
        self,
        low: ArrayLike,
        high: ArrayLike,
        thresholds: ArrayLike,
        achieved: Callable[[GoalObservation], FloatArray],
        local: Callable[[GoalObservation], FloatArray],
        local_scale: ArrayLike,
        names: Sequence[str],
        groups: Sequence[Sequence[int]] | None = None,
        event: int | None = None,
        rotations: Sequence[int] = (),
    ) -> None:
        self.low = np.asarray(low, dtype=np.float64)
        self.high = np.asarray(high, dtype=np.float64)
        self.thresholds: FloatArray = np.asarray(thresholds, dtype=np.float64)
        self.local_scale = np.asarray(local_scale, dtype=np.float64)
        self.names = tuple(names)
        self.groups = (
            tuple(tuple(g) for g in groups) if groups is not None else tuple((i,) for i in range(len(self.low)))
        )
        self._achieved = achieved
        self._local = local
        self.event = event
        self.rotations = tuple(rotations)
        self._check()
        if len(self.groups) == self.dim:  # each coordinate alone: in their order, in which `reached` compares them
            self.thresholds, self.groups = self.tolerance, tuple((i,) for i in range(self.dim))

    def __reduce__(self) -> tuple[object, ...]:
        """Travel to other processes whatever the maps are: functions without a name of their own go by value."""
        try:
            by_name = b"__main__" not in pickle.dumps((self._achieved, self._local))  # another process has its own main
        except (pickle.PicklingError, AttributeError, TypeError):
            by_name = False
        if by_name:
            return _restored, (type(self), vars(self))
        import cloudpickle  # one of SB3's dependencies, for what pickle cannot do

        return _from_bytes, (type(self), cloudpickle.dumps(vars(self)))

    def __deepcopy__(self, memo: object) -> SubgoalSpace:
        """Nothing in a space ever changes, so that copies share what it holds."""
        return _restored(type(self), vars(self))

    def _check(self) -> None:
        bounds = self.low.ndim == 1 and self.low.shape == self.high.shape and bool(np.all(self.low < self.high))
        if not bounds or not np.isfinite([self.low, self.high]).all():
            raise ValueError(
                f"subgoal bounds must be two vectors of finite numbers with low < high, got low={self.low}, "
                f"high={self.high}"
            )
        if self.local_scale.ndim != 1 or not (np.isfinite(self.local_scale) & (self.local_scale > 0)).all():
            raise ValueError(
                "local_scale must be a vector of finite numbers above 0, one for each entry that the low level sees, "
                f"got {self.local_scale}"
            )
        if len(self.names) != self.dim:
            raise ValueError(f"{self.dim} subgoal coordinates need as many names, got {self.names}")
        if self.thresholds.shape != (len(self.groups),) or not np.all(self.thresholds > 0):
            raise ValueError(f"need one positive threshold per group {self.groups}, got {self.thresholds}")
        if self.event is not None and (type(self.event) is not int or self.event < 0):
            raise ValueError(
                f"event must be the index of a flag in the observation, counted from 0, got {self.event!r}"
            )
        used = [i for group in self.groups for i in group]
        if not all(isinstance(i, Integral) for i in (*used, *self.rotations)):
            raise ValueError(f"groups and rotations must hold whole numbers, got {self.groups} and {self.rotations}")
        if not all(self.groups) or sorted(used) != list(range(self.dim)):
            raise ValueError(f"groups must use each of the {self.dim} coordinates once, got {self.groups}")
        for index in self.rotations:
            if not 0 <= index < len(self.groups) or len(self.groups[index]) != 4:
                raise ValueError(f"rotations must name groups of four coordinates of {self.groups}, got {index}")

    @classmethod
    def from_slices(
        cls,
        low: ArrayLike,
        high: ArrayLike,
        thresholds: ArrayLike,
        achieved: Iterable[Part] = ("achieved_goal",),
        local: Iterable[Part] = ("observation",),
        *,
        local_scale: ArrayLike,
        names: Sequence[str],
        groups: Sequence[Sequence[int]] | None = None,
        event: int | None = None,
    ) -> SubgoalSpace:
        """A subgoal space whose maps only pick entries of the observation, and are therefore plain data.

        Such a space can be sent to other processes and saved in files without any code. An example::

            SubgoalSpace.from_slices(
                [-1, -1], [1, 1], [0.1, 0.1], achieved=[("observation", 0, 2)], local=["observation"],
                local_scale=np.ones(6), names=["x", "y"],
            )

        :param achieved: where the subgoal-space point of an observation stands: names of its parts, or
            ``(name, start, stop)``, laid end to end
        :param local: likewise what the low level sees

        Other parameters are those of the class.
        :raises ValueError: if a slice has another form; also as the class does
        """
        maps = Slices.from_parts(achieved), Slices.from_parts(local)
        return cls(low, high, thresholds, *maps, local_scale, names, groups=groups, event=event)

    @property
    def is_data(self) -> bool:
        """Whether its maps are plain data, see :meth:`from_slices`."""
        return isinstance(self._achieved, Slices) and isinstance(self._local, Slices)

    @property
    def dim(self) -> int:
        """Number of subgoal coordinates."""
        return len(self.low)

    @property
    def local_dim(self) -> int:
        """Number of entries of the low level's view of the task."""
        return len(self.local_scale)

    @property
    def resolution_scale(self) -> FloatArray:
        """Scale of each coordinate for a circuit's input: a threshold becomes 0.15, unless the bounds are nearer.

        Neurons of moderate gain must tell a subgoal from its neighbours; scaled by its bounds alone, a threshold of
        4 % of the range moves them too little.
        """
        return np.asarray(np.minimum(self.tolerance / 0.15, np.maximum(np.abs(self.low), np.abs(self.high))))

    @property
    def tolerance(self) -> FloatArray:
        """The threshold that each coordinate belongs to, ``(subgoal_dim,)``, task units."""
        per_coordinate = np.empty(self.dim)
        for group, threshold in zip(self.groups, self.thresholds, strict=True):
            per_coordinate[list(group)] = threshold
        return per_coordinate

    def check_fits(self, space: Space) -> None:
        """Refuse an environment whose observations these maps do not read as they say.

        :param space: of goal observations
        :raises ValueError: naming both sizes; also where a map does not take batches
        """
        if not isinstance(space, spaces.Dict):
            return
        width = int(np.prod(space["observation"].shape or ()))
        if self.event is not None and self.event >= width:
            raise ValueError(
                f"event is the index of a flag in the observation, which has {width} entries; got {self.event}"
            )
        for name, size in (("achieved", self.dim), ("local", self.local_dim)):
            if (found := self._shape_from(name, space)) != (size,):
                raise ValueError(
                    f"the subgoal space's {name} map gives {found} of an observation, its own size is "
                    f"({size},): it was made for other observations. A wrapper that changes them "
                    "needs a subgoal space of its own, subgoals=SubgoalSpace(...)"
                )
            for n in (2, 3):
                if (found := self._shape_from(name, space, n)) != (n, size):
                    raise ValueError(
                        f"the subgoal space's {name} map gives {found} of {n} observations at once, ({n}, {size}) is "
                        "due: let it take batches, observation['observation'][..., a:b] in place of [a:b]"
                    )

    def _shape_from(self, name: str, space: spaces.Dict, *batch: int) -> tuple[int, ...]:
        """Shape of what a map gives of an observation, or of a batch of them."""
        blank = {key: np.zeros((*batch, *(space[key].shape or ()))) for key in GOAL_KEYS}  # no other part is kept
        try:
            return np.shape(getattr(self, name)(blank))
        except KeyError as error:
            raise ValueError(
                f"the subgoal space's {name} map reads the part {error} of an observation, but agents of two levels "
                f"see {', '.join(GOAL_KEYS)} alone: put its entries into 'observation'"
            ) from error

    def achieved(self, observation: GoalObservation) -> FloatArray:
        """Subgoal-space point of a goal observation, ``(..., subgoal_dim)``, task units."""
        return self._achieved(observation)

    def local(self, observation: GoalObservation) -> FloatArray:
        """The low level's view of a goal observation, ``(..., local_dim)``, task units."""
        return self._local(observation)

    def reached(self, achieved: FloatArray, subgoal: FloatArray) -> BoolArray:
        """Whether ``achieved`` lies within the thresholds of ``subgoal`` (strictly, as in HiTS), ``(...)``."""
        difference = achieved - subgoal
        if len(self.groups) == self.dim:
            near = np.abs(difference, out=difference) < self.thresholds
            return np.asarray(np.logical_and.reduce(near, axis=-1))  # all(), without its detour through Python
        distances = [np.linalg.norm(difference[..., list(g)], axis=-1) for g in self.groups]
        for index in self.rotations:
            group = list(self.groups[index])
            distances[index] = angle_between(achieved[..., group], subgoal[..., group])
        return np.asarray((np.stack(distances, axis=-1) < self.thresholds).all(axis=-1))

    def happened(self, observation: GoalObservation) -> BoolArray:
        """Whether the decisive event happened in the step that led to ``observation``, ``(...)``; never without one."""
        if self.event is None:
            return np.zeros(observation["observation"].shape[:-1], dtype=bool)
        return np.asarray(observation["observation"][..., self.event] > 0.5)

    def scale(self, subgoal: FloatArray) -> FloatArray:
        """From task units to [-1, 1] coordinates."""
        return np.asarray(2.0 * (subgoal - self.low) / (self.high - self.low) - 1.0)

    def unscale(self, unit: FloatArray) -> FloatArray:
        """From [-1, 1] coordinates to task units."""
        return np.asarray(self.low + 0.5 * (unit + 1.0) * (self.high - self.low))


def _restored(kind: type[SubgoalSpace], state: Plain) -> SubgoalSpace:
    space = object.__new__(kind)
    vars(space).update(state)
    return space


def _from_bytes(kind: type[SubgoalSpace], state: bytes) -> SubgoalSpace:
    return _restored(kind, pickle.loads(state))


def angle_between(one: FloatArray, other: FloatArray) -> FloatArray:
    """Angle [rad] between the rotations of two quaternions ``(..., 4)`` of any length, ``(...)``."""
    lengths = np.linalg.norm(one, axis=-1) * np.linalg.norm(other, axis=-1)
    cosine = np.abs((one * other).sum(axis=-1)) / np.maximum(lengths, 1e-12)
    return np.asarray(2.0 * np.arccos(np.minimum(cosine, 1.0)))
