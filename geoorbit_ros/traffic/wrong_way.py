"""Vehicles that drive against the direction of the lane that they are in."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from math import atan2, cos, hypot, isfinite, sin

import numpy as np
from numpy.typing import NDArray

from geoorbit_ros.core.lanes import Lane
from geoorbit_ros.traffic.event_records import EventKind, EventLog
from geoorbit_ros.traffic.lane_neighbours import same_way
from geoorbit_ros.traffic.moments import JOIN_NS, MOVES_MPS, TICK_NS, Moment
from geoorbit_ros.traffic.watched_tracks import (
    FORGET_NS,
    LINK_ACROSS_M,
    LINK_M,
    SHARP_M,
    WatchedTrack,
    along_and_left,
)

LEAST_MOMENTS = 4
"""So many half seconds in a row it must drive against the lane. Chosen: shorter is an id that jumps
to another vehicle."""
LEAST_M, LEAST_SIGMAS = 20.0, 10.0
"""And so far, in metres and in errors of its places. Chosen: who backs up to park goes less far."""
OVERTAKER_M = 100.0
"""Who came from a lane of its own direction overtakes: so far it may. Chosen: who overtakes is
oncoming for longer, and then it is no false report."""
CAME_M = 10.0
"""A vehicle came from its own lane if it drove there for so long. Chosen: two lengths."""
ASIDE_M = 0.7
"""Nearer to a lane of its own direction it may be in it. Chosen: two sigma of a vehicle's place."""
IN_LANE = 0.7
"""Share of half the lane's width within which it must be. Chosen: on the line there is no lane."""
STEADY = 0.5
"""Its steps differ by at most this share of their mean. Chosen: a vehicle can't change its speed so
much in half a second; who jumps from vehicle to vehicle does."""
WITH_VEHICLES, AGAINST_SHARE = 5, 0.05
"""At least so many vehicles drove along the lane, or those beside it, before; and of those in it no
more than this share against it: otherwise it leads both ways. Chosen: one in twenty would be one in
a minute."""
SHARE_MEMORY = 400.0
"""Vehicles after which what was seen of a lane counts half: an hour's traffic of a quiet lane."""


@dataclass(slots=True)
class _Way:
    """How a track drives.

    Attributes:
        run: Its moments against the lane, in a row.
        with_m: Metres in lanes that lead its way, the way it drives now.
        with_heading: Its heading there, radians.
        counted: The lanes (id) and ways in which it was counted.
    """

    run: list[Moment]
    with_m: float = 0.0
    with_heading: float = 0.0
    last_ns: int = 0
    event: NDArray[np.void] | None = None
    counted: tuple[tuple[int, int], ...] = ()


