"""Tasks whose engine cannot be copied: a copy builds its own engine and repeats in it all steps of the original."""

from __future__ import annotations

from abc import abstractmethod
from array import array
from types import ModuleType
from typing import ClassVar, NamedTuple

from .base import GoalTask


class Played(NamedTuple):
    """An episode so far."""

    start: list[float]  # what was drawn for its start
    actions: array[float]  # legal actions, one after another


class ReplayedTask(GoalTask):
    """Keeps a record of starts and actions since its world was built, from which a copy is brought to the same state.

    Engines like Box2D and Bullet expose only a part of their state (impulses and the order of contacts are missing), so
    that repeating the same calls is the only exact way. A record holds the present episode alone where each episode
    has a fresh world. Under ``legacy_quirks`` Box2D worlds live on, and the record grows by eight bytes per number.
    """

    _not_copied: ClassVar[tuple[str, ...]] = ("_viewer", "_engine")

    @abstractmethod
    def _build(self) -> None:
        """Make a fresh world."""

    @abstractmethod
    def _begin(self, start: list[float]) -> None:
        """Put the world into the start of an episode."""

    @abstractmethod
    def _simulate(self, action: list[float]) -> None:
        """Advance the world by one control step; ``self._elapsed`` steps were made before it."""

    @abstractmethod
    def _load_engine(self) -> ModuleType:
        """Import the engine's module."""

    def _new_world(self) -> None:
        """Make a fresh world and forget what was done in the one before."""
        self._record: list[Played] = []
        self._build()

    def _start(self, start: list[float]) -> None:
        self._record.append(Played(start, array("d")))
        self._begin(start)

    def _advance(self, action: list[float]) -> None:
        self._record[-1].actions.extend(action)
        self._simulate(action)

    def _reconnect(self) -> None:
        self._engine = self._load_engine()
        self._build()
        elapsed, size = self._elapsed, len(self.action_bound)
        for start, actions in self._record:
            self._begin(start)
            for step in range(len(actions) // size):
                self._elapsed = step
                self._simulate(actions[step * size : (step + 1) * size].tolist())
        self._elapsed = elapsed
