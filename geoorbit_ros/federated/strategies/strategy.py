"""What a strategy may decide. Each file beside this one overrides one method and registers."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Self

import numpy as np
from numpy.typing import NDArray

from geoorbit_ros.core import plugins
from geoorbit_ros.federated.errors import FederationError
from geoorbit_ros.federated.strategies.collection import Aggregate, Collection, RunningMean

State = dict[str, NDArray[np.float64]]


@dataclass(frozen=True, slots=True)
class StrategySettings:
    """Settings of all strategies; each takes its own.

    Attributes:
        server_learning_rate: η of FedAvgM, FedAdam and FedBuff.
        momentum: β of FedAvgM.
        proximal_mu: μ of FedProx.
        byzantine_share: Share of false updates that TrimmedMean and MultiKrum withstand.
        buffer_size: K of FedBuff.
    """

    server_learning_rate: float = 0.3
    momentum: float = 0.9
    proximal_mu: float = 0.1
    byzantine_share: float = 0.3
    buffer_size: int = 10


class Strategy:
    """Weighted mean of the updates, added to the model: what strategies start from.

    Attributes:
        proximal_mu: Weight of FedProx's local penalty, sent to the clients.
        buffer_size: Updates after which an asynchronous strategy makes a new model; 0: synchronous
            rounds.
    """

    proximal_mu: float = 0.0
    buffer_size: int = 0

    @classmethod
    def from_settings(cls, settings: StrategySettings) -> Self:  # noqa: ARG003 - for overriders
        """A strategy with the settings that it needs; by default none."""
        return cls()

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


def make_strategy(name: str, settings: StrategySettings | None = None) -> Strategy:
    """A fresh strategy, by its registered name or as `FILE.py:CLASS`.

    Raises:
        FederationError: A setting is out of range.
        ParameterError: No strategy has this name, or the file has no such class.
    """
    return plugins.make("strategy", name, Strategy, settings or StrategySettings())


def check_range(name: str, value: float, low: float, high: float) -> float:
    """Hand on a setting from low to high, both included.

    Raises:
        FederationError: It lies outside, or is not a number.
    """
    if not low <= value <= high:
        raise FederationError(f"strategy setting '{name}'", value, f"{low:g} to {high:g}")
    return value
