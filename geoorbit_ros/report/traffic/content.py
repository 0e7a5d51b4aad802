"""What the traffic pages show: all tables and tracks that the pictures are drawn from."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from geoorbit_ros.core.lanes import Lane
from geoorbit_ros.core.tables import Frames
from geoorbit_ros.report.lane_drawing import COLOURS
from geoorbit_ros.traffic.class_schemes import ClassScheme
from geoorbit_ros.traffic.count import Recorded
from geoorbit_ros.traffic.interval_clock import NS, IntervalClock
from geoorbit_ros.traffic.lane_tracks import SMOOTH_S, lane_tracks
from geoorbit_ros.traffic.measures import ALL, Traffic, measure
from geoorbit_ros.traffic.movements import count_movements, find_gates
from geoorbit_ros.traffic.records import NO_LANE
from geoorbit_ros.traffic.stations import Station

FEW_STEPS, ENOUGH_STEPS, MANY_STEPS = 4, 8, 300
"""Pictures over time have steps as long as the intervals of the tables. Of fewer than `FEW_STEPS`
the recording is cut into at least `ENOUGH_STEPS`, of more than `MANY_STEPS` into at most that many.
Chosen: a line needs some points to show a course; more than one in three pixels can't be seen."""
STEPS_S = (10, 20, 30, 60, 120, 300, 600, 900, 1800, 3600, 7200, 10_800, 21_600, 43_200, 86_400)
"""Lengths of steps that divide a day, in seconds. Chosen: in less than ten seconds a lane has one
vehicle or none."""
LEAST_WATCHED = 0.25
"""Of a step that was watched for a smaller share nothing is drawn. Chosen: flows from a few seconds
jump with every vehicle; more leaves out steps in which an outage begins."""
MOST_TRACKS = 400
"""Vehicles in the time-space diagrams, about. Chosen: more make lines touch and the page large."""
WINDOWS_S = (60, 120, 300, 600, 1200, 1800, 3600, 7200, 14_400, 28_800)
"""Lengths of the part of a long recording that is shown vehicle by vehicle, in seconds."""


@dataclass(frozen=True, slots=True)
class TrafficContent:
    """Everything the pages show.

    Attributes:
        camera_id: Name of the camera.
        lanes: The lanes, in the map frame.
        stations: The counting stations.
        traffic: What the measures are made of.
        clock: The intervals of the tables.
        span_ns: Stamps of the first and the last frame.
        vehicles: How many vehicles were seen.
        in_no_lane: How many of them drove along no lane.
        whole: `measures.MEASURE_DTYPE` of the whole recording.
        step_clock: The steps of pictures over time.
        edges_ns: (K + 1,) stamps between which the steps lie.
        steps: `measures.MEASURE_DTYPE` of the steps, for all classes together; flows and speeds
            of those that were hardly watched are NaN.
        movements: `movements.MOVEMENT_DTYPE` of the whole recording, for all classes together.
        window_ns: First and last stamp of the part that is shown vehicle by vehicle.
        tracks: `lane_tracks.LANE_TRACK_DTYPE` of that part.
        events: `event_records.EVENT_DTYPE`, the newest row of each event.
    """

    camera_id: str
    lanes: tuple[Lane, ...]
    stations: tuple[Station, ...]
    traffic: Traffic
    clock: IntervalClock
    span_ns: tuple[int, int]
    vehicles: int
    in_no_lane: int
    whole: NDArray[np.void]
    step_clock: IntervalClock
    edges_ns: NDArray[np.int64]
    steps: NDArray[np.void]
    movements: NDArray[np.void]
    window_ns: tuple[int, int]
    tracks: NDArray[np.void]
    events: NDArray[np.void]

    @property
    def duration_s(self) -> float:
        """From the first to the last frame."""
        return (self.span_ns[1] - self.span_ns[0]) / NS

    @property
    def not_crossed(self) -> int:
        """How many vehicles drove along a lane and crossed no station."""
        seen, crossed = self.traffic.passages["vehicle_id"], self.traffic.crossings["vehicle_id"]
        return len(np.setdiff1d(seen, crossed))

    @property
    def watched_s(self) -> float:
        """How long the camera watched."""
        return sum(b - a for a, b in self.traffic.observed.spans_ns) / NS

    @property
    def is_part(self) -> bool:
        """Whether vehicles are shown one by one for a part of the recording only."""
        return self.window_ns != self.span_ns

    def lane_ids(self, station: Station) -> list[int]:
        """Ids of a station's lanes, in the order of the tables."""
        lanes = self.traffic.lanes
        return [int(k) for k in lanes.lane_id[lanes.station == station.station_id]]

    def lane(self, lane_id: int) -> Lane:
        """A lane by its id."""
        return next(lane for lane in self.lanes if lane.lane_id == lane_id)

    def lane_css(self) -> dict[int, str]:
        """CSS class of each lane's colour by its id: lanes of one station differ."""
        return {
            lane_id: f"l{k % COLOURS}"
            for station in self.stations
            for k, lane_id in enumerate(self.lane_ids(station))
        }

    def whole_row(self, station: Station, lane_id: int = NO_LANE) -> np.void:
        """The measures of one lane, or of all lanes of a station, over the whole recording."""
        row: np.void = self.rows_of(self.whole, station, lane_id)[0]
        return row

    def rows_of(self, table: NDArray[np.void], station: Station, lane_id: int) -> NDArray[np.void]:
        """Rows of one lane, for all classes together, in time order."""
        wanted = (table["station_id"] == station.station_id) & (table["lane_id"] == lane_id)
        return np.asarray(table[wanted & (table["category"] == -1)])


