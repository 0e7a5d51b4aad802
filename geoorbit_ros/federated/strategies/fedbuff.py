"""FedBuff: no rounds; every few updates make a new model, late ones count less.

Nguyen et al., "Federated learning with buffered asynchronous aggregation", AISTATS 2022, algorithm
1, with the staleness weight of its section 5: s(τ) = 1/√(1+τ). The sum is divided by the size of
the buffer, not by the weights.
"""

from __future__ import annotations

import math
from typing import Self

from geoorbit_ros.core.plugins import register
from geoorbit_ros.federated.strategies.collection import Aggregate, Collection, RunningMean
from geoorbit_ros.federated.strategies.strategy import Strategy, StrategySettings, check_range


@register("strategy", "fedbuff")
class FedBuff(Strategy):
    """Buffer of K updates, learning rate η.

    Raises:
        FederationError: A setting out of range.
    """

    def __init__(self, buffer_size: int = 10, learning_rate: float = 1.0) -> None:
        self.buffer_size = int(check_range("buffer_size", buffer_size, 1, 1 << 20))
        self.learning_rate = check_range("learning_rate", learning_rate, 1e-6, 100.0)

    @classmethod
    def from_settings(cls, settings: StrategySettings) -> Self:
        """See `Strategy.from_settings`."""
        return cls(settings.buffer_size, settings.server_learning_rate)

    def weight(self, sample_count: int, staleness: int) -> float:
        """See `Strategy.weight`: 1/√(1+staleness), whatever the number of examples."""
        return 1.0 / math.sqrt(1.0 + staleness)

    def collection(self, size: int) -> Collection:
        """See `Strategy.collection`."""
        return RunningMean(size, by_number=True)

    def step(self, aggregate: Aggregate) -> Aggregate:
        """See `Strategy.step`."""
        return self.learning_rate * aggregate
