"""FedProx: FedAvg whose clients are held near the model they started from.

Li et al., "Federated optimization in heterogeneous networks", MLSys 2020, equation 2: the client
minimises its loss plus μ/2 · ‖w - w_global‖².
"""

from __future__ import annotations

from typing import Self

import numpy as np

from geoorbit_ros.core.plugins import register
from geoorbit_ros.federated.payloads.model_layout import Vector
from geoorbit_ros.federated.strategies.strategy import Strategy, StrategySettings, check_range


@register("strategy", "fedprox")
class FedProx(Strategy):
    """Penalty weight μ, which travels to the clients with the model.

    Raises:
        FederationError: A negative or very large μ.
    """

    def __init__(self, proximal_mu: float = 0.1) -> None:
        self.proximal_mu = check_range("proximal_mu", proximal_mu, 0.0, 1e3)

    @classmethod
    def from_settings(cls, settings: StrategySettings) -> Self:
        """See `Strategy.from_settings`."""
        return cls(settings.proximal_mu)


def proximal_gradient(weights: Vector, global_weights: Vector, proximal_mu: float) -> Vector:
    """Gradient of the penalty, μ(w - w_global): what local training adds to its own gradient."""
    return (proximal_mu * (weights - global_weights)).astype(np.float32)
