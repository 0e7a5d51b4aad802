"""The updates of a round on their way to one aggregate: as a running sum, or all kept."""

from __future__ import annotations

from collections.abc import Callable
from typing import Protocol, runtime_checkable

import numpy as np
from numpy.typing import NDArray

from geoorbit_ros.federated.payloads.model_layout import Vector

FRACTION_BITS = 40
"""Resolution of the sum: 2^-40, a thousandth of what float32 resolves near 0.01. More bits would
leave fewer summands in the fraction's 64."""
MAX_SUMMAND = 2.0**42
"""With `MAX_SUMMANDS` of them the whole parts fit in 63 bits."""
MAX_SUMMANDS = 1 << 20
"""So many fractions of 40 bits fit in 63."""


class ExactSum:
    """Adds float64 vectors as whole and fractional parts in 64-bit integers.

    Floating-point addition is not associative; integer addition is. Each summand is rounded once,
    by itself, to a multiple of 2^-40. Its memory is that of two vectors, however many are added.

    Args:
        size: Length of the vectors.
    """

    def __init__(self, size: int) -> None:
        self.whole = np.zeros(size, np.int64)
        self.fraction = np.zeros(size, np.int64)
        self.number = 0

    def add(self, vector: NDArray[np.float64]) -> None:
        """Add one vector of shape (size,), each magnitude below 2^42.

        Raises:
            OverflowError: More than 2^20 summands, or one that is too large.
        """
        whole = np.rint(vector)
        if self.number == MAX_SUMMANDS or not np.max(np.abs(whole), initial=0.0) < MAX_SUMMAND:
            raise OverflowError(f"summand {self.number} of {MAX_SUMMANDS}, each below 2^42")
        self.whole += whole.astype(np.int64)
        self.fraction += np.rint((vector - whole) * 2.0**FRACTION_BITS).astype(np.int64)
        self.number += 1

    def value(self) -> NDArray[np.float64]:
        """The sum, shape (size,)."""
        carry = self.fraction >> FRACTION_BITS
        rest = self.fraction - (carry << FRACTION_BITS)
        return (self.whole + carry).astype(np.float64) + rest / 2.0**FRACTION_BITS


Aggregate = NDArray[np.float64]
"""Aggregated change of the weights, shape (size,)."""


@runtime_checkable
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
        """See `Collection.add`; weights are ignored: a false update would claim a large one."""
        self._rows[client] = update.copy()

    def result(self) -> Aggregate:
        """See `Collection.result`."""
        table = np.array([self._rows[client] for client in sorted(self._rows)], np.float64)
        return self._combine(table)
