"""The updates of a round on their way to one aggregate: as a running sum, or all kept."""

from __future__ import annotations

from collections.abc import Callable
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from geoorbit_ros.federated.exact_sum import ExactSum
from geoorbit_ros.federated.layout import Vector

Aggregate = NDArray[np.float64]
"""Aggregated change of the weights, shape (size,)."""


class Collection(Protocol):
    """What a round's updates are added to, in any order."""

    @property
    def number(self) -> int:
        """How many were added."""

    def add(self, client: int, update: Vector, weight: float) -> None:
        """Add one client's update, shape (size,)."""

    def result(self) -> Aggregate:
        """The aggregate of all that were added, at least one."""


class RunningMean:
    """A weighted mean whose memory does not grow with the number of updates.

    Args:
        size: Length of the updates.
        by_number: Divide by the number of updates and not by their weights.
    """

    def __init__(self, size: int, *, by_number: bool = False) -> None:
        self._sum = ExactSum(size + 1)
        self._by_number = by_number

    @property
    def number(self) -> int:
        """See `Collection.number`."""
        return self._sum.number

    def add(self, client: int, update: Vector, weight: float) -> None:
        """See `Collection.add`."""
        summand = np.empty(len(update) + 1)
        np.multiply(update, weight, out=summand[:-1], dtype=np.float64)
        summand[-1] = weight
        self._sum.add(summand)

    def result(self) -> Aggregate:
        """See `Collection.result`."""
        value = self._sum.value()
        divisor = self._sum.number if self._by_number else value[-1]
        return value[:-1] / divisor


class UpdateTable:
    """All updates, for strategies that compare them with each other: memory grows with them.

    Args:
        combine: Makes one vector of a table of shape (number, size), rows ordered by client.
    """

    def __init__(self, combine: Callable[[NDArray[np.float64]], Aggregate]) -> None:
        self._combine = combine
        self._rows: dict[int, Vector] = {}

    @property
    def number(self) -> int:
        """See `Collection.number`."""
        return len(self._rows)

    def add(self, client: int, update: Vector, weight: float) -> None:
        """See `Collection.add`; weights are ignored, for a liar would choose a large one."""
        self._rows[client] = update.copy()

    def result(self) -> Aggregate:
        """See `Collection.result`."""
        table = np.array([self._rows[client] for client in sorted(self._rows)], np.float64)
        return self._combine(table)
