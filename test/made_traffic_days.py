"""Days of made-up traffic on two lanes, with frames of an empty road, and what counting gives."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from datetime import UTC, datetime

import numpy as np
from made_lane_traffic import Stream, straight, traffic
from numpy.typing import NDArray

from geoorbit_ros.core.lanes import Lane, lane_of_map
from geoorbit_ros.core.polylines import offset_line
from geoorbit_ros.core.tables import Frames
from geoorbit_ros.traffic.class_schemes import SCHEMES
from geoorbit_ros.traffic.count import Recorded, all_measures, record
from geoorbit_ros.traffic.counter import TrafficCounter
from geoorbit_ros.traffic.interval_clock import GAP_S, IntervalClock

NS = 1_000_000_000
SCHEME = SCHEMES["coco"]
CLOCK = IntervalClock(60, "Europe/Berlin")
SUMMER_ENDS_NS = int(datetime(2026, 10, 25, 1, tzinfo=UTC).timestamp()) * NS


def lane(lane_id: int, offset_m: float) -> Lane:
    """A straight one to the left of the x axis."""
    line = straight(offset_m=offset_m)(np.arange(0.0, 121.0, 2.0))
    return lane_of_map(lane_id, line, offset_line(line, 1.75), offset_line(line, -1.75))


LANES = [lane(3, 0.0), lane(5, 3.5)]
MOVED = [lane(3, 0.5), lane(5, 4.0), lane(7, 7.0)]


def day(begin_ns: int, minutes: int, seed: int = 0, vehicles: int = 8) -> Frames:
    """Minutes of traffic, with frames of an empty road between."""
    streams = [Stream(straight(offset_m=3.5 * k), vehicles) for k in range(2)]
    parts = [traffic(streams, seed + k) for k in range(minutes)]
    stamps = [p.stamp_ns + begin_ns + 60 * NS * k for k, p in enumerate(parts)]
    rows = [p.rows.copy() for p in parts]
    for k, table in enumerate(rows):
        table["track_id"] += 1000 * k
        table["length"], table["score"] = 4.5, 0.9
    count = np.concatenate([np.diff(p.offset) for p in parts])
    when = np.concatenate(stamps)
    grid = np.arange(begin_ns, begin_ns + minutes * 60 * NS, NS // 2)
    empty = np.setdiff1d(grid, when)
    order = np.argsort(np.append(when, empty), kind="stable")
    counts = np.append(count, np.zeros(len(empty), np.int64))[order]
    offset = np.append(0, np.cumsum(counts)).astype(np.int64)
    return Frames(np.append(when, empty)[order], offset, np.concatenate(rows))


def without(frames: Frames, begin_ns: int, end_ns: int) -> Frames:
    """An outage."""
    kept = (frames.stamp_ns < begin_ns) | (frames.stamp_ns >= end_ns)
    counts = np.diff(frames.offset)
    return Frames(
        frames.stamp_ns[kept],
        np.append(0, np.cumsum(counts[kept])).astype(np.int64),
        frames.rows[np.repeat(kept, counts)],
    )


def blocks(frames: Frames, seed: int, most: int = 400) -> Iterator[Frames]:
    """Frames as they might be handed over."""
    random, k = np.random.default_rng(seed), 0
    while k < len(frames):
        step = int(random.integers(1, most))
        yield frames.part(k, min(k + step, len(frames)))
        k += step


def offline(
    frames: Frames, clock: IntervalClock = CLOCK, lanes: Sequence[Lane] = LANES
) -> tuple[Recorded, NDArray[np.void]]:
    """What the offline way gives."""
    recorded = record(TrafficCounter(lanes), [frames], GAP_S)
    return recorded, np.concatenate(list(all_measures(recorded, SCHEME, clock)))


STOPPED_LANE = lane(7, 7.0)


def with_events(frames: Frames, period_s: int = 300) -> Frames:
    """The same with a vehicle that stands for 140 s and one in the wrong direction in each period.

    The first stands in `STOPPED_LANE`, where nobody else drives, the second drives in lane 5.
    """
    time_s = (frames.stamp_ns - frames.stamp_ns[0]) / NS
    tables, owners = [frames.rows], [np.repeat(np.arange(len(frames)), np.diff(frames.offset))]
    for k in range(int(time_s[-1]) // period_s):
        since = time_s - (period_s * k + 70.0)
        stands = np.minimum(15.0 * since, 60.0) + np.maximum(15.0 * (since - 140.0), 0.0)
        for first_id, x, y in ((900_000, stands, 7.0), (950_000, 118.0 - 20.0 * since, 3.5)):
            there = np.flatnonzero((since >= 0.0) & (x >= 0.0) & (x <= 120.0))
            rows = np.zeros(len(there), frames.rows.dtype)
            rows["x"], rows["y"], rows["track_id"] = x[there], y, first_id + k
            rows["sigma"], rows["class_id"], rows["length"], rows["score"] = 0.05, 2, 4.5, 0.9
            tables.append(rows)
            owners.append(there)
    owner = np.concatenate(owners)
    order = np.argsort(owner, kind="stable")
    counts = np.bincount(owner, minlength=len(frames))
    offset = np.append(0, np.cumsum(counts)).astype(np.int64)
    return Frames(frames.stamp_ns, offset, np.concatenate(tables)[order])
