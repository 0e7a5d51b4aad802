"""From a recording to its traffic: what `geoorbit traffic` and the report compute."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Sequence
from contextlib import ExitStack
from dataclasses import dataclass, field
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from geoorbit_ros.core.errors import NoTrafficError
from geoorbit_ros.core.helper_process import HelperProcess
from geoorbit_ros.core.lanes import Lane
from geoorbit_ros.core.tables import Frames
from geoorbit_ros.traffic.class_schemes import ClassScheme
from geoorbit_ros.traffic.counter import Counted, TrafficCounter
from geoorbit_ros.traffic.event_records import EVENT_DTYPE, EventState, newest_rows
from geoorbit_ros.traffic.events import EventWatch
from geoorbit_ros.traffic.interval_clock import IntervalClock, ObservedTime
from geoorbit_ros.traffic.lane_maps import MapChoice, MapInUse
from geoorbit_ros.traffic.measures import Traffic, measure
from geoorbit_ros.traffic.movements import count_movements, find_gates
from geoorbit_ros.traffic.records import CROSSING_DTYPE, PASSAGE_DTYPE, PIECE_DTYPE, last_seen
from geoorbit_ros.traffic.stations import MeasuredLanes, measured_lanes

BLOCK_ROWS = 250_000
"""Rows that are looked at together. Chosen: more take more memory."""
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
        watch: Looks for events; None: they are looked for elsewhere, see `add_events`.
        first_ns: Stamp of the first frame.
        last_ns: Stamp of the last frame.
        frames: How many frames there were.
        vehicles: How many vehicles.
        in_no_lane: How many of them drove along no lane.
        choice: Chooses the lane map of each interval; None: one map counts for all.
        maps: Of which intervals on which map counts; empty where one counts for all.
    """

    counter: TrafficCounter
    observed: ObservedTime
    watch: EventWatch | None
    choice: MapChoice | None = None
    maps: list[MapInUse] = field(default_factory=list)
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
        if self.choice is None:
            self._add(frames)
            return
        for part, chosen in self.choice.parts(frames):
            if len(part):
                self._add(part)
            if chosen is not None:
                self._keep(self.counter.take())  # who is gone was counted on the map before
                self.counter.use_lanes(chosen.found.lanes)
                if self.watch is not None:
                    self.watch.use_lanes(chosen.found.lanes)
                self._use(chosen.from_ns, chosen.found.stamp_ns)

    def _add(self, frames: Frames) -> None:
        if not self.frames:
            self.first_ns = int(frames.stamp_ns[0])
        self.last_ns = int(frames.stamp_ns[-1])
        self.frames += len(frames)
        self.observed.add(frames.stamp_ns)
        self.counter.add(frames)
        if self.watch is not None:
            self.watch.add(frames)
            self.add_events(self.watch.take())
        if self.last_ns - self._taken_ns >= TAKE_NS:  # each time sorts all that is in view
            self._taken_ns = self.last_ns
            self._keep(self.counter.take())

    def _use(self, from_ns: int, map_ns: int) -> None:
        order = measured_lanes(self.counter.lanes, self.counter.stations)
        self.maps.append(MapInUse(from_ns, map_ns, self.counter.lanes, order))

    def add_events(self, rows: NDArray[np.void]) -> None:
        """Take (E,) `EVENT_DTYPE`, later than those before."""
        self._events.append(rows)

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
    def pieces(self) -> NDArray[np.void]:
        """(Q,) `PIECE_DTYPE` of all vehicles."""
        return np.concatenate([np.empty(0, PIECE_DTYPE), *(c.pieces for c in self._counted)])

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
        """What measures on the last map are made of; lanes that it has no more are left out."""
        lanes = measured_lanes(self.counter.lanes, self.counter.stations)
        tables = [self.passages, self.crossings, self.pieces]
        if len(self.maps) > 1:
            tables = [rows[np.isin(rows["lane_id"], lanes.lane_id)] for rows in tables]
        passages, crossings, pieces = tables
        return Traffic(passages, crossings, pieces, self.observed, lanes, scheme)

    def parts(
        self, edges: NDArray[np.int64]
    ) -> Iterator[tuple[NDArray[np.int64], MeasuredLanes, Sequence[Lane]]]:
        """Edges of intervals one after the other that are counted on one map, and its lanes."""
        if not self.maps:
            lanes = self.counter.lanes
            yield edges, measured_lanes(lanes, self.counter.stations), lanes
            return
        starts = np.array([used.from_ns for used in self.maps[1:]], np.int64)
        of_map = np.searchsorted(starts, edges[:-1], side="right")
        for k in np.unique(of_map).tolist():
            here = np.flatnonzero(of_map == k)
            used = self.maps[k]
            yield edges[here[0] : here[-1] + 2], used.order, used.lanes


