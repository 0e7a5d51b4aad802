"""Which lane map counts when: maps as they come, and whether two of them have the same lanes."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass

import numpy as np

from geoorbit_ros.calibration.plane import RoadPlane
from geoorbit_ros.core.lanes import Lane
from geoorbit_ros.core.polylines import project
from geoorbit_ros.core.tables import Frames
from geoorbit_ros.traffic.interval_clock import IntervalClock
from geoorbit_ros.traffic.stations import MeasuredLanes

MAP_DELAY_NS = 10_000_000_000
"""How much later than an interval's beginning its lane map is chosen. Chosen: vehicles that were
last seen before that moment are then gone (`track_links.ENDED_NS`), and maps have arrived."""
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


@dataclass(frozen=True, slots=True)
class Chosen:
    """A lane map that counts from an interval on.

    Attributes:
        from_ns: Begin of the interval.
        next_ns: The first frame that is counted on it.
        found: The map.
    """

    from_ns: int
    next_ns: int
    found: StampedLanes


class MapChoice:
    """Chooses the lane map of each interval: the newest one made before it began.

    One that has the same lanes as the map in use is not taken (`SAME_M`). The choice depends on
    stamps alone.

    Args:
        clock: Intervals.
        lanes_at: Gives lane maps.
    """

    def __init__(self, clock: IntervalClock, lanes_at: LanesAt) -> None:
        self._clock, self._lanes_at = clock, lanes_at
        self._used: StampedLanes | None = None
        self._switch_ns = 0

    def start(self, begin_ns: int) -> StampedLanes | None:
        """The map of the first interval, by its begin; None: there is none yet."""
        self._used = self._lanes_at(begin_ns)
        self._switch_ns = self._clock.end_of(begin_ns) + MAP_DELAY_NS
        return self._used

    def parts(self, frames: Frames) -> Iterator[tuple[Frames, Chosen | None]]:
        """Pieces of frames, and after each the map that counts from there on, if it changes.

        Ask for the next piece when this one was counted.
        """
        while True:
            # What is before the moment of choice is counted on the map in use.
            k = int(np.searchsorted(frames.stamp_ns, self._switch_ns, side="right"))
            if k == len(frames):
                yield frames, None
                return
            yield frames.part(0, k), self._choose(int(frames.stamp_ns[k]))
            frames = frames.part(k, len(frames))

    def _choose(self, next_ns: int) -> Chosen | None:
        """The map of the interval that began `MAP_DELAY_NS` before the next frame."""
        assert self._used is not None
        begin_ns = self._clock.start_of(next_ns - MAP_DELAY_NS - 1)
        self._switch_ns = self._clock.end_of(begin_ns) + MAP_DELAY_NS
        found = self._lanes_at(begin_ns)
        if found is None or found.stamp_ns > begin_ns or found.stamp_ns == self._used.stamp_ns:
            return None
        if same_lanes(found.lanes, self._used.lanes):
            return None
        self._used = found
        return Chosen(begin_ns, next_ns, found)


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
