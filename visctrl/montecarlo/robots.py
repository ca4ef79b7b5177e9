"""What all states of many robots have in common: the robots come first in every array."""

from __future__ import annotations

import copy
from collections.abc import Sequence
from typing import Any, NamedTuple, Self

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]
Index = NDArray[np.intp]
Numbers = NDArray[np.int64]
Mask = NDArray[np.bool_]
#: Right, forward and up, (R, N) each, of rays in the robots' frames.
Parts = tuple[Array, Array, Array]


class Velocities(NamedTuple):
    """Forward speeds (R,) in m/s and turning rates (R,) in rad/s."""

    v: Array
    omega: Array

    @classmethod
    def none(cls, count: int) -> Velocities:
        """Return those of robots that stand."""
        return cls(np.zeros(count), np.zeros(count))

    def where(self, which: Mask, other: Velocities) -> Velocities:
        """Return these velocities with others in the place of some."""
        return Velocities(*(np.where(which, *pair) for pair in zip(other, self, strict=True)))

    def only(self, which: Mask) -> Velocities:
        """Return these velocities, with the other robots at a standstill."""
        return Velocities.none(len(which)).where(which, self)


class Robots:
    """The state of R robots: every array in it has the robots first."""

    def take(self, index: Index) -> Self:
        """Return a copy with some of the robots."""
        some = copy.copy(self)
        for name, value in vars(self).items():
            setattr(some, name, taken(value, index))
        return some

    @classmethod
    def joined(cls, parts: Sequence[Self]) -> Self:
        """Return the robots of all parts in one state; what is not an array is the first one's."""
        joined = copy.copy(parts[0])
        for name in vars(joined):
            setattr(joined, name, _joined([vars(part)[name] for part in parts]))
        return joined


def taken(value: Any, index: Index) -> Any:
    """Return what belongs to some of the robots, of arrays and of whatever holds arrays."""
    if isinstance(value, np.ndarray):
        return value[index]
    if isinstance(value, Robots):
        return value.take(index)
    if isinstance(value, tuple):
        return _rebuilt(value, [taken(part, index) for part in value])
    return value


def _joined(values: list[Any]) -> Any:
    first = values[0]
    if isinstance(first, np.ndarray):
        return np.concatenate(values)
    if isinstance(first, Robots):
        return type(first).joined(values)
    if isinstance(first, tuple):
        return _rebuilt(first, [_joined(list(parts)) for parts in zip(*values, strict=True)])
    return first


def _rebuilt(like: tuple[Any, ...], parts: list[Any]) -> tuple[Any, ...]:
    """Return parts as a tuple of the same kind, named or not."""
    return type(like)(*parts) if hasattr(like, "_fields") else tuple(parts)
