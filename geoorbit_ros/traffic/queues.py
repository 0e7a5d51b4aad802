"""Queues: vehicles that wait or creep one behind the other in a lane, and where the last one is."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from math import isfinite

import numpy as np
from numpy.typing import NDArray

from geoorbit_ros.core.lanes import Lane
from geoorbit_ros.traffic.event_records import EventKind, EventLog
from geoorbit_ros.traffic.watched_tracks import SHARP_M, WatchedTrack

LEAST_VEHICLES = 3
"""So many make a queue. Chosen: two may wait for each other; more misses the short ones."""
GAP_M = 15.0
"""The most between two of them. Chosen: three lengths of a car; in the HCM a vehicle has joined a
queue when it is nearer than one, and some are not seen."""
LENGTH_M = 4.5
"""Of a vehicle whose length is unknown: a car's."""
LASTS_TICKS = 20
"""A queue is one after ten seconds, and over ten seconds after. Chosen: less reports every wave of
braking, more is late."""
MISSED_TICKS = 8
"""So long it may look shorter without having dissolved. Chosen: lorries hide vehicles for four
seconds."""
NEWS_M, NEWS_TICKS = 10.0, 20
"""A tail that has moved by this much is told, at most every ten seconds. Chosen: two vehicles."""


@dataclass(slots=True)
class _Group:
    """Vehicles that wait in a lane, one behind the other."""

    tail_m: float
    head_m: float
    vehicles: int
    last: WatchedTrack


@dataclass(slots=True)
class _Queue:
    """A queue that may be one."""

    group: _Group
    first_ns: int
    last_ns: int
    seen: int = 0
    missed: int = 0
    told_m: float = 0.0
    told_ticks: int = 0
    event: NDArray[np.void] | None = None


class QueueWatch:
    """Finds the queue of each lane.

    Args:
        log: Takes the events.
    """

    def __init__(self, log: EventLog) -> None:
        self._log = log
        self._queues: dict[int, _Queue] = {}

    def use_lanes(self, lanes: Sequence[Lane]) -> None:
        """Look on these lanes from now on; queues go on under their lane's id."""
        self._lanes = lanes

    def take(self, stamp_ns: int, tracks: list[WatchedTrack]) -> None:
        """Take the tracks of a half second."""
        slow: dict[int, list[WatchedTrack]] = {}
        for track in tracks:
            at = track.last
            if at.lane >= 0 and track.is_slow and track.is_vehicle and at.sigma <= SHARP_M:
                slow.setdefault(self._lanes[at.lane].lane_id, []).append(track)
        for lane_id in sorted(slow.keys() | self._queues.keys()):
            self._lane(stamp_ns, lane_id, _longest(slow.get(lane_id, [])))

    def _lane(self, stamp_ns: int, lane_id: int, group: _Group | None) -> None:
        queue = self._queues.get(lane_id)
        if queue is None:
            if group is not None and group.vehicles >= LEAST_VEHICLES:
                self._queues[lane_id] = _Queue(group, stamp_ns, stamp_ns, seen=1)
            return
        least = LEAST_VEHICLES if queue.event is None else LEAST_VEHICLES - 1
        if group is None or group.vehicles < least:
            queue.missed += 1
            limit = MISSED_TICKS if queue.event is None else LASTS_TICKS
            if queue.missed > limit:
                del self._queues[lane_id]
                if queue.event is not None:
                    self._log.end(queue.event, stamp_ns, last_ns=queue.last_ns)
            return
        queue.group, queue.last_ns, queue.missed = group, stamp_ns, 0
        queue.seen += 1
        queue.told_ticks += 1
        if queue.event is None:
            if queue.seen >= LASTS_TICKS:
                what = _what(queue, lane_id)
                queue.event = self._log.begin(
                    EventKind.QUEUE, stamp_ns, first_ns=queue.first_ns, **what
                )
                queue.told_m, queue.told_ticks = group.tail_m, 0
        elif abs(group.tail_m - queue.told_m) >= NEWS_M and queue.told_ticks >= NEWS_TICKS:
            self._log.change(queue.event, stamp_ns, **_what(queue, lane_id))
            queue.told_m, queue.told_ticks = group.tail_m, 0


def _what(queue: _Queue, lane_id: int) -> dict[str, float]:
    group, at = queue.group, queue.group.last.last
    return {
        "last_ns": queue.last_ns,
        "lane_id": lane_id,
        "track_id": at.track_id,
        "arc_m": group.tail_m,
        "x": at.x,
        "y": at.y,
        "vehicles": group.vehicles,
        "length_m": group.head_m - group.tail_m,
    }


def _longest(tracks: list[WatchedTrack]) -> _Group | None:
    """The longest group, of several equal ones the last along the lane."""
    best: _Group | None = None
    group: _Group | None = None
    for track in sorted(tracks, key=lambda t: (t.last.arc, t.last.track_id)):
        arc, length = track.last.arc, track.last.length
        half = 0.5 * (length if isfinite(length) else LENGTH_M)
        if group is not None and arc - half - group.head_m <= GAP_M:
            group.head_m = max(group.head_m, arc + half)
            group.vehicles += 1
        else:
            group = _Group(arc - half, arc + half, 1, track)
        if best is None or group.vehicles >= best.vehicles:
            best = group
    return best
