"""A made-up road of several lanes over hours, counted, as the traffic pages get it."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from geoorbit_ros.core.lanes import Lane, lane_of_map
from geoorbit_ros.core.polylines import offset_line
from geoorbit_ros.core.tables import TRACK_DTYPE, Frames, frames_from_rows
from geoorbit_ros.report.traffic.content import TrafficContent, traffic_content
from geoorbit_ros.traffic.class_schemes import SCHEMES
from geoorbit_ros.traffic.count import Recorded, record
from geoorbit_ros.traffic.counter import TrafficCounter
from geoorbit_ros.traffic.interval_clock import NS, IntervalClock

LENGTH_M, WIDTH_M, STEP_S = 120.0, 3.5, 0.2
BEGIN_NS = 1_777_600_800 * NS
"""1 May 2026, 04:00 in Berlin."""
LANE_IDS = (7, 3, 11, 4)
"""Two lanes towards the east, then two towards the west."""


def road() -> list[Lane]:
    """Two lanes each way."""
    x = np.arange(0.0, LENGTH_M + 1.0, 2.0)
    lanes = []
    for k, lane_id in enumerate(LANE_IDS):
        line = np.column_stack((x if k < 2 else x[::-1], np.full(len(x), WIDTH_M * k)))
        lanes.append(lane_of_map(lane_id, line, offset_line(line, 1.75), offset_line(line, -1.75)))
    return lanes


def traffic_of(
    starts_s: Sequence[NDArray[np.float64]], speeds_mps: Sequence[float], begin_ns: int = BEGIN_NS
) -> Frames:
    """Vehicles that begin at these times in these lanes, all of a lane at one speed."""
    stamps, tables, track = [], [], 0
    for k, (starts, speed) in enumerate(zip(starts_s, speeds_mps, strict=True)):
        for start in np.round(starts / STEP_S) * STEP_S:
            track += 1
            time_s = np.arange(0.0, LENGTH_M / speed, STEP_S)
            rows = np.zeros(len(time_s), TRACK_DTYPE)
            rows["x"] = speed * time_s if k < 2 else LENGTH_M - speed * time_s
            rows["y"], rows["sigma"], rows["length"] = WIDTH_M * k, 0.1, 4.5
            rows["track_id"], rows["class_id"], rows["score"] = (
                track,
                7 if track % 5 == 0 else 2,
                0.9,
            )
            rows["heading"] = np.nan
            tables.append(rows)
            stamps.append(begin_ns + np.round((start + time_s) * 1e9).astype(np.int64))
    return frames_from_rows(np.concatenate(stamps), np.concatenate(tables))


def recorded_of(frames: Frames, max_gap_s: float = 120.0) -> Recorded:
    """The vehicles of frames, counted on the road."""
    return record(TrafficCounter(road()), [frames], max_gap_s)


def content_of(
    frames: Frames, interval_s: int = 900, zone: str = "Europe/Berlin", max_gap_s: float = 120.0
) -> TrafficContent:
    """All that the pages show of frames."""

    def between(first_ns: int, last_ns: int) -> Frames:
        stamps = frames.row_stamp_ns()
        wanted = (stamps >= first_ns) & (stamps <= last_ns)
        return frames_from_rows(stamps[wanted], frames.rows[wanted])

    clock = IntervalClock(interval_s, zone)
    recorded = recorded_of(frames, max_gap_s)
    return traffic_content("pole 7", recorded, SCHEMES["coco"], clock, between)


def evenly(every_s: float, until_s: float, seed: int = 0) -> NDArray[np.float64]:
    """Times about `every_s` apart."""
    random = np.random.default_rng(seed)
    times = np.arange(1.0, until_s - 10.0, every_s)
    return np.asarray(times + random.uniform(0.0, 0.3 * every_s, len(times)))
