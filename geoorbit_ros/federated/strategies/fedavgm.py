"""FedAvgM: FedAvg with momentum on the server.

Hsu, Qi, Brown, "Measuring the effects of non-identical data distribution for federated visual
classification", 2019 (arXiv:1909.06335), section 4.3: v ← βv + Δ, w ← w + ηv.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Self

import numpy as np
from numpy.typing import NDArray

from geoorbit_ros.core.plugins import register
from geoorbit_ros.federated.strategies.collection import Aggregate
from geoorbit_ros.federated.strategies.strategy import (
    State,
    Strategy,
    StrategySettings,
    check_range,
)


@register("strategy", "fedavgm")
class FedAvgM(Strategy):
    """Momentum β and learning rate η.

    Raises:
        FederationError: A setting out of range.
    """

    def __init__(self, momentum: float = 0.9, learning_rate: float = 0.3) -> None:
        self.momentum = check_range("momentum", momentum, 0.0, 0.999)
        self.learning_rate = check_range("learning_rate", learning_rate, 1e-6, 100.0)
        self._velocity: Aggregate | None = None

    @classmethod
    def from_settings(cls, settings: StrategySettings) -> Self:
        """See `Strategy.from_settings`."""
        return cls(settings.momentum, settings.server_learning_rate)

    def step(self, aggregate: Aggregate) -> Aggregate:
        """See `Strategy.step`."""
        before = np.zeros_like(aggregate) if self._velocity is None else self._velocity
        self._velocity = self.momentum * before + aggregate
        return self.learning_rate * self._velocity

    def state(self) -> State:
        """See `Strategy.state`."""
        return {} if self._velocity is None else {"velocity": self._velocity}

    def restore(self, state: Mapping[str, NDArray[np.float64]]) -> None:
        """See `Strategy.restore`."""
        self._velocity = state.get("velocity")
