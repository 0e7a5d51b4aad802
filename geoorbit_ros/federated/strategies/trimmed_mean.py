"""Trimmed mean: weight by weight, the mean without the largest and the smallest updates.

Yin et al., "Byzantine-robust distributed learning: towards optimal statistical rates", ICML 2018,
definition 2.
"""

from __future__ import annotations

import numpy as np

from geoorbit_ros.federated.strategies.collection import Aggregate
from geoorbit_ros.federated.strategies.robust import RobustStrategy, Table, liars
from geoorbit_ros.federated.strategies.strategy import check_range


class TrimmedMean(RobustStrategy):
    """Leaves out this share of the updates at each end; holds while no more than that lie.

    Raises:
        FederationError: A share that leaves nothing.
    """

    def __init__(self, share: float = 0.3) -> None:
        self.share = check_range("byzantine_share", share, 0.0, 0.49)

    def combine(self, table: Table) -> Aggregate:
        """See `RobustStrategy.combine`."""
        cut = liars(self.share, len(table))
        ordered = np.sort(table, axis=0)
        return np.asarray(np.mean(ordered[cut : len(table) - cut], axis=0))
