"""What a strategy may decide. Each file beside this one overrides one method and registers."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, Self

import numpy as np
from numpy.typing import NDArray

from geoorbit_ros.core import plugins
from geoorbit_ros.federated.errors import FederationError
from geoorbit_ros.federated.strategies.collection import (
    Aggregate,
    Collection,
    RunningMean,
    UpdateTable,
)

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


@plugins.register("strategy", "fedavg")
class FedAvg(Strategy):
    """The mean of the updates, weighted by their numbers of examples: what strategies start from.

    McMahan et al., "Communication-efficient learning of deep networks from decentralized data",
    AISTATS 2017, algorithm 1.
    """


Table = NDArray[np.float64]
"""One update per row, shape (number, size)."""


class RobustStrategy(Strategy):
    """Compares the updates, to withstand false ones; every client counts the same."""

    def combine(self, table: Table) -> Aggregate:
        """One vector, shape (size,), for a table with at least one row."""
        raise NotImplementedError

    def collection(self, size: int) -> Collection:
        """See `Strategy.collection`."""
        return UpdateTable(self.combine)


def byzantine_count(share: float, number: int) -> int:
    """How many of so many updates a share stands for; 30 % of 10 are 3 in floating point, too."""
    return int(share * number + 1e-9)


def make_strategy(name: str, settings: StrategySettings | None = None) -> Strategy:
    """A fresh strategy, by its registered name or as `FILE.py:CLASS`.

    Raises:
        FederationError: A setting is out of range.
        ParameterError: No strategy has this name, or the file has no such class.
    """
    vector = "a vector of finite numbers, as long as the model"
    returns = {
        "step": plugins.Returns(vector, _check_step),
        "combine": plugins.Returns(vector, _check_combined),
        "weight": plugins.Returns("a finite number, at least 0", _check_weight),
    }
    settings = settings or StrategySettings()
    return plugins.make("strategy", name, Strategy, settings, returns=returns)


def _check_step(_: object, given: tuple[Any, ...], change: object) -> Aggregate:
    return _vector(change, len(given[0]))


def _check_combined(_: object, given: tuple[Any, ...], combined: object) -> Aggregate:
    return _vector(combined, given[0].shape[1])


def _vector(found: object, size: int) -> Aggregate:
    if not isinstance(found, np.ndarray):
        raise plugins.WrongResult("None" if found is None else f"a {type(found).__name__}")
    if found.shape != (size,):
        raise plugins.WrongResult(f"an array of shape {found.shape}, not ({size},)")
    if not (np.issubdtype(found.dtype, np.floating) and np.isfinite(found).all()):
        raise plugins.WrongResult(f"{found.dtype} values that are not all finite numbers")
    return found


def _check_weight(_: object, __: tuple[Any, ...], weight: object) -> float:
    if not isinstance(weight, int | float | np.number) or not 0.0 <= float(weight) < np.inf:
        raise plugins.WrongResult(repr(weight))
    return float(weight)


def check_range(name: str, value: float, low: float, high: float) -> float:
    """Hand on a setting from low to high, both included.

    Raises:
        FederationError: It lies outside, or is not a number.
    """
    if not low <= value <= high:
        raise FederationError(f"strategy setting '{name}'", value, f"{low:g} to {high:g}")
    return value
