"""What a strategy may decide. Each file beside this one overrides one method and registers."""

from __future__ import annotations

import sys
from abc import abstractmethod
from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, Self

import numpy as np
from numpy.typing import NDArray

from geoorbit_ros.core import plugins
from geoorbit_ros.core.plugin_methods import (
    ARRAYS,
    Returns,
    WrongResult,
    called,
    checked_arrays,
    what,
)
from geoorbit_ros.federated.errors import FederationError
from geoorbit_ros.federated.payloads.model_layout import Vector
from geoorbit_ros.federated.strategies.collection import (
    Aggregate,
    Collection,
    RunningMean,
    UpdateTable,
)

State = dict[str, NDArray[np.float64]]

MAX_CHANGE = 1e6
"""Largest change of a weight that a plug-in's step may make: the upper bound of the parameter
`max_abs_update` (params/federated_server.yaml), which limits what a client may send."""
MAX_WEIGHT = 2.0**20
"""Largest weight of an update: the upper bound of the parameter `max_sample_count`, and times
`MAX_CHANGE` below the `MAX_SUMMAND` of a sum."""


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

    @abstractmethod
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
    vector = Returns("a vector of finite real numbers, as long as the model", _check_step)
    returns = {
        "step": vector,
        "combine": replace(vector, check=_check_combined),
        "weight": Returns(f"a number from 0 to {MAX_WEIGHT:g}", _check_weight),
        "collection": Returns("an empty Collection (strategies/collection.py)", _check_collection),
        "state": Returns(ARRAYS, checked_arrays),
        "proximal_mu": Returns("a finite number, at least 0", _check_attribute),
        "buffer_size": Returns("a whole number, at least 0", _check_attribute),
    }
    settings = settings or StrategySettings()
    return plugins.make("strategy", name, Strategy, settings, returns=returns)


def _check_step(_: object, given: tuple[Any, ...], change: object) -> Aggregate:
    found = _vector(change, len(given[0]))
    if (largest := float(np.max(np.abs(found), initial=0.0))) > MAX_CHANGE:
        raise WrongResult(f"a weight changed by {largest:g}, more than {MAX_CHANGE:g}")
    return found


def _check_combined(_: object, given: tuple[Any, ...], combined: object) -> Aggregate:
    return _vector(combined, given[0].shape[1])


def _vector(found: object, size: int) -> Aggregate:
    if not isinstance(found, np.ndarray):
        raise WrongResult(what(found))
    if found.shape != (size,):
        raise WrongResult(f"an array of shape {found.shape}, not ({size},)")
    if not np.issubdtype(found.dtype, np.floating):
        raise WrongResult(f"{found.dtype} values, not float64")
    if bad := int(np.count_nonzero(~np.isfinite(found))):
        raise WrongResult(f"{found.dtype} values that are not all finite: {bad} of {size}")
    return found


def _check_weight(_: object, __: tuple[Any, ...], weight: object) -> float:
    if not isinstance(weight, int | float | np.number) or not 0.0 <= weight <= MAX_WEIGHT:
        raise WrongResult(repr(weight))
    return float(weight)


def _check_attribute(_: object, __: tuple[Any, ...], value: object) -> object:
    whole = isinstance(value, int | np.integer) and not isinstance(value, bool)
    if not (whole or isinstance(value, float)) or not 0.0 <= value < np.inf:  # type: ignore[operator]
        raise WrongResult(repr(value))
    return value


def _check_collection(plugin: object, given: tuple[Any, ...], own: object) -> Collection:
    if not isinstance(own, Collection):
        missing = [part for part in ("number", "add", "result") if part not in dir(own)]
        raise WrongResult(f"{what(own)} without {', '.join(missing)}")
    if own.number != 0:
        raise WrongResult(f"one with number {own.number!r}")
    file = sys.modules[type(plugin).__module__].__file__
    return _CheckedCollection(own, given[0], Path(str(file)))


class _CheckedCollection:
    """What a plug-in collects updates in: mistakes are told as those of its other methods."""

    def __init__(self, own: Collection, size: int, file: Path) -> None:
        self._own, self._file = own, file
        self._result = Returns(
            "a vector of finite real numbers, as long as the model",
            lambda _, __, found: _vector(found, size),
        )

    @property
    def number(self) -> int:
        """See `Collection.number`."""
        return int(self._call("number", lambda own: own.number))

    def add(self, client: int, update: Vector, weight: float) -> None:
        """See `Collection.add`."""
        self._call("add", lambda own: own.add(client, update, weight))

    def result(self) -> Aggregate:
        """See `Collection.result`."""
        found: Aggregate = self._call("result", lambda own: own.result(), self._result)
        return found

    def _call(
        self, name: str, do: Callable[[Collection], object], returns: Returns | None = None
    ) -> Any:
        method = f"{type(self._own).__name__}.{name}"
        return called(do, self._file, method, returns, self._own)


def check_range(name: str, value: float, low: float, high: float) -> float:
    """Hand on a setting from low to high, both included.

    Raises:
        FederationError: It lies outside, or is not a number.
    """
    if not low <= value <= high:
        raise FederationError(f"strategy setting '{name}'", value, f"{low:g} to {high:g}")
    return value
