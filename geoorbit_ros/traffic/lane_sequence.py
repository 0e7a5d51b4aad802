"""Which lane each vehicle was in, all along its path.

The most likely sequence of lanes given the places and directions of the whole path (Viterbi 1967):
a place between two lanes is no lane change, and one that is kept is.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from geoorbit_ros.core.lane_order import OPPOSITE_COS, SAME_COS
from geoorbit_ros.core.lanes import Lane
from geoorbit_ros.core.polylines import project, sample
from geoorbit_ros.traffic.road_coordinates import LanePlaces, RoadCoordinates
from geoorbit_ros.traffic.vehicle_paths import Paths

Array = NDArray[np.float64]

DRIVER_SIGMA_M = 0.5
"""1-sigma of a vehicle's place in its lane: drivers differ by 0.35 m and sit 0.24 m off the middle
(18 cameras of BrnoCompSpeed, docs/results.md), and a lorry's ground point lies aside of a car's."""
SAME_ERROR_S = 0.5
"""Places of one vehicle within this time have the same error. Chosen: boxes of one vehicle are off
in the same way over about ten images; larger needs longer to see a lane change."""
CHANGE_COST = 3.0
"""Log odds against a lane change. Chosen: one in a hundred metres of road has none in most traffic;
less reads noise on a line as changes, more misses short ones."""
OTHER_COST = 5.0
"""The same for moves between lanes that are not side by side, and in or out of all lanes. Chosen:
more than a lane change, as vehicles seldom come from beside the road."""
NO_LANE_COST = 6.0
"""Cost of a place in no lane: as much as one 1.7 m from a lane's middle. Chosen: half a lane's
width; less takes vehicles out of lanes that drivers cut, more puts others into one."""
ASIDE_M = 0.75
"""Farther beyond a lane's edge a place is in no lane, however unsure it is. Chosen: the middle of a
vehicle in the next lane is a metre and more beyond."""
MAX_COST = 20.0
"""No place speaks stronger against a lane. Chosen: single boxes can be wrong by any distance."""
BEYOND_M = 5.0
"""A lane goes on this far beyond its ends. Chosen: a car's length; lanes end where traffic is seen
no longer, not at a line."""
BESIDE_M = 6.0
"""Lanes whose middles are this near, side by side, are neighbours. Chosen: less than two widths."""
AT_ONCE = 1_000_000
"""Rows of the longest path times vehicles that are decoded together: 20 MB for ten lanes."""
TURN_NS = 5_000_000_000
"""Least time in which a vehicle turns round. Chosen: a car's U-turn on a wide road."""
DIRECTION_M = 2.0
"""A vehicle that moved less far has no direction. Chosen: the noise of places."""


@dataclass(frozen=True, slots=True)
class LaneSequence:
    """The lane of each row of paths.

    Attributes:
        lane: (N,) index of the lane, -1 for none.
        places: (N, L) where the rows are beside each lane.
        heading_rad: (N,) direction of motion, NaN while it stands.
    """

    lane: NDArray[np.int64]
    places: LanePlaces
    heading_rad: Array


class LaneMatcher:
    """Finds the lanes of paths on one lane map.

    Args:
        roads: The lanes.
    """

    def __init__(self, roads: RoadCoordinates) -> None:
        self.roads = roads
        self._move = _move_costs(roads.lanes)

    def lanes_of(self, paths: Paths) -> LaneSequence:
        """The lanes of all rows."""
        rows = paths.rows
        position = np.column_stack((rows["x"], rows["y"]))
        places = self.roads.at(position)
        heading = directions(paths)
        cost = self._costs(rows, places, heading)
        cost *= _new_information(paths)[:, None]
        return LaneSequence(_cheapest(cost, paths.offset, self._move), places, heading)

    def _costs(self, rows: NDArray[np.void], places: LanePlaces, heading: Array) -> Array:
        """(N, L + 1) how little each row fits each lane; the last column is no lane."""
        sigma = np.hypot(DRIVER_SIGMA_M, np.minimum(rows["sigma"], 1.5))[:, None]
        cost = np.full((len(rows), len(self.roads) + 1), NO_LANE_COST)
        cost[:, :-1] = np.minimum(0.5 * (places.offset_m / sigma) ** 2, MAX_COST)
        outside = (places.arc_m < -BEYOND_M) | (places.arc_m > self.roads.length_m + BEYOND_M)
        with np.errstate(invalid="ignore"):
            against = np.cos(places.heading_rad - heading[:, None]) < SAME_COS
        cost[:, :-1][outside | against | np.isinf(places.offset_m)] = MAX_COST
        # Unsure places fit lanes that are far aside: beyond its edge nobody is in a lane.
        beside = places.half_width_m.min(axis=1, initial=np.inf) + ASIDE_M
        cost[:, -1] = np.minimum(NO_LANE_COST, 0.5 * (beside / sigma[:, 0]) ** 2)
        return cost


