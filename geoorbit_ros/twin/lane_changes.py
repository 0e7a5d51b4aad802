"""Moves between lanes: their costs in the lane filter, and how fast vehicles cross the road."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from geoorbit_ros.roadnet.network import NO_LANE, RoadNetwork

Array = NDArray[np.float64]

LANE_CHANGE = 2.0
"""Cost of a lane change, in units of log likelihood. Chosen on the shipped scenes (ADR 0018): with
`matching.LATERAL_SIGMA_M` a change is certain within half a second of crossing the line at 10 Hz,
and noise of 0.15 m on the line causes none; less changes lanes too often, more too late."""
BACKWARDS = 1.0
"""Cost of falling back into the lane before. Chosen: positions at the end of a lane do so by noise;
less lets vehicles jump back at forks, more keeps them in a wrong lane."""
TURNAROUND = 4.0
"""Cost of turning round where the network lets a simulator do so. Chosen: two lane changes; less
puts vehicles that leave the network on the turn, more loses those that are seen to turn."""
UNRELATED = 9.0
"""Cost of a move to a lane that is not connected. Chosen: more than four lane changes; less follows
jumps of tracks, more keeps a vehicle on a wrong road for longer."""
REACH_M = 60.0
"""Lanes within this distance along the network are connected. Chosen: farther than a vehicle drives
between two steps; larger costs memory."""
MAX_ACROSS_MPS = 2.5
"""Fastest movement across the road: the peak of a lane change in two seconds, three times the
usual. Measured (ADR 0018, benchmarks/twin_accuracy.py): at Yahara 40 of 9136 steps in the wrong
lane instead of 79."""
BEGINS_S = 1.0
"""The limit holds from this age of a track on. Chosen: the first positions of a track are as
uncertain as those that follow; larger follows jumps of new tracks, smaller holds them beside the
road."""


class LaneLinks:
    """Costs of moves between all pairs of lanes; stored for those that are connected.

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
            _follow(network, lane, network.turnarounds, TURNAROUND, along)
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
    """The same with the lanes beside them, at one lane change per lane."""
    found = dict(along)
    for lane, cost in along.items():
        for beside in (network.left, network.right):
            other, total = int(beside[lane]), cost + LANE_CHANGE
            while other != NO_LANE and total < UNRELATED:
                found[other] = min(found.get(other, UNRELATED), total)
                other, total = int(beside[other]), total + LANE_CHANGE
    return found


class CrossingLimit:
    """Limits how fast vehicles move across the road; remembers each in its slot.

    Args:
        capacity: Slots at first; `reserve` makes more.
    """

    def __init__(self, capacity: int) -> None:
        self._xy = np.full((capacity, 2), np.nan)
        self._age_s = np.zeros(capacity)
        self._unseen = np.zeros(capacity, dtype=np.bool_)

    def reserve(self, capacity: int) -> None:
        """Make room for so many slots."""
        more = capacity - len(self._age_s)
        if more > 0:
            self._xy = np.concatenate([self._xy, np.full((more, 2), np.nan)])
            self._age_s = np.append(self._age_s, np.zeros(more))
            self._unseen = np.append(self._unseen, np.zeros(more, dtype=np.bool_))

    def forget(self, slot: NDArray[np.int64]) -> None:
        """Start again for these slots: they hold new vehicles."""
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
            observed: (M,) whether a camera sees them; one that is seen again may be anywhere.
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
        """Remember vehicles at `xy` (M, 2), their lanes' directions (M,) and their excess (M,)."""
        aside = np.column_stack((np.sin(heading_rad), -np.cos(heading_rad)))
        self._xy[slot] = xy + excess_m[:, None] * aside
