"""How vehicles get from lane to lane: what each way costs as evidence, how fast they cross."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from geoorbit_ros.roadnet.network import NO_LANE, RoadNetwork

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
        cost[(before == NO_LANE)[:, :, None] | (after == NO_LANE)[:, None, :]] = 1e6
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
            while other != NO_LANE and total < UNRELATED:
                found[other] = min(found.get(other, UNRELATED), total)
                other, total = int(beside[other]), total + LANE_CHANGE
    return found


Array = NDArray[np.float64]

MAX_ACROSS_MPS = 2.5
"""A lane change in two seconds reaches 2.5 m/s half-way, three times the usual."""
BEGINS_S = 1.0
"""So long the place of a track that has just begun is no better known than what follows."""


class CrossingLimit:
    """Remembers where across the road each vehicle, in its slot, can be.

    Args:
        capacity: Slots at first; `reserve` makes more.
    """

    def __init__(self, capacity: int) -> None:
        self._xy = np.full((capacity, 2), np.nan)
        self._age_s = np.zeros(capacity)
        self._unseen = np.zeros(capacity, dtype=np.bool_)

    def reserve(self, capacity: int) -> None:
        """Room for so many slots."""
        more = capacity - len(self._age_s)
        if more > 0:
            self._xy = np.concatenate([self._xy, np.full((more, 2), np.nan)])
            self._age_s = np.append(self._age_s, np.zeros(more))
            self._unseen = np.append(self._unseen, np.zeros(more, dtype=np.bool_))

    def forget(self, slot: NDArray[np.int64]) -> None:
        """Vehicles in these slots are new ones."""
        self._xy[slot], self._age_s[slot], self._unseen[slot] = np.nan, 0.0, False

    def excess(
        self,
        slot: NDArray[np.int64],
        xy: Array,
        heading_rad: Array,
        observed: NDArray[np.bool_],
        step_s: float,
    ) -> Array:
        """(M, C) how much farther to the left vehicles seem to be than they can be.

        Args:
            slot: (M,) which vehicles.
            xy: (M, 2) where their tracks are.
            heading_rad: (M, C) directions of the lanes that they may be in.
            observed: (M,) whether a camera sees them; where they are seen again, they are.
            step_s: Time since the last step.
        """
        gap = xy - self._xy[slot]
        gap[(self._age_s[slot] < BEGINS_S) | self._unseen[slot] | np.isnan(gap[:, 0])] = 0.0
        self._age_s[slot] += step_s
        self._unseen[slot] = ~observed
        left = gap[:, 1:] * np.cos(heading_rad) - gap[:, :1] * np.sin(heading_rad)
        reach_m = MAX_ACROSS_MPS * step_s
        return np.asarray(left - np.clip(left, -reach_m, reach_m))

    def keep(self, slot: NDArray[np.int64], xy: Array, heading_rad: Array, excess_m: Array) -> None:
        """Vehicles at `xy` (M, 2) are in lanes of these directions (M,), with this excess (M,)."""
        aside = np.column_stack((np.sin(heading_rad), -np.cos(heading_rad)))
        self._xy[slot] = xy + excess_m[:, None] * aside
