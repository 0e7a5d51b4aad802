"""Traffic of a trajectory database: counts what the recorder stores, stores traffic beside it.

Tracks and lane maps come from the database alone. What was stored while nobody counted is counted
later, and a counter that was stopped goes on where it was: the same intervals, each once.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from itertools import islice

import numpy as np
from numpy.typing import NDArray

from geoorbit_ros.core.errors import GeoOrbitError
from geoorbit_ros.storage.database.traffic import TrafficDatabase, TrafficMap, TrafficPart
from geoorbit_ros.storage.database.traffic_events import StoredWatch
from geoorbit_ros.storage.database.traffic_series import SeriesName
from geoorbit_ros.traffic.class_schemes import ClassScheme, scheme_text
from geoorbit_ros.traffic.counter import Counted, nobody
from geoorbit_ros.traffic.event_records import EVENT_DTYPE, EventLog
from geoorbit_ros.traffic.interval_clock import IntervalClock
from geoorbit_ros.traffic.lane_maps import StampedLanes
from geoorbit_ros.traffic.live import LEAD_NS, Finished, LiveTraffic, Resume, Watched
from geoorbit_ros.traffic.packed import (
    PACKED_MOVEMENT_DTYPE,
    pack_measures,
    pack_passages,
    unpack_passages,
)
from geoorbit_ros.traffic.watch_state import pack_watch, unpack_watch

STEP_BATCHES = 256
"""Stored batches counted in one step. Chosen: three minutes of tracks, a tenth of a second of work;
more keeps a node from its other work, less catches up slower."""
KEEP_NS = 300_000_000_000
"""Time between two stored states of who watches for events. Chosen: after a stop five minutes are
watched again, within a second; shorter writes ten kilobytes more often."""
ParseLanes = Callable[[str], StampedLanes]
"""From a lane map's text to its lanes."""


@dataclass(frozen=True, slots=True)
class Told:
    """What a step found.

    Attributes:
        batches: How many stored batches it counted; `STEP_BATCHES` where more may wait.
        counted: Vehicles that are gone.
        finished: Intervals that were stored.
        events: (E,) `event_records.EVENT_DTYPE`: what was told of events, and stored.
    """

    batches: int
    counted: Counted
    finished: tuple[Finished, ...]
    events: NDArray[np.void]


