"""What it costs, as evidence, to get from one lane to another between two observations."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from geoorbit_ros.twin.network import NONE, RoadNetwork

LANE_CHANGE = 2.0
"""With the observations' own weight (`matching.LATERAL_SIGMA_M`) a change is certain within half a
second of crossing the line at 10 Hz, and noise of 0.15 m on the line makes none."""
BACKWARDS = 1.0
"""A position may fall back over the end of a lane by its own noise."""
UNRELATED = 9.0
REACH_M = 60.0
"""Nobody drives farther between two observations."""


class LaneLinks:
    """Costs between all pairs of lanes, kept for those that are related.

    Args:
        network: Whose lanes.
    """

    def __init__(self, network: RoadNetwork) -> None:
        self._count = len(network)
        costs: dict[int, float] = {}
        for lane in range(len(network)):
            along = {lane: 0.0}
            _follow(network, lane, network.successors, 0.0, along)
            _follow(network, lane, network.predecessors, BACKWARDS, along)
            for other, cost in _with_neighbours(network, along).items():
                costs[lane * self._count + other] = cost
        pairs = sorted(costs)
        self._pair = np.array([*pairs, np.iinfo(np.int64).max], dtype=np.int64)
        self._cost = np.array([*(costs[pair] for pair in pairs), UNRELATED])

    def cost(self, before: NDArray[np.int64], after: NDArray[np.int64]) -> NDArray[np.float64]:
        """(M, C, C) costs from each of lanes (M, C) to each of lanes (M, C)."""
        pair = before[:, :, None] * self._count + after[:, None, :]
        at = np.searchsorted(self._pair, pair)
        cost = np.where(self._pair[at] == pair, self._cost[at], UNRELATED)
        cost[(before == NONE)[:, :, None] | (after == NONE)[:, None, :]] = 1e6
        return cost


def _follow(
    network: RoadNetwork,
    lane: int,
    nexts: tuple[tuple[int, ...], ...],
    cost: float,
    found: dict[int, float],
) -> None:
    """All lanes within reach along `nexts`."""
    waiting = [(lane, 0.0)]
    while waiting:
        at, driven = waiting.pop()
        for other in nexts[at]:
            if other not in found:
                found[other] = cost
                if driven + network.length_m[other] < REACH_M:
                    waiting.append((other, driven + float(network.length_m[other])))


def _with_neighbours(network: RoadNetwork, along: dict[int, float]) -> dict[int, float]:
    """With the lanes beside them, one lane change per lane."""
    found = dict(along)
    for lane, cost in along.items():
        for beside in (network.left, network.right):
            other, total = int(beside[lane]), cost + LANE_CHANGE
            while other != NONE and total < UNRELATED:
                found[other] = min(found.get(other, UNRELATED), total)
                other, total = int(beside[other]), total + LANE_CHANGE
    return found
