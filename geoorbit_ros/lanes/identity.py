"""Lane ids that outlive every refinement of the map."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import linear_sum_assignment

from geoorbit_ros.core.lanes import Lane

MATCH_M = 1.6
"""Half the narrowest spacing of lanes, and a little: further apart is another lane."""
MATCH_RAD = 0.6


class LaneRegistry:
    """Gives each lane the id it had before; a lane that comes back gets its old id back."""

    def __init__(self) -> None:
        self._known: dict[int, Lane] = {}
        self._next_id = 1

    def identify(self, lanes: Sequence[Lane]) -> tuple[Lane, ...]:
        """The same lanes with lasting ids, ordered by id. Ids in the argument are ignored."""
        known = list(self._known.values())
        ids = [0] * len(lanes)
        if known and lanes:
            cost = np.array([[_distance_m(a, b) for b in known] for a in lanes])
            blocked = cost > MATCH_M
            for i, k in zip(*linear_sum_assignment(np.where(blocked, 1e3, cost)), strict=True):
                if not blocked[i, k]:
                    ids[i] = known[k].lane_id
        for i, lane_id in enumerate(ids):
            if lane_id == 0:
                ids[i] = self._next_id
                self._next_id += 1
        named = [replace(lane, lane_id=i) for lane, i in zip(lanes, ids, strict=True)]
        self._known.update({lane.lane_id: lane for lane in named})
        return tuple(sorted(named, key=lambda lane: lane.lane_id))

    def was_confirmed(self, lane: Lane) -> bool:
        """Whether a lane at this place was confirmed when last seen."""
        return any(
            old.status == "confirmed" and _distance_m(lane, old) <= MATCH_M
            for old in self._known.values()
        )


def _distance_m(a: Lane, b: Lane) -> float:
    """Median distance of the shorter line's points to the longer line; inf if directions differ."""
    short, long = (a, b) if a.length_m <= b.length_m else (b, a)
    distance, heading = _to_line(short.centerline_m, long.centerline_m)
    own = np.arctan2(*np.gradient(short.centerline_m, axis=0).T[::-1])
    turn = np.abs((own - heading + np.pi) % (2.0 * np.pi) - np.pi)
    if np.median(turn) > MATCH_RAD:
        return float("inf")
    return float(np.median(distance))


def _to_line(
    points: NDArray[np.float64], line: NDArray[np.float64]
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """(K,) distance of points to a polyline and the polyline's heading at the foot."""
    a, step = line[:-1], np.diff(line, axis=0)
    t = ((points[:, None] - a) * step).sum(axis=2) / np.maximum((step**2).sum(axis=1), 1e-12)
    foot = a + np.clip(t, 0.0, 1.0)[..., None] * step
    distance = np.hypot(*np.moveaxis(points[:, None] - foot, 2, 0))
    k = np.argmin(distance, axis=1)
    return distance[np.arange(len(points)), k], np.arctan2(step[k, 1], step[k, 0])
