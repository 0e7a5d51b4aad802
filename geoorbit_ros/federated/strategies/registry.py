"""Strategies by the name that users give."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

from geoorbit_ros.core.plugins import FORM, is_own_class, make_own
from geoorbit_ros.federated.errors import FederationError
from geoorbit_ros.federated.strategies.fedadam import FedAdam
from geoorbit_ros.federated.strategies.fedavg import FedAvg
from geoorbit_ros.federated.strategies.fedavgm import FedAvgM
from geoorbit_ros.federated.strategies.fedbuff import FedBuff
from geoorbit_ros.federated.strategies.fedmedian import FedMedian
from geoorbit_ros.federated.strategies.fedprox import FedProx
from geoorbit_ros.federated.strategies.multi_krum import MultiKrum
from geoorbit_ros.federated.strategies.strategy import Strategy
from geoorbit_ros.federated.strategies.trimmed_mean import TrimmedMean


@dataclass(frozen=True, slots=True)
class StrategySettings:
    """Settings of all strategies; each takes its own.

    Attributes:
        server_learning_rate: η of FedAvgM, FedAdam and FedBuff.
        momentum: β of FedAvgM.
        proximal_mu: μ of FedProx.
        byzantine_share: Liars that TrimmedMean and MultiKrum expect.
        buffer_size: K of FedBuff.
    """

    server_learning_rate: float = 0.3
    momentum: float = 0.9
    proximal_mu: float = 0.1
    byzantine_share: float = 0.3
    buffer_size: int = 10


STRATEGIES: dict[str, Callable[[StrategySettings], Strategy]] = {
    "fedavg": lambda _: FedAvg(),
    "fedavgm": lambda s: FedAvgM(s.momentum, s.server_learning_rate),
    "fedadam": lambda s: FedAdam(s.server_learning_rate),
    "fedprox": lambda s: FedProx(s.proximal_mu),
    "fedmedian": lambda _: FedMedian(),
    "trimmed_mean": lambda s: TrimmedMean(s.byzantine_share),
    "multi_krum": lambda s: MultiKrum(s.byzantine_share),
    "fedbuff": lambda s: FedBuff(s.buffer_size, s.server_learning_rate),
}


def make_strategy(name: str, settings: StrategySettings | None = None) -> Strategy:
    """A fresh strategy, by its name or as `FILE.py:CLASS`, which is made without settings.

    Raises:
        FederationError: No strategy has this name, or a setting is out of range.
        ParameterError: The file has no such class.
    """
    if is_own_class(name):
        own: Strategy = make_own(
            name, "parameter 'strategy'", ("weight", "collection", "step", "state", "restore")
        )
        return own
    if name not in STRATEGIES:
        raise FederationError("strategy", repr(name), " or ".join([*sorted(STRATEGIES), FORM]))
    return STRATEGIES[name](settings or StrategySettings())
