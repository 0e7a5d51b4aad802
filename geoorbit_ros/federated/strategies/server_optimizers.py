"""FedAvgM and FedAdam: the mean update is the gradient of a step that the server makes.

FedAvgM is FedAvg with momentum: Hsu, Qi, Brown, "Measuring the effects of non-identical data
distribution for federated visual classification", 2019 (arXiv:1909.06335), section 4.3:
v ← βv + Δ, w ← w + ηv.

FedAdam is a step of Adam: Reddi et al., "Adaptive federated optimization", ICLR 2021, algorithm 2:
m ← β₁m + (1-β₁)Δ, v ← β₂v + (1-β₂)Δ², w ← w + η m / (√v + τ).
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


@register("strategy", "fedadam")
class FedAdam(Strategy):
    """Learning rate η, decays β₁ and β₂, and τ, which bounds how adaptive it is.

    Raises:
        FederationError: A setting out of range.
    """

    def __init__(
        self,
        learning_rate: float = 0.03,
        beta_1: float = 0.9,
        beta_2: float = 0.99,
        tau: float = 1e-3,
    ) -> None:
        self.learning_rate = check_range("learning_rate", learning_rate, 1e-6, 100.0)
        self.beta_1 = check_range("beta_1", beta_1, 0.0, 0.999)
        self.beta_2 = check_range("beta_2", beta_2, 0.0, 0.99999)
        self.tau = check_range("tau", tau, 1e-9, 1.0)
        self._moments: NDArray[np.float64] | None = None

    @classmethod
    def from_settings(cls, settings: StrategySettings) -> Self:
        """See `Strategy.from_settings`."""
        return cls(settings.server_learning_rate)

    def step(self, aggregate: Aggregate) -> Aggregate:
        """See `Strategy.step`."""
        before = np.zeros((2, len(aggregate))) if self._moments is None else self._moments
        first = self.beta_1 * before[0] + (1 - self.beta_1) * aggregate
        second = self.beta_2 * before[1] + (1 - self.beta_2) * aggregate**2
        self._moments = np.stack([first, second])
        return np.asarray(self.learning_rate * first / (np.sqrt(second) + self.tau))

    def state(self) -> State:
        """See `Strategy.state`."""
        return {} if self._moments is None else {"moments": self._moments}

    def restore(self, state: Mapping[str, NDArray[np.float64]]) -> None:
        """See `Strategy.restore`."""
        self._moments = state.get("moments")
