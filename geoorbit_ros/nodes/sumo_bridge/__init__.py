"""Node `sumo_bridge`: the tracks of all cameras move the vehicles of a SUMO simulation."""

from geoorbit_ros.nodes.sumo_bridge.node import SumoBridgeNode, main

__all__ = ["SumoBridgeNode", "main"]
