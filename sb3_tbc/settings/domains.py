"""What values of a type a setting may have: bounds of numbers, forms of text, order and length of lists."""

from __future__ import annotations

import itertools
import math
from collections.abc import Sequence, Sized
from dataclasses import dataclass
from typing import Protocol, TypeVar

Value = TypeVar("Value", contravariant=True)


class Domain(Protocol[Value]):
    """A condition that a value of the right type must meet as well."""

    def holds(self, value: Value) -> bool:
        """Whether the value is allowed."""

    def __str__(self) -> str:
        """What is allowed, to be read after the type's name."""


@dataclass(frozen=True)
class Range:
    """Numbers between two bounds, which are allowed themselves unless excluded.

    :param low: lower bound
    :param high: upper bound
    :param above: exclude the lower bound
    :param below: exclude the upper bound
    :param also: single values outside of the bounds that are allowed as well
    """

    low: float = -math.inf
    high: float = math.inf
    above: bool = False
    below: bool = False
    also: tuple[float, ...] = ()

    def holds(self, value: float) -> bool:
        """Whether a number lies within the bounds."""
        low = value > self.low if self.above else value >= self.low
        high = value < self.high if self.below else value <= self.high
        return bool((low and high) or value in self.also)

    def __str__(self) -> str:
        low, high = _short(self.low), _short(self.high)
        parts = []
        if self.low > -math.inf:
            parts.append(f"above {low}" if self.above else f"of at least {low}")
        if self.high < math.inf:
            parts.append(f"below {high}" if self.below else f"at most {high}")
        text = " and ".join(parts)
        if len(parts) == 2 and not (self.above or self.below):
            text = f"from {low} to {high}"
        return " or ".join([text, *map(_short, self.also)])


def _short(number: float) -> str:
    return f"{int(number):,}" if float(number).is_integer() else f"{number:g}"


@dataclass(frozen=True)
class Prefixed:
    """Text made of a fixed beginning and a number, such as ``lin_3e-4``.

    :param prefix: the beginning
    :param number: bounds of the number
    """

    prefix: str
    number: Range

    def holds(self, value: object) -> bool:
        """Whether a text has this form."""
        try:
            number = float(str(value).removeprefix(self.prefix))
        except ValueError:
            return False
        return str(value).startswith(self.prefix) and math.isfinite(number) and self.number.holds(number)

    def __str__(self) -> str:
        return f"'{self.prefix}<number {self.number}>'"


@dataclass(frozen=True)
class Increasing:
    """Numbers in rising order, each larger than the one before it."""

    def holds(self, value: Sequence[float]) -> bool:
        """Whether a sequence rises."""
        return all(a < b for a, b in itertools.pairwise(value))

    def __str__(self) -> str:
        return "in rising order"


@dataclass(frozen=True)
class NotEmpty:
    """Lists of at least one entry."""

    def holds(self, value: Sized) -> bool:
        """Whether a sequence has entries."""
        return len(value) > 0

    def __str__(self) -> str:
        return "that is not empty"
