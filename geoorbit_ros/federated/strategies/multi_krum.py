"""Multi-Krum: the mean of those updates that have the nearest neighbours.

Blanchard et al., "Machine learning with adversaries: Byzantine tolerant gradient descent", NeurIPS
2017, sections 3 and 5: of n updates, f of them false, each one's score is the sum of its squared
distances to its n - f - 2 nearest others, and the mean is over the n - f best scores.
"""

from __future__ import annotations

from typing import Self

import numpy as np

from geoorbit_ros.core.plugins import register
from geoorbit_ros.federated.strategies.collection import Aggregate
from geoorbit_ros.federated.strategies.strategy import (
    RobustStrategy,
    StrategySettings,
    Table,
    byzantine_count,
    check_range,
)

_BLOCK = 512
"""Rows whose distances are in memory at once. Chosen: larger takes more memory, smaller time."""


@register("strategy", "multi_krum")
class MultiKrum(RobustStrategy):
    """Expects this share of false updates; its guarantee takes 2f + 3 updates or more.

    With fewer, f is what that allows. Time grows with the square of the number of updates.

    Raises:
        FederationError: A share of half or more.
    """

    def __init__(self, share: float = 0.3) -> None:
        self.share = check_range("byzantine_share", share, 0.0, 0.49)

    @classmethod
    def from_settings(cls, settings: StrategySettings) -> Self:
        """See `Strategy.from_settings`."""
        return cls(settings.byzantine_share)

    def combine(self, table: Table) -> Aggregate:
        """See `RobustStrategy.combine`."""
        number = len(table)
        expected = min(byzantine_count(self.share, number), max((number - 3) // 2, 0))
        neighbours = max(number - expected - 2, 1)
        if number == 1:
            return np.asarray(table[0])
        scores = np.concatenate(
            [_scores(table, start, neighbours) for start in range(0, number, _BLOCK)]
        )
        best = np.sort(np.argsort(scores, kind="stable")[: number - expected])
        return np.asarray(np.mean(table[best], axis=0))


def _scores(table: Table, start: int, neighbours: int) -> Aggregate:
    """Scores of a block of rows; blocks bound the memory for their distances."""
    rows = table[start : start + _BLOCK]
    squares = np.einsum("ij,ij->i", table, table)
    distances = squares[start : start + _BLOCK, None] + squares - 2 * rows @ table.T
    distances[np.arange(len(rows)), start + np.arange(len(rows))] = np.inf
    nearest = np.partition(distances, neighbours - 1, axis=1)[:, :neighbours]
    return np.asarray(np.sum(np.maximum(nearest, 0.0), axis=1))
