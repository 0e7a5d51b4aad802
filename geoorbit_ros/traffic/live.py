"""Traffic as it comes: frames and lane maps go in, intervals come out once nothing can change them.

Every number depends on stamps alone, never on a clock or on how frames are handed over: the rows of
an interval are, bit for bit, those that `count.record` gives on the same lanes.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from itertools import pairwise

import numpy as np
from numpy.typing import NDArray

from geoorbit_ros.core.tables import Frames
from geoorbit_ros.traffic.class_schemes import ClassScheme
from geoorbit_ros.traffic.count import AT_ONCE
from geoorbit_ros.traffic.counter import Counted, TrafficCounter
from geoorbit_ros.traffic.event_records import EVENT_DTYPE, EventLog
from geoorbit_ros.traffic.events import EventWatch
from geoorbit_ros.traffic.interval_clock import GAP_S, NS, IntervalClock, ObservedTime
from geoorbit_ros.traffic.lane_maps import (
    MAP_DELAY_NS,
    Chosen,
    LanesAt,
    MapChoice,
    MapInUse,
    StampedLanes,
)
from geoorbit_ros.traffic.measures import LONGEST_HEADWAY_S, Traffic, measure
from geoorbit_ros.traffic.movements import count_movements, find_gates
from geoorbit_ros.traffic.records import CROSSING_DTYPE, PASSAGE_DTYPE, PIECE_DTYPE, last_seen
from geoorbit_ros.traffic.stations import REACH_S, measured_lanes

LOOK_NS = 5_000_000_000
"""Vehicles that are gone are looked for this often. Chosen: it takes milliseconds and changes no
result; longer tells vehicles later."""
HOLD_NS = 600_000_000_000
"""Frames of this long wait for the first lane map. Chosen: lanes are found within minutes; longer
takes memory."""
LEAD_NS = 3_600_000_000_000
"""A counter that is started again reads this much before the interval that it goes on with: half an
hour for headways (`LONGEST_HEADWAY_S`), and half an hour in which a path ends that began before
(`track_links.LONGEST_NS`)."""


@dataclass(frozen=True, slots=True)
class Resume:
    """Where a counter was stopped.

    Attributes:
        from_ns: End of the last interval that it finished. Intervals and vehicles before it are not
            told again; give frames from `LEAD_NS` before it on.
        vehicles: Number of its last vehicle.
        passages: `records.PASSAGE_DTYPE` of its last vehicles, times exact to milliseconds.
    """

    from_ns: int
    vehicles: int = 0
    passages: NDArray[np.void] = field(default_factory=lambda: np.empty(0, PASSAGE_DTYPE))


@dataclass(frozen=True, slots=True)
class Watched:
    """How far a counter that was stopped had told events.

    Attributes:
        stamp_ns: The last frame that was looked at.
        watch: What looked; None: it is lost, and a new one goes on with the numbers of `log`.
        log: What it had told.
    """

    stamp_ns: int
    watch: EventWatch | None
    log: EventLog


@dataclass(frozen=True, slots=True)
class Finished:
    """Intervals that nothing can change any more, one after the other, on one lane map.

    Attributes:
        edges_ns: (K + 1,) stamps between which they lie.
        measures: (M,) `measures.MEASURE_DTYPE`.
        passages: (P,) `records.PASSAGE_DTYPE` of the vehicles that were last seen in them.
        movements: (M,) `movements.MOVEMENT_DTYPE` of these.
        lanes: The map that they were counted on.
    """

    edges_ns: NDArray[np.int64]
    measures: NDArray[np.void]
    passages: NDArray[np.void]
    movements: NDArray[np.void]
    lanes: MapInUse


class LiveTraffic:
    """Counts frames as they come and finishes intervals.

    An interval is finished once all vehicles are gone that were in view in it. Paths are cut after
    a quarter of an hour at the latest and have ended half an hour after they began
    (`track_links.LONGEST_NS`), so this is seconds after its end on a flowing road, and at most half
    an hour after it beside a parked vehicle.

    The lane map of an interval is the newest one made before it began, where that differs from the
    one in use (`SAME_M`). A vehicle is counted once, on the map of when it was last seen.

    Args:
        scheme: Classes.
        clock: Intervals.
        lanes_at: Gives lane maps.
        resume: Where a counter that was stopped goes on.
        max_gap_s: See `ObservedTime`.
        watched: Where its events go on.

    Attributes:
        watch: What looks for events; None before the first map.
        newest_ns: Stamp of the newest frame; None before the first.
        vehicles: How many were counted.
    """

    def __init__(
        self,
        scheme: ClassScheme,
        clock: IntervalClock,
        lanes_at: LanesAt,
        resume: Resume | None = None,
        max_gap_s: float = GAP_S,
        watched: Watched | None = None,
    ) -> None:
        self.scheme, self.clock = scheme, clock
        self._choice, self._resume = MapChoice(clock, lanes_at), resume
        self._observed = ObservedTime(max_gap_s)
        self._counter: TrafficCounter | None = None
        self._maps: list[MapInUse] = []
        self._passages = np.empty(0, PASSAGE_DTYPE)
        self._crossings = np.empty(0, CROSSING_DTYPE)
        self._pieces = np.empty(0, PIECE_DTYPE)
        self._gone, self._held = list[Counted](), list[Frames]()
        self._begin_ns = self._looked_ns = 0
        self._watched = watched or Watched(np.iinfo(np.int64).min, None, EventLog())
        self.watch = self._watched.watch
        self.newest_ns: int | None = None
        self.vehicles = 0

    @property
    def map_in_use(self) -> MapInUse | None:
        """The newest one."""
        return self._maps[-1] if self._maps else None

    @property
    def waits_since_ns(self) -> int:
        """Begin of the first interval that is not finished."""
        return self._begin_ns

    def add(self, frames: Frames) -> None:
        """Take frames of `TRACK_DTYPE`, later than those before; they wait for the first map."""
        if not len(frames):
            return
        if self._counter is None:
            self._held.append(frames)
            held_ns = int(frames.stamp_ns[-1]) - HOLD_NS
            self._held = [part for part in self._held if part.stamp_ns[-1] >= held_ns]
            self.start()
            return
        for part, chosen in self._choice.parts(frames):
            if len(part):
                self._feed(part)
            if chosen is not None:
                self._change_map(chosen)

    def start(self) -> None:
        """Count the frames that wait, if there is a map by now."""
        if self._held and self._start(int(self._held[0].stamp_ns[0])):
            held, self._held = self._held, []
            for part in held:
                self.add(part)

    def gone(self) -> Counted:
        """Passages and crossings of vehicles that were counted since the last call."""
        parts, self._gone = self._gone, []
        return Counted(
            np.concatenate([np.empty(0, PASSAGE_DTYPE), *(part.passages for part in parts)]),
            np.concatenate([np.empty(0, CROSSING_DTYPE), *(part.crossings for part in parts)]),
            np.concatenate([np.empty(0, PIECE_DTYPE), *(part.pieces for part in parts)]),
            sum(part.vehicles for part in parts),
            sum(part.in_no_lane for part in parts),
        )

    def events(self) -> NDArray[np.void]:
        """(E,) `event_records.EVENT_DTYPE`: what began, changed or ended since the last call."""
        return np.empty(0, EVENT_DTYPE) if self.watch is None else self.watch.take()

    def finished(self) -> list[Finished]:
        """Intervals that were finished since the last call."""
        if self._counter is None or self.newest_ns is None:
            return []
        if self.newest_ns - self._looked_ns < LOOK_NS:
            return []
        self._look()
        open_ns = self._counter.open_since_ns
        until_ns = self.newest_ns if open_ns is None else min(self.newest_ns, open_ns)
        until_ns -= round(REACH_S * NS)  # vehicles cross a line up to so long before they are seen
        edges, chosen_ns = [self._begin_ns], self.newest_ns - MAP_DELAY_NS
        while edges[-1] < chosen_ns and (end_ns := self.clock.end_of(edges[-1])) <= until_ns:
            edges.append(end_ns)
        found = self._measured(np.array(edges, np.int64))
        self._begin_ns = edges[-1]
        self._forget()
        return found

    def _start(self, first_ns: int) -> bool:
        begin_ns = self.clock.start_of(first_ns)
        if self._resume is not None:
            begin_ns = min(begin_ns, self._resume.from_ns)
        found = self._choice.start(begin_ns)
        if found is None:
            return False
        self._counter = TrafficCounter(found.lanes, found.plane)
        if self._resume is not None:
            self._counter.vehicles = self._resume.vehicles
        self._use(found, begin_ns)
        self._begin_ns, self._looked_ns = begin_ns, first_ns
        return True

    def _use(self, found: StampedLanes, from_ns: int) -> None:
        assert self._counter is not None
        order = measured_lanes(self._counter.lanes, self._counter.stations)
        self._maps.append(MapInUse(from_ns, found.stamp_ns, tuple(found.lanes), order))

    def _feed(self, frames: Frames) -> None:
        assert self._counter is not None
        self.newest_ns = int(frames.stamp_ns[-1])
        self._observed.add(frames.stamp_ns)
        self._counter.add(frames)
        k = int(np.searchsorted(frames.stamp_ns, self._watched.stamp_ns, side="right"))
        if k < len(frames):
            if self.watch is None:
                self.watch = EventWatch(self._maps[-1].lanes, self._watched.log)
            self.watch.add(frames.part(k, len(frames)))

    def _change_map(self, chosen: Chosen) -> None:
        """Count on another map from now on."""
        assert self._counter is not None
        self._look()  # who is gone was counted on the map before
        lanes = chosen.found.lanes
        self._counter.use_lanes(lanes)
        if self.watch is not None and chosen.next_ns > self._watched.stamp_ns:
            self.watch.use_lanes(lanes)
        self._use(chosen.found, chosen.from_ns)

    def _look(self) -> None:
        """Take vehicles that are gone."""
        assert self._counter is not None
        self._looked_ns = self.newest_ns or 0
        counted = self._counter.take()
        if counted.vehicles:
            self._passages = np.concatenate((self._passages, counted.passages))
            self._crossings = np.concatenate((self._crossings, counted.crossings))
            self._pieces = np.concatenate((self._pieces, counted.pieces))
            if self._resume is not None:
                self._number_as(self._resume.passages, counted.passages)
                counted = _since(counted, self._resume.from_ns)
            self._gone.append(counted)
        self.vehicles = self._counter.vehicles

    def _number_as(self, stored: NDArray[np.void], passages: NDArray[np.void]) -> None:
        """Give vehicles the numbers that they had before the counter was stopped."""
        assert self._counter is not None
        number = {_name(row): int(row["vehicle_id"]) for row in stored}
        found = [
            number[_name(row)] - int(row["vehicle_id"]) for row in passages if _name(row) in number
        ]
        if found and found[-1]:
            self._counter.vehicles += found[-1]
            for table in (self._passages, self._crossings, self._pieces):
                table["vehicle_id"] += found[-1]

    def _measured(self, edges: NDArray[np.int64]) -> list[Finished]:
        """The intervals between edges, those of one map together."""
        if self._resume is not None:
            edges = edges[max(int(np.searchsorted(edges, self._resume.from_ns)), 0) :]
        if len(edges) < 2:
            return []
        starts = np.array([used.from_ns for used in self._maps[1:]], np.int64)
        of_map = np.searchsorted(starts, edges[:-1], side="right")
        cuts = [0, *(np.flatnonzero(np.diff(of_map)) + 1).tolist(), len(edges) - 1]
        pieces = [
            (a, min(a + AT_ONCE, end))
            for begin, end in pairwise(cuts)
            for a in range(begin, end, AT_ONCE)
        ]
        last_ns = last_seen(self._passages)
        found = list[Finished]()
        for a, b in pieces:
            used, part = self._maps[int(of_map[a])], edges[a : b + 1]
            tables = self._passages, self._crossings, self._pieces
            traffic = Traffic(*tables, self._observed, used.order, self.scheme)
            here = (last_ns >= part[0]) & (last_ns < part[-1])
            gone = self._passages[here]
            moved = count_movements(gone, find_gates(used.lanes), self.scheme, part)
            found.append(Finished(part, measure(traffic, part), gone, moved, used))
        return found

    def _forget(self) -> None:
        """Forget what no later interval needs."""
        begin_ns = self._begin_ns
        self._passages = self._passages[last_seen(self._passages) >= begin_ns]
        self._pieces = self._pieces[self._pieces["last_ns"] >= begin_ns]
        crossings = self._crossings
        kept = crossings["stamp_ns"] >= begin_ns - round(LONGEST_HEADWAY_S * NS)
        kept |= np.isin(crossings["vehicle_id"], self._passages["vehicle_id"])
        self._crossings = crossings[kept]
        needed_ns = min(begin_ns, int(self._crossings["stamp_ns"].min(initial=begin_ns)))
        spans = self._observed.spans_ns
        self._observed.spans_ns = [span for span in spans if span[1] >= needed_ns] or spans[-1:]
        while len(self._maps) > 1 and self._maps[1].from_ns <= begin_ns:
            del self._maps[0]


def _name(passage: np.void) -> tuple[int, int, int]:
    """Track, lane and millisecond: no other passage has them."""
    return int(passage["track_id"]), int(passage["lane_id"]), round(int(passage["first_ns"]) / 1e6)


def _since(counted: Counted, resume_ns: int) -> Counted:
    """The vehicles that were last seen at `resume_ns` or later."""
    kept = last_seen(counted.passages) >= resume_ns
    passages = counted.passages[kept]
    gone = np.unique(counted.passages["vehicle_id"][~kept])
    crossings = counted.crossings[~np.isin(counted.crossings["vehicle_id"], gone)]
    pieces = counted.pieces[~np.isin(counted.pieces["vehicle_id"], gone)]
    return Counted(passages, crossings, pieces, counted.vehicles - len(gone), counted.in_no_lane)
