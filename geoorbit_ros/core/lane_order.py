"""Lanes side by side: their numbers across the road, their order, the lane of a position.

Lanes are numbered as traffic agencies count them: 1 is the lane at the outer edge of the road, and
the numbers grow towards the middle (FHWA, Traffic Monitoring Guide, "Lane of Travel": "1 = outside
(rightmost) lane"). Where vehicles drive on the left the outer edge is on the left.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from geoorbit_ros.core.lanes import Lane
from geoorbit_ros.core.polylines import Projection, project, sample

BESIDE_M = 18.0
"""Lanes this near are of one road. Chosen: five lane widths. Smaller, a lane not found between two
others parts their numbers; larger, roads side by side are counted as one."""
SAME_COS, OPPOSITE_COS = 0.8, -0.8
"""Cosine from which two lanes lead the same way, and below which they are opposite. Chosen: 37
degrees, more than any two lanes that run side by side."""
BESIDE_SHARE = 0.2
"""Share of the shorter lane along which the two run side by side. Chosen: larger overlooks short
ramps, smaller takes lanes that follow one another for neighbours."""


def lane_numbers(lanes: Sequence[Lane]) -> dict[int, int]:
    """Number of each lane by its id, counted from the outer edge of the road.

    A lane's number is one more than the highest among the lanes between it and the edge, anywhere
    along it. A ramp is lane 1, and the lane beside it is 2 along all of its length.
    """
    order = _towards_middle(lanes)
    return {lane.lane_id: number for lane, number in zip(lanes, _depth(order), strict=True)}


def left_to_right(lanes: Sequence[Lane]) -> list[Lane]:
    """The lanes ordered by direction of travel, and from the driver's left to right within each."""
    right_of = _right_of(lanes)
    rank = _depth(right_of)  # lanes to the right of it
    road = _roads(right_of)
    heading = [
        min(lanes[k].heading_deg for k in range(len(lanes)) if road[k] == road[i])
        for i in range(len(lanes))
    ]
    keys = [(heading[k], road[k], -rank[k], lanes[k].lane_id) for k in range(len(lanes))]
    return [lanes[k] for k in sorted(range(len(lanes)), key=lambda k: keys[k])]


def drives_on_left(lanes: Sequence[Lane]) -> bool:
    """Whether oncoming lanes lie on the driver's right; False where no oncoming lane is seen."""
    votes = 0.0
    for a in lanes:
        for b in lanes:
            if a is not b:
                side = _side(a, b, -1.0, OPPOSITE_COS)
                votes += 0.0 if side is None else float(np.sign(side))
    return votes < 0.0


def lane_ids_at(
    position_m: NDArray[np.float64], heading_rad: NDArray[np.float64], lanes: Sequence[Lane]
) -> NDArray[np.int64]:
    """(N,) id of the lane that each vehicle is in, 0 for none.

    Args:
        position_m: (N, 2) middles of the vehicles, in the lanes' frame.
        heading_rad: (N,) their headings; NaN fits every lane.
        lanes: The lanes.
    """
    found = np.zeros(len(position_m), dtype=np.int64)
    nearest = np.full(len(position_m), np.inf)
    direction = np.column_stack((np.cos(heading_rad), np.sin(heading_rad)))
    for lane in lanes:
        at = project(position_m, lane.centerline_m)
        along = (at.tangent * direction).sum(axis=1)
        distance = np.abs(at.offset_m)
        half_m = 0.5 * lane.width_m if np.isfinite(lane.width_m) else np.inf
        # Also a vehicle that crosses the lane while it turns has not the lane's direction.
        fits = at.inside & ~(along < SAME_COS) & (distance <= half_m) & (distance < nearest)
        found[fits], nearest[fits] = lane.lane_id, distance[fits]
    return found


def _side(a: Lane, b: Lane, low_cos: float, high_cos: float) -> float | None:
    """Median distance of lane `a` to the left of `b` where they run side by side, or None."""
    points = sample(a.centerline_m, 2.0)
    at: Projection = project(points.point_m, b.centerline_m)
    along = (points.tangent * at.tangent).sum(axis=1)
    beside = at.inside & (np.abs(at.offset_m) < BESIDE_M)
    beside &= (along >= low_cos) & (along <= high_cos)
    shorter_m = min(a.length_m, b.length_m)
    if np.count_nonzero(beside) * points.piece_m < BESIDE_SHARE * shorter_m:
        return None
    return float(np.median(at.offset_m[beside]))


def _right_of(lanes: Sequence[Lane]) -> NDArray[np.bool_]:
    """(N, N) whether lane j runs beside lane i, to its right, in the same direction."""
    right = np.zeros((len(lanes), len(lanes)), dtype=bool)
    for i, lane in enumerate(lanes):
        for j, other in enumerate(lanes):
            if i != j:
                side = _side(other, lane, SAME_COS, 1.1)
                right[i, j] = side is not None and side < 0.0
    return right & ~right.T  # two lanes that cross are not beside each other


def _towards_middle(lanes: Sequence[Lane]) -> NDArray[np.bool_]:
    """(N, N) whether lane j lies between lane i and the outer edge of the road."""
    right = _right_of(lanes)
    return right.T if drives_on_left(lanes) else right


def _depth(beyond: NDArray[np.bool_]) -> list[int]:
    """1 + the longest chain of lanes beyond each; N steps suffice, and end any circle."""
    depth = np.ones(len(beyond), dtype=np.int64)
    for _ in range(len(beyond)):
        depth = 1 + np.where(beyond, depth, 0).max(axis=1, initial=0)
    return [int(k) for k in np.minimum(depth, len(beyond))]


def _roads(right_of: NDArray[np.bool_]) -> list[int]:
    """Lanes that are beside each other, directly or by others, have the same number."""
    road = np.arange(len(right_of))
    beside = right_of | right_of.T
    for _ in range(len(road)):
        road = np.minimum(road, np.where(beside, road, len(road)).min(axis=1, initial=len(road)))
    return [int(k) for k in road]
