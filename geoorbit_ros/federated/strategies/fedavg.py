"""FedAvg: the mean of the updates, weighted by their numbers of examples.

McMahan et al., "Communication-efficient learning of deep networks from decentralized data", AISTATS
2017, algorithm 1.
"""

from __future__ import annotations

from geoorbit_ros.core.plugins import register
from geoorbit_ros.federated.strategies.strategy import Strategy


@register("strategy", "fedavg")
class FedAvg(Strategy):
    """The common starting point of strategies, as it is."""
