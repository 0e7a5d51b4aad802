"""From a recording to its traffic: what `geoorbit traffic` and the report compute."""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from geoorbit_ros.core.errors import NoTrafficError
from geoorbit_ros.core.tables import Frames
from geoorbit_ros.traffic.class_schemes import ClassScheme
from geoorbit_ros.traffic.counter import Counted, TrafficCounter
from geoorbit_ros.traffic.event_records import EVENT_DTYPE, EventState, newest_rows
from geoorbit_ros.traffic.events import EventWatch
from geoorbit_ros.traffic.interval_clock import IntervalClock, ObservedTime
from geoorbit_ros.traffic.measures import Traffic, measure, measured_lanes
from geoorbit_ros.traffic.movements import count_movements, find_gates
from geoorbit_ros.traffic.records import CROSSING_DTYPE, PASSAGE_DTYPE

AT_ONCE = 1000
"""Intervals measured at once. Chosen: 10 MB of tables for ten lanes; more takes memory."""
TAKE_NS = 60_000_000_000
"""Time between two looks for vehicles that are gone. Chosen: more often costs time where vehicles
stand in view, more seldom takes memory."""


@dataclass(slots=True)
class Recorded:
    """All vehicles of a recording.

    Attributes:
        counter: What counted them; it has the lanes and the stations.
        observed: When the camera watched.
        watch: What looked for events.
        first_ns: Stamp of the first frame.
        last_ns: Stamp of the last frame.
        frames: How many frames there were.
        vehicles: How many vehicles.
        in_no_lane: How many of them drove along no lane.
    """

    counter: TrafficCounter
    observed: ObservedTime
    watch: EventWatch
    first_ns: int = 0
    last_ns: int = 0
    frames: int = 0
    vehicles: int = 0
    in_no_lane: int = 0
    _taken_ns: int = 0
    _counted: list[Counted] = field(default_factory=list)
    _events: list[NDArray[np.void]] = field(default_factory=list)

    def add(self, frames: Frames) -> None:
        """Take frames of `TRACK_DTYPE`, later than those before."""
        if not len(frames):
            return
        if not self.frames:
            self.first_ns = int(frames.stamp_ns[0])
        self.last_ns = int(frames.stamp_ns[-1])
        self.frames += len(frames)
        self.observed.add(frames.stamp_ns)
        self.counter.add(frames)
        self.watch.add(frames)
        self._events.append(self.watch.take())
        if self.last_ns - self._taken_ns >= TAKE_NS:  # each time sorts all that is in view
            self._taken_ns = self.last_ns
            self._keep(self.counter.take())

    def finish(self) -> None:
        """Count the vehicles that are still in view."""
        self._keep(self.counter.finish())

    def _keep(self, counted: Counted) -> None:
        self.vehicles += counted.vehicles
        self.in_no_lane += counted.in_no_lane
        if counted.vehicles:
            self._counted.append(counted)

    @property
    def passages(self) -> NDArray[np.void]:
        """(P,) `PASSAGE_DTYPE` of all vehicles."""
        return np.concatenate([np.empty(0, PASSAGE_DTYPE), *(c.passages for c in self._counted)])

    @property
    def crossings(self) -> NDArray[np.void]:
        """(C,) `CROSSING_DTYPE` of all vehicles."""
        return np.concatenate([np.empty(0, CROSSING_DTYPE), *(c.crossings for c in self._counted)])

    @property
    def events(self) -> NDArray[np.void]:
        """(E,) `EVENT_DTYPE`: the newest row of each event, by their beginning.

        What has not ended goes on until the last frame.
        """
        rows = np.concatenate([np.empty(0, EVENT_DTYPE), *self._events])
        rows = newest_rows(rows)
        going_on = rows["state"] != EventState.ENDED
        rows["last_ns"][going_on] = self.last_ns
        return rows

    def traffic(self, scheme: ClassScheme) -> Traffic:
        """What measures are made of."""
        lanes = measured_lanes(self.counter.lanes, self.counter.stations)
        return Traffic(self.passages, self.crossings, self.observed, lanes, scheme)


def record(counter: TrafficCounter, blocks: Iterable[Frames], max_gap_s: float) -> Recorded:
    """Count all vehicles of a recording.

    Args:
        counter: Counts on the lanes; it has seen no frame yet.
        blocks: Frames of `TRACK_DTYPE` in time order.
        max_gap_s: See `interval_clock.ObservedTime`.

    Raises:
        NoTrafficError: There is no frame.
    """
    recorded = Recorded(counter, ObservedTime(max_gap_s), EventWatch(counter.lanes))
    for frames in blocks:
        recorded.add(frames)
    recorded.finish()
    if not recorded.frames:
        raise NoTrafficError("tracks", "no frame", "frames with vehicles")
    return recorded


def all_measures(
    recorded: Recorded, scheme: ClassScheme, clock: IntervalClock
) -> Iterator[NDArray[np.void]]:
    """Tables of `measures.MEASURE_DTYPE`, in time order, at most `AT_ONCE` intervals in each.

    So many intervals of which nothing was watched are left out: the clock was set, or there are two
    recordings.
    """
    traffic = recorded.traffic(scheme)
    edges = clock.edges(recorded.first_ns, recorded.last_ns)
    for k in range(0, len(edges) - 1, AT_ONCE):
        part = edges[k : k + AT_ONCE + 1]
        if k == 0 or traffic.observed.seconds(part).any():
            yield measure(traffic, part)


def whole_measures(recorded: Recorded, scheme: ClassScheme) -> NDArray[np.void]:
    """(M,) `measures.MEASURE_DTYPE` of the whole recording, for all classes together."""
    edges = np.array([recorded.first_ns, recorded.last_ns + 1], np.int64)
    rows = measure(recorded.traffic(scheme), edges)
    return np.asarray(rows[rows["category"] == -1])


def all_movements(
    recorded: Recorded, scheme: ClassScheme, clock: IntervalClock
) -> NDArray[np.void]:
    """See `movements.count_movements`."""
    edges = clock.edges(recorded.first_ns, recorded.last_ns)
    gates = find_gates(recorded.counter.lanes)
    return count_movements(recorded.passages, gates, scheme, edges)
