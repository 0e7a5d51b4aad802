"""What a strategy may decide; each file beside this one overrides one method of it."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np
from numpy.typing import NDArray

from geoorbit_ros.federated.errors import FederationError
from geoorbit_ros.federated.strategies.collection import Aggregate, Collection, RunningMean

State = dict[str, NDArray[np.float64]]


class Strategy:
    """Weighted mean of the updates, added to the model: what strategies start from.

    Attributes:
        proximal_mu: Weight of FedProx's local penalty, sent to the clients.
        buffer_size: Updates after which an asynchronous strategy makes a new model; 0: synchronous
            rounds.
    """

    proximal_mu: float = 0.0
    buffer_size: int = 0

    def weight(self, sample_count: int, staleness: int) -> float:
        """Weight of an update behind which are so many examples, so many models late."""
        return float(sample_count)

    def collection(self, size: int) -> Collection:
        """What a round's updates of this length are collected in."""
        return RunningMean(size)

    def step(self, aggregate: Aggregate) -> Aggregate:
        """Change of the model, shape (size,), for an aggregate; called once per round."""
        return aggregate

    def state(self) -> State:
        """What a restarted server needs to go on as if nothing had happened."""
        return {}

    def restore(self, state: Mapping[str, NDArray[np.float64]]) -> None:
        """Take back what `state` gave."""


def check_range(name: str, value: float, low: float, high: float) -> float:
    """Hand on a setting from low to high, both included.

    Raises:
        FederationError: It lies outside, or is not a number.
    """
    if not low <= value <= high:
        raise FederationError(f"strategy setting '{name}'", value, f"{low:g} to {high:g}")
    return value