def traffic_content(
    camera_id: str,
    recorded: Recorded,
    scheme: ClassScheme,
    clock: IntervalClock,
    frames_between: Callable[[int, int], Frames],
) -> TrafficContent:
    """Compute all that the pages show.

    Args:
        camera_id: Name of the camera.
        recorded: All vehicles.
        scheme: Vehicle classes.
        clock: The intervals of the tables.
        frames_between: Frames of `TRACK_DTYPE` from one stamp to another, both included.
    """
    traffic = recorded.traffic(scheme)
    first_ns, last_ns = recorded.first_ns, recorded.last_ns
    whole_ns = np.array([first_ns, last_ns + 1], np.int64)
    step_clock = steps_of(clock, first_ns, last_ns)
    edges_ns = step_clock.edges(first_ns, last_ns)
    steps = measure(traffic, edges_ns)
    steps = steps[steps["category"] == -1]
    for name in ("flow_veh_per_h", "time_mean_speed_kmh", "space_mean_speed_kmh"):
        steps[name][steps["observed"] < LEAST_WATCHED] = np.nan
    movements = count_movements(
        traffic.passages, find_gates(recorded.counter.lanes), scheme, whole_ns
    )
    window_ns = busiest_window(traffic.crossings["stamp_ns"], first_ns, last_ns)
    margin_ns = round(SMOOTH_S * NS)
    frames = frames_between(window_ns[0] - margin_ns, window_ns[1] + margin_ns)
    return TrafficContent(
        camera_id,
        tuple(recorded.counter.lanes),
        recorded.counter.stations,
        traffic,
        clock,
        (first_ns, last_ns),
        recorded.vehicles,
        recorded.in_no_lane,
        measure(traffic, whole_ns),
        step_clock,
        edges_ns,
        steps,
        np.asarray(movements[movements["category"] == -1]),
        window_ns,
        lane_tracks(recorded.counter.lanes, frames),
        recorded.events,
    )


def steps_of(clock: IntervalClock, first_ns: int, last_ns: int) -> IntervalClock:
    """The steps of pictures over time: the intervals, or longer or shorter ones."""
    length_s = (last_ns - first_ns) / NS
    count = length_s / clock.length_s
    if count > MANY_STEPS:
        longer = [s for s in STEPS_S if s >= clock.length_s and length_s / s <= MANY_STEPS]
        return IntervalClock(longer[0] if longer else STEPS_S[-1], clock.zone)
    if count < FEW_STEPS:
        shorter = [s for s in STEPS_S if s < clock.length_s and length_s / s >= ENOUGH_STEPS]
        step_s = shorter[-1] if shorter else min(STEPS_S[0], clock.length_s)
        return IntervalClock(step_s, clock.zone)
    return clock


def busiest_window(crossing_ns: NDArray[np.int64], first_ns: int, last_ns: int) -> tuple[int, int]:
    """The longest part of a recording in which few enough vehicles cross stations to be drawn.

    Of all parts of that length, it is the one with most vehicles.

    Args:
        crossing_ns: Stamps at which vehicles crossed stations.
        first_ns: Stamp of the first frame.
        last_ns: Stamp of the last frame.
    """
    stamps = np.sort(crossing_ns)
    if len(stamps) <= MOST_TRACKS:
        return first_ns, last_ns
    chosen = (first_ns, last_ns)
    for length_s in WINDOWS_S:
        length_ns = length_s * NS
        starts = np.minimum(stamps // NS * NS, last_ns - length_ns)
        starts = np.maximum(starts, first_ns)
        ends = np.searchsorted(stamps, starts + length_ns, side="right")
        count = ends - np.searchsorted(stamps, starts)
        best = int(count.argmax())
        if length_s > WINDOWS_S[0] and count[best] > MOST_TRACKS:
            break
        chosen = int(starts[best]), min(int(starts[best]) + length_ns, last_ns)
    return chosen


def category_rows(content: TrafficContent, station: Station, lane_id: int) -> dict[str, int]:
    """Vehicles of each class, by its name, that crossed a station in a lane."""
    table = content.whole
    rows = table[(table["station_id"] == station.station_id) & (table["lane_id"] == lane_id)]
    names = (*content.traffic.scheme.categories, ALL)
    return {names[int(row["category"])]: int(row["volume"]) for row in rows}
