"""FedMedian: the median of the updates, weight by weight.

Yin et al., "Byzantine-robust distributed learning: towards optimal statistical rates", ICML 2018,
definition 1.
"""

from __future__ import annotations

import numpy as np

from geoorbit_ros.core.plugins import register
from geoorbit_ros.federated.strategies.collection import Aggregate
from geoorbit_ros.federated.strategies.strategy import RobustStrategy, Table


@register("strategy", "fedmedian")
class FedMedian(RobustStrategy):
    """Withstands false updates while they are fewer than half."""

    def combine(self, table: Table) -> Aggregate:
        """See `RobustStrategy.combine`."""
        return np.asarray(np.median(table, axis=0))
