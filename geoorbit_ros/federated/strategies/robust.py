"""What strategies share that compare updates with each other, so that liars stand out."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from geoorbit_ros.federated.strategies.collection import Aggregate, Collection, UpdateTable
from geoorbit_ros.federated.strategies.strategy import Strategy

Table = NDArray[np.float64]
"""One update per row, shape (number, size)."""


class RobustStrategy(Strategy):
    """Combines the table of all updates; every client counts the same."""

    def combine(self, table: Table) -> Aggregate:
        """One vector, shape (size,), for a table with at least one row."""
        raise NotImplementedError

    def collection(self, size: int) -> Collection:
        """See `Strategy.collection`."""
        return UpdateTable(self.combine)


def liars(share: float, number: int) -> int:
    """How many of so many updates a share stands for; 30 % of 10 are 3 in floating point, too."""
    return int(share * number + 1e-9)