class WrongWayWatch:
    """Finds vehicles that drive against their lane.

    Args:
        log: Takes the events.
    """

    def __init__(self, log: EventLog) -> None:
        self._log = log
        self._ways: dict[int, _Way] = {}
        self._counts: dict[int, list[float]] = {}

    def use_lanes(self, lanes: Sequence[Lane]) -> None:
        """Look on these lanes from now on; what is known of a lane goes on under its id."""
        self._lanes = lanes
        self._same_way = same_way(lanes)
        for way in self._ways.values():
            way.run.clear()

    def take(self, stamp_ns: int, tracks: list[WatchedTrack]) -> None:
        """Take the tracks of a half second."""
        for track in tracks:
            at = track.last
            way = self._ways.get(at.track_id)
            if way is None:
                if at.way == 0:
                    continue
                way = self._ways[at.track_id] = _Way([])
            if way.last_ns and at.stamp_ns - way.last_ns > FORGET_NS:
                self._over(stamp_ns, way)
                self._ways[at.track_id] = way = _Way([])
            if not way.run and _is_against(at):
                self._go_on(way, at)
            way.last_ns = at.stamp_ns
            self._moment(stamp_ns, way, track)
        for key in [k for k, way in self._ways.items() if way.last_ns < stamp_ns - FORGET_NS]:
            self._over(stamp_ns, self._ways.pop(key))

    def _go_on(self, way: _Way, at: Moment) -> None:
        """Who was hidden goes on under another id where it would have come to by its speed."""
        for other in self._ways.values():
            if other is way or not other.run:
                continue
            last = other.run[-1]
            since_s = (at.stamp_ns - last.stamp_ns) * 1e-9
            if other.last_ns != last.stamp_ns or not 0.0 < since_s <= JOIN_NS * 1e-9:
                continue
            way_m = hypot(last.vx, last.vy) * since_s
            along, left = along_and_left(last.x, last.y, atan2(last.vy, last.vx), at)
            if abs(left) <= LINK_ACROSS_M and abs(along - way_m) <= LINK_M:
                way.run, way.with_m, way.with_heading = other.run, other.with_m, other.with_heading
                way.event, other.event, other.run = other.event, None, []
                return

    def _moment(self, stamp_ns: int, way: _Way, track: WatchedTrack) -> None:
        at = track.last
        if at.way == 1 and isfinite(at.vx):
            way.with_m += hypot(at.vx, at.vy) * TICK_NS * 1e-9
            way.with_heading = atan2(at.vy, at.vx)
            self._count(way, at)
        if not _is_against(at):
            way.run = []
            return
        if cos(atan2(at.vy, at.vx) - way.with_heading) < 0.0:
            way.with_m = 0.0  # the id was another vehicle's: none turns round so fast
        way.run.append(at)
        if way.event is not None:
            return
        if len(way.run) < LEAST_MOMENTS or not _is_steady(way.run):
            return
        first = way.run[0]
        against_m = hypot(at.x - first.x, at.y - first.y)
        needed_m = OVERTAKER_M if way.with_m >= CAME_M else LEAST_M
        if against_m < max(needed_m, LEAST_SIGMAS * at.sigma):
            return
        along, against = self._counts.get(self._lanes[at.lane].lane_id, (0.0, 0.0))
        self._count(way, at)
        if (
            self._along(at.lane) < WITH_VEHICLES
            or against > AGAINST_SHARE * (along + against) + 1.0
        ):
            return
        way.event = self._log.begin(
            EventKind.WRONG_WAY,
            stamp_ns,
            first_ns=first.stamp_ns,
            last_ns=at.stamp_ns,
            lane_id=self._lanes[at.lane].lane_id,
            track_id=at.track_id,
            arc_m=at.arc,
            x=at.x,
            y=at.y,
            vehicles=1,
            length_m=against_m,
            speed_mps=against_m / ((at.stamp_ns - first.stamp_ns) * 1e-9),
        )

    def _along(self, lane: int) -> float:
        """How many drove along a lane and those beside it."""
        ids = [self._lanes[k].lane_id for k in np.flatnonzero(self._same_way[lane]).tolist()]
        return sum(self._counts[lane_id][0] for lane_id in ids if lane_id in self._counts)

    def _count(self, way: _Way, at: Moment) -> None:
        """Count a track once for each lane and way."""
        if at.lane < 0:
            return
        key = self._lanes[at.lane].lane_id, at.way
        if key in way.counted:
            return
        way.counted = (*way.counted, key)
        counts = self._counts.setdefault(key[0], [0.0, 0.0])
        counts[0 if at.way == 1 else 1] += 1.0
        if sum(counts) > SHARE_MEMORY:
            counts[:] = [0.5 * count for count in counts]

    def _over(self, stamp_ns: int, way: _Way) -> None:
        if way.event is not None:
            self._log.end(way.event, stamp_ns, last_ns=way.last_ns)


def _is_against(at: Moment) -> bool:
    """Whether a vehicle drives against the lane that it is in, and in no lane of its own way."""
    if at.way != -1 or at.lane < 0 or at.sigma > SHARP_M or not isfinite(at.vx):
        return False
    if abs(at.offset) > IN_LANE * at.half_width or at.own_gap < ASIDE_M:
        return False
    # A track that jumps back from vehicle to vehicle drives forward between its jumps.
    within = at.within_x * cos(at.heading) + at.within_y * sin(at.heading)
    return not within > -0.5 * MOVES_MPS


def _is_steady(run: list[Moment]) -> bool:
    """Whether the steps of a run are those of one vehicle."""
    speeds = [hypot(at.vx, at.vy) for at in run[1:]]
    mean = sum(speeds) / len(speeds)
    return all(abs(speed - mean) <= STEADY * mean for speed in speeds)