def directions(paths: Paths) -> Array:
    """(N,) direction of motion of each row, by the places half a second around; NaN: it stands."""
    rows, begin, end = paths.rows, paths.offset[:-1], paths.offset[1:]
    owner = paths.owner
    if not len(rows):
        return np.empty(0)
    index = np.arange(len(rows))
    ahead = np.minimum(index + 5, end[owner] - 1)
    back = np.maximum(index - 5, begin[owner])
    step_x, step_y = rows["x"][ahead] - rows["x"][back], rows["y"][ahead] - rows["y"][back]
    heading = np.arctan2(step_y, step_x)
    moves = np.hypot(step_x, step_y) >= np.maximum(DIRECTION_M, 2.0 * rows["sigma"])
    return np.where(moves, heading, np.nan)


def cut_at_oncoming(paths: Paths, found: LaneSequence) -> Paths:
    """The paths, cut where a vehicle would go from a lane into an oncoming one within seconds.

    No vehicle turns round so fast: its id went over to another one.
    """
    rows = np.flatnonzero(found.lane >= 0)
    heading = found.places.heading_rad[rows, found.lane[rows]]
    same = np.diff(paths.owner[rows]) == 0
    fast = np.diff(paths.rows["stamp_ns"][rows]) < TURN_NS
    turned = np.cos(np.diff(heading)) < OPPOSITE_COS
    cuts = rows[1:][same & fast & turned]
    return Paths(np.union1d(paths.offset, cuts).astype(np.int64), paths.rows)


def _new_information(paths: Paths) -> Array:
    """(N,) share of a row that is not said by the row before: its time over `SAME_ERROR_S`."""
    step_s = np.diff(paths.rows["stamp_ns"], prepend=0) * 1e-9
    step_s[paths.offset[:-1]] = SAME_ERROR_S
    return np.asarray(np.clip(step_s / SAME_ERROR_S, 0.0, 1.0))


def _move_costs(lanes: Sequence[Lane]) -> Array:
    """(L + 1, L + 1) cost of going from one lane to another."""
    count = len(lanes)
    cost = np.full((count + 1, count + 1), OTHER_COST)
    for i, lane in enumerate(lanes):
        points = sample(lane.centerline_m, 2.0)
        for j, other in enumerate(lanes):
            if i == j:
                continue
            at = project(points.point_m, other.centerline_m)
            along = (points.tangent * at.tangent).sum(axis=1)
            beside = at.inside & (np.abs(at.offset_m) < BESIDE_M)
            if (beside & (along > SAME_COS)).any():
                cost[i, j] = CHANGE_COST
            elif (beside & (along < OPPOSITE_COS)).any():
                cost[i, j] = 2.0 * OTHER_COST
    np.fill_diagonal(cost, 0.0)
    return cost


def _cheapest(cost: Array, offset: NDArray[np.int64], move: Array) -> NDArray[np.int64]:
    """(N,) the cheapest sequence of lanes of each vehicle, -1 for none; many vehicles at once."""
    count = np.diff(offset)
    lane = np.full(len(cost), -1, np.int64)
    order = np.argsort(-count, kind="stable")
    order = order[count[order] > 0]
    while len(order):
        room = max(AT_ONCE // int(count[order[0]]), 1)
        _decode(cost, offset[:-1][order[:room]], count[order[:room]], move, lane)
        order = order[room:]
    return lane


def _decode(
    cost: Array,
    begin: NDArray[np.int64],
    count: NDArray[np.int64],
    move: Array,
    lane: NDArray[np.int64],
) -> None:
    """Write the cheapest sequences of vehicles, the longest path first."""
    states, longest = cost.shape[1], int(count[0])
    total = cost[begin]
    came_from = np.zeros((longest, len(begin), states), np.int16)
    for k in range(1, longest):
        going = int(np.searchsorted(-count, -k, side="left"))  # vehicles with more than k rows
        best, source = total[:going, :1] + move[0], came_from[k, :going]
        for state in range(1, states):
            through = total[:going, state : state + 1] + move[state]
            source[through < best] = state
            np.minimum(best, through, out=best)
        total[:going] = best + cost[begin[:going] + k]
    last = total.argmin(axis=1).astype(np.int64)
    for k in range(longest - 1, -1, -1):
        going = int(np.searchsorted(-count, -k, side="left"))
        lane[begin[:going] + k] = np.where(last[:going] == states - 1, -1, last[:going])
        if k:
            last[:going] = came_from[k, np.arange(going), last[:going]]
