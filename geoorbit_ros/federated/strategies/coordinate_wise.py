"""Robust strategies that look at each weight by itself: FedMedian and the trimmed mean.

Yin et al., "Byzantine-robust distributed learning: towards optimal statistical rates", ICML 2018,
definitions 1 and 2.
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


@register("strategy", "fedmedian")
class FedMedian(RobustStrategy):
    """The median of the updates; it withstands false updates while they are fewer than half."""

    def combine(self, table: Table) -> Aggregate:
        """See `RobustStrategy.combine`."""
        return np.asarray(np.median(table, axis=0))


@register("strategy", "trimmed_mean")
class TrimmedMean(RobustStrategy):
    """The mean without this share of the updates at each end; it withstands so many false ones.

    Raises:
        FederationError: A share that leaves nothing.
    """

    def __init__(self, share: float = 0.3) -> None:
        self.share = check_range("byzantine_share", share, 0.0, 0.49)

    @classmethod
    def from_settings(cls, settings: StrategySettings) -> Self:
        """See `Strategy.from_settings`."""
        return cls(settings.byzantine_share)

    def combine(self, table: Table) -> Aggregate:
        """See `RobustStrategy.combine`."""
        cut = byzantine_count(self.share, len(table))
        ordered = np.sort(table, axis=0)
        return np.asarray(np.mean(ordered[cut : len(table) - cut], axis=0))