class TrafficFollower:
    """Follows the stored tracks of one camera.

    Args:
        database: Where tracks are read and intervals are stored.
        camera_id: Whose.
        scheme: Classes.
        clock: Intervals.
        parse: Reads lane maps.

    Attributes:
        live: The counter; None while there are no tracks or no lanes.
        intervals: How many intervals were stored.
    """

    def __init__(
        self,
        database: TrafficDatabase,
        camera_id: str,
        scheme: ClassScheme,
        clock: IntervalClock,
        parse: ParseLanes,
    ) -> None:
        self._database, self._camera = database, camera_id
        self._scheme, self._clock = scheme, clock
        self.series = SeriesName(camera_id, clock.length_s, clock.zone, scheme_text(scheme))
        self._parse = parse
        self._resume_ns = database.traffic_end(self.series)
        self._next_ns: int | None = None
        self._maps: dict[int, tuple[str, StampedLanes | None]] = {}
        self._looked_ns: int | None = None
        self._kept_ns: int | None = None
        self.live: LiveTraffic | None = None
        self.intervals = 0

    def step(self, batches: int = STEP_BATCHES) -> Told:
        """Count the next stored batches; store what is finished.

        Raises:
            GeoOrbitError: The database can't be used. The next step goes on from what is stored.
        """
        if self.live is None:
            self.live = self._started()
        if self.live is None:
            return Told(0, nobody(), (), np.empty(0, EVENT_DTYPE))
        done, finished = 0, list[Finished]()
        try:
            stored = self._database.batches(self._camera, self._next_ns)
            for frames in islice(stored, batches):
                self.live.add(frames)
                self._next_ns = int(frames.stamp_ns[-1]) + 1
                done += 1
                for part in self.live.finished():
                    self._store(part)
                    finished.append(part)
            events = self._store_events(self.live)
        except GeoOrbitError:
            self.live, self._resume_ns = None, self._database.traffic_end(self.series)
            raise
        return Told(done, self.live.gone(), tuple(finished), events)

    def _started(self) -> LiveTraffic | None:
        """A counter at the right place, once there are tracks and lanes."""
        if not self._database.has_camera(self._camera):
            return None
        resume, from_ns = None, None
        if self._resume_ns is not None:
            resume, from_ns = self._resume(self._resume_ns), self._resume_ns - LEAD_NS
        elif self._first_lanes() is None:
            return None
        self._next_ns = from_ns
        return LiveTraffic(
            self._scheme, self._clock, self._lanes_at, resume, watched=self._watched()
        )

    def _watched(self) -> Watched | None:
        """The stored watch; where it can't be read, what it told is known."""
        stored = self._database.traffic_watch(self.series)
        self._kept_ns = None
        if stored is None:
            return None
        watch, log = unpack_watch(stored.data), EventLog()
        if watch is not None:
            self._kept_ns = stored.stamp_ns
            return Watched(stored.stamp_ns, watch, log)
        told = self._database.traffic_events(self.series)
        known_ns = max(stored.stamp_ns, int(told["stamp_ns"].max()) if len(told) else 0)
        if len(told):
            log.go_on(told, self._database.traffic_event_rows(self.series), known_ns)
        return Watched(known_ns, None, log)

    def _store_events(self, live: LiveTraffic) -> NDArray[np.void]:
        """Store what was told of events since the last call, and now and then who told it."""
        rows, watch, now_ns = live.events(), live.watch, live.newest_ns
        if watch is None or now_ns is None:
            return rows
        state, first_row = None, watch.rows - len(rows)
        if self._kept_ns is None or now_ns - self._kept_ns >= KEEP_NS:
            state = StoredWatch(now_ns, watch.rows, pack_watch(watch))
        if state is None and not len(rows):
            return rows
        rows = self._database.append_events(self.series, first_row, rows, state)
        self._kept_ns = self._kept_ns if state is None else now_ns
        return rows

    def _resume(self, from_ns: int) -> Resume:
        packed = self._database.traffic_vehicles(self._camera, from_ns - LEAD_NS, from_ns)
        passages = unpack_passages(packed)
        return Resume(from_ns, self._database.traffic_newest_vehicle(self._camera), passages)

    def _lanes_at(self, at_ns: int) -> StampedLanes | None:
        if self._resume_ns is not None and at_ns < self._resume_ns:
            used = self._database.traffic_map(self.series, at_ns)
            found = None if used is None else (used.stamp_ns, used.geojson)
        else:
            found = self._database.lane_map_at(self._camera, at_ns)
        lanes = None if found is None else self._lanes(*found)
        if lanes is None and self.live is not None and self.live.map_in_use is None:
            return self._first_lanes()
        return lanes

    def _first_lanes(self) -> StampedLanes | None:
        """The first stored map that counts."""
        for stamp_ns in self._database.lane_map_stamps(self._camera):
            if self._looked_ns is not None and stamp_ns <= self._looked_ns:
                continue
            found = self._database.lane_map_at(self._camera, stamp_ns)
            lanes = None if found is None else self._lanes(*found)
            if lanes is not None:
                return lanes
            self._looked_ns = stamp_ns
        return None

    def _lanes(self, stamp_ns: int, text: str) -> StampedLanes | None:
        """The lanes of a map; None where none is confirmed yet."""
        if stamp_ns not in self._maps:
            found = replace(self._parse(text), stamp_ns=stamp_ns)
            self._maps[stamp_ns] = text, found if found.counts else None
        return self._maps[stamp_ns][1]

    def _store(self, finished: Finished) -> None:
        edges, used = finished.edges_ns, finished.lanes
        start_ns, end_ns = int(edges[0]), int(edges[-1])
        lane_map = TrafficMap(start_ns, used.map_ns, self._maps[used.map_ns][0])
        rows, vehicles = pack_measures(finished.measures), pack_passages(finished.passages)
        moved = finished.movements.astype(PACKED_MOVEMENT_DTYPE)
        part = TrafficPart(start_ns, end_ns, len(edges) - 1, rows, vehicles, moved, lane_map)
        self._database.append_traffic(self.series, part)
        self.intervals += len(edges) - 1
        self._maps = {stamp: m for stamp, m in self._maps.items() if stamp >= used.map_ns}
