"""Which lane map counts when: maps as they come, and whether two of them have the same lanes."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np

from geoorbit_ros.calibration.plane import RoadPlane
from geoorbit_ros.core.lanes import Lane
from geoorbit_ros.core.polylines import project
from geoorbit_ros.traffic.measures import MeasuredLanes

KEPT_MAPS = 100
"""Maps of a topic that are kept. Chosen: eight minutes of updates every five seconds; the one that
is chosen is at most seconds old."""
SAME_M = 0.3
"""Lanes that moved less are the same. Chosen: a tenth of a lane; less changes the map in use with
every update, more leaves vehicles beside a lane that was found better."""
SAME_END_M = 5.0
"""Lanes whose ends moved less are the same. Chosen: a car's length."""


@dataclass(frozen=True, slots=True)
class StampedLanes:
    """The lanes of a map.

    Attributes:
        stamp_ns: When the map was made, on the clock of the tracks.
        lanes: At least one, in the tracks' frame.
        plane: The calibration in that frame, see `TrafficCounter`.
    """

    stamp_ns: int
    lanes: Sequence[Lane]
    plane: RoadPlane | None = None

    @property
    def counts(self) -> bool:
        """Whether a lane is confirmed: before, nothing is counted."""
        return any(lane.status == "confirmed" for lane in self.lanes)


LanesAt = Callable[[int], StampedLanes | None]
"""The newest lanes that are not later than a stamp, or the first ones; None: there are none yet."""


class MapShelf:
    """Lane maps as they come on a topic; those with a confirmed lane count."""

    def __init__(self) -> None:
        self._maps = list[StampedLanes]()

    def put(self, found: StampedLanes) -> None:
        """Take a map; those that are later are of a source that has started again since."""
        if found.counts:
            earlier = [other for other in self._maps if other.stamp_ns < found.stamp_ns]
            self._maps = [*earlier[-KEPT_MAPS:], found]

    def lanes_at(self, stamp_ns: int) -> StampedLanes | None:
        """See `LanesAt`."""
        earlier = [found for found in self._maps if found.stamp_ns <= stamp_ns]
        return earlier[-1] if earlier else self._maps[0] if self._maps else None


@dataclass(frozen=True, slots=True)
class MapInUse:
    """Which lane map counts from an interval on.

    Attributes:
        from_ns: Begin of the first interval; the first map counts for all earlier ones, too.
        map_ns: The map's stamp.
        lanes: Its lanes.
        order: The same in the order of tables.
    """

    from_ns: int
    map_ns: int
    lanes: tuple[Lane, ...]
    order: MeasuredLanes


def same_lanes(lanes: Sequence[Lane], others: Sequence[Lane]) -> bool:
    """Whether two maps have the same lanes: the same ids, nowhere moved by `SAME_M` or more."""
    by_id = {lane.lane_id: lane for lane in others}
    if len(lanes) != len(by_id) or any(lane.lane_id not in by_id for lane in lanes):
        return False
    return all(_same_lane(lane, by_id[lane.lane_id]) for lane in lanes)


def _same_lane(lane: Lane, other: Lane) -> bool:
    line, old = lane.centerline_m, other.centerline_m
    ends = np.hypot(*(line[[0, -1]] - old[[0, -1]]).T)
    if (ends >= SAME_END_M).any():
        return False
    at = project(line, old)
    return bool((np.abs(at.offset_m[at.inside]) < SAME_M).all() and at.inside.any())