def record(
    counter: TrafficCounter,
    blocks: Iterable[Frames],
    max_gap_s: float,
    choice: MapChoice | None = None,
    first: MapInUse | None = None,
    beside: BlockSource | None = None,
) -> Recorded:
    """Count all vehicles of a recording.

    Args:
        counter: Counts on the lanes; it has seen no frame yet.
        blocks: Frames of `TRACK_DTYPE` in time order.
        max_gap_s: See `interval_clock.ObservedTime`.
        choice: Chooses other lanes for later intervals; it has started.
        first: The map that the counter has, where others may follow.
        beside: The same frames for a second process, which then looks for events.

    Raises:
        NoTrafficError: There is no frame.
    """
    watch = EventWatch(counter.lanes) if beside is None else None
    recorded = Recorded(counter, ObservedTime(max_gap_s), watch, choice)
    if first is not None:
        recorded.maps.append(first)
    with ExitStack() as stack:
        events: Iterable[NDArray[np.void]] = ()
        if beside is not None:
            helper = HelperProcess(watch_events, counter.lanes, beside, choice)
            events = stack.enter_context(helper)
        for frames in blocks:
            recorded.add(frames)
        recorded.finish()
        for rows in events:
            recorded.add_events(rows)
    if not recorded.frames:
        raise NoTrafficError("tracks", "no frame", "frames with vehicles")
    return recorded


class BlockSource(Protocol):
    """Frames of `TRACK_DTYPE` that another process can read."""

    def blocks(self, rows: int) -> Iterator[Frames]:
        """Frames in time order, about so many rows together."""
        ...


def watch_events(
    lanes: Sequence[Lane], source: BlockSource, choice: MapChoice | None
) -> Iterator[NDArray[np.void]]:
    """The rows of all events (E,) `EVENT_DTYPE`; see `record`.

    They come at the end: who waits for them counts until then, and a pipe that is full would stop
    this process.
    """
    watch, found = EventWatch(lanes), [np.empty(0, EVENT_DTYPE)]
    for frames in source.blocks(BLOCK_ROWS):
        for part, chosen in [(frames, None)] if choice is None else choice.parts(frames):
            if len(part):
                watch.add(part)
            if chosen is not None:
                watch.use_lanes(chosen.found.lanes)
        found.append(watch.take())
    yield np.concatenate(found)


def all_measures(
    recorded: Recorded, scheme: ClassScheme, clock: IntervalClock
) -> Iterator[NDArray[np.void]]:
    """Tables of `measures.MEASURE_DTYPE`, in time order, at most `AT_ONCE` intervals in each.

    So many intervals of which nothing was watched are left out: the clock was set, or there are two
    recordings.
    """
    tables, observed = (recorded.passages, recorded.crossings, recorded.pieces), recorded.observed
    edges = clock.edges(recorded.first_ns, recorded.last_ns)
    for of_map, lanes, _ in recorded.parts(edges):
        traffic = Traffic(*tables, observed, lanes, scheme)
        for k in range(0, len(of_map) - 1, AT_ONCE):
            part = of_map[k : k + AT_ONCE + 1]
            if part[0] == edges[0] or observed.seconds(part).any():
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
    passages = recorded.passages
    last_ns = last_seen(passages)
    tables = []
    for part, _, lanes in recorded.parts(edges):
        gone = passages[(last_ns >= part[0]) & (last_ns < part[-1])]
        tables.append(count_movements(gone, find_gates(lanes), scheme, part))
    return np.concatenate(tables)
