"""Traffic in the trajectory database: two weeks of one camera, and a year of a thousand.

Two weeks: vehicles on two lanes each way with nights, rain (tracks break, places are worse),
outages and the end of summer time go through the counter that the node `traffic` runs, which is
stopped and started again; the stored intervals are compared with those of the offline way.

A year: every camera gets a day of these intervals 365 times, stored in the order in which a year
would store them.

    python benchmarks/traffic_database.py [--days 14] [--cameras 1000] [--year-days 365]
"""

from __future__ import annotations

import argparse
import time
from collections.abc import Iterator
from datetime import UTC, datetime
from pathlib import Path
from tempfile import TemporaryDirectory

import numpy as np
from numpy.typing import NDArray

from geoorbit_ros.core.lanes import Lane, lane_of_map
from geoorbit_ros.core.polylines import offset_line
from geoorbit_ros.core.tables import TRACK_DTYPE, Frames
from geoorbit_ros.storage.database.schema import encode_rows
from geoorbit_ros.storage.database.traffic import TrafficDatabase, TrafficReader
from geoorbit_ros.storage.database.traffic_series import SeriesName
from geoorbit_ros.traffic.class_schemes import SCHEMES
from geoorbit_ros.traffic.count import all_measures, record
from geoorbit_ros.traffic.counter import TrafficCounter
from geoorbit_ros.traffic.follower import TrafficFollower
from geoorbit_ros.traffic.interval_clock import GAP_S, NS, IntervalClock
from geoorbit_ros.traffic.lane_maps import StampedLanes
from geoorbit_ros.traffic.packed import pack_measures

BEGIN_NS = int(datetime(2026, 10, 18, tzinfo=UTC).timestamp()) * NS
"""A week before summer time ends in Europe."""
CLOCK = IntervalClock(900, "Europe/Berlin")
SCHEME = SCHEMES["coco"]
FPS, MINUTE_NS, LENGTH_M = 5, 60 * NS, 120.0
PEAK_PER_MINUTE = 30.0
"""Vehicles per minute in all four lanes at the busiest hour: 1800 an hour."""
OUTAGES_H = ((30.0, 33.5), (100.2, 100.4), (190.0, 206.0), (250.5, 250.51))
"""Hours since the beginning in which there is no frame."""
RAIN_H = ((60.0, 75.0), (210.0, 230.0))


def lanes() -> list[Lane]:
    """Two lanes each way, 120 m long."""
    found = []
    for k in range(4):
        s = np.arange(0.0, LENGTH_M + 1.0, 2.0)
        line = np.column_stack((s if k < 2 else s[::-1], np.full(len(s), 3.5 * k)))
        sides = offset_line(line, 1.75), offset_line(line, -1.75)
        found.append(lane_of_map(k + 1, line, *sides))
    return found


def minute(begin_ns: int) -> Frames | None:
    """The frames of a minute; the same for the same minute."""
    hour = (begin_ns - BEGIN_NS) / 3600 / NS
    random = np.random.default_rng(begin_ns // MINUTE_NS)
    of_day = hour % 24
    share = 0.02 + 0.98 * np.sin(np.pi * np.clip((of_day - 4.0) / 18.0, 0.0, 1.0)) ** 2
    rain = any(a <= hour < b for a, b in RAIN_H)
    stamps = begin_ns + np.arange(60 * FPS) * (NS // FPS)
    hours = (stamps - BEGIN_NS) / 3600 / NS
    seen = ~np.logical_or.reduce([(hours >= a) & (hours < b) for a, b in OUTAGES_H])
    if not seen.any():
        return None
    count = int(random.poisson(PEAK_PER_MINUTE * share))
    frame, rows = _vehicles(random, count, rain, begin_ns)
    kept = seen[frame] & ~(rain & (random.random(len(frame)) < 0.3))
    order = np.argsort(frame[kept], kind="stable")
    number = np.bincount(frame[kept], minlength=len(stamps))[seen]
    offset = np.append(0, np.cumsum(number)).astype(np.int64)
    return Frames(stamps[seen], offset, rows[kept][order])


def _vehicles(
    random: np.random.Generator, count: int, rain: bool, begin_ns: int
) -> tuple[NDArray[np.int64], NDArray[np.void]]:
    """Frame of each row, and rows, of vehicles that enter and leave within the minute."""
    lane = random.integers(0, 4, count)
    speed = random.normal(22.0, 2.5, count).clip(12.0, 35.0)
    enter = np.sort(random.uniform(0.0, 60.0 - LENGTH_M / 12.0, count))
    steps = np.floor(LENGTH_M / speed * FPS).astype(np.int64)
    of = np.repeat(np.arange(count), steps)
    step = np.arange(len(of)) - np.repeat(np.cumsum(steps) - steps, steps)
    s = speed[of] * step / FPS
    rows = np.zeros(len(of), TRACK_DTYPE)
    noise = random.normal(0.0, 0.4 if rain else 0.15, (2, len(of)))
    rows["x"] = np.where(lane[of] < 2, s, LENGTH_M - s) + noise[0]
    rows["y"] = 3.5 * lane[of] + random.normal(0.0, 0.3, count)[of] + noise[1]
    rows["sigma"], rows["score"] = (0.4 if rain else 0.15), 0.8
    truck = random.random(count) < 0.12
    rows["class_id"], rows["length"] = np.where(truck, 7, 2)[of], np.where(truck, 11.0, 4.4)[of]
    first_id = (begin_ns - BEGIN_NS) // MINUTE_NS * 100
    rows["track_id"] = first_id + of
    if rain:  # trackers lose vehicles half way
        rows["track_id"] += np.where(step > steps[of] // 2, 50, 0)
    frame = np.floor(enter * FPS).astype(np.int64)[of] + step
    return frame, rows


class MadeUpTracks(TrafficDatabase):
    """A database whose stored tracks are made up as they are read."""

    until_ns = 0

    def batches(
        self, camera_id: str, start_ns: int | None = None, end_ns: int | None = None
    ) -> Iterator[Frames]:
        """Minutes from `start_ns` to `until_ns`."""
        at_ns = max(BEGIN_NS, start_ns or 0)
        while at_ns < self.until_ns:
            frames = minute(at_ns - at_ns % MINUTE_NS)
            if frames is not None:
                first = int(np.searchsorted(frames.stamp_ns, at_ns))
                if first < len(frames):
                    yield frames.part(first, len(frames))
            at_ns += MINUTE_NS - at_ns % MINUTE_NS


def follow(database: MadeUpTracks) -> TrafficFollower:
    """The counter of the node."""
    return TrafficFollower(database, "cam", SCHEME, CLOCK, lambda _: StampedLanes(0, lanes()))


def two_weeks(path: Path, days: int) -> NDArray[np.void]:
    """Count, with stops after odd times; report and return the stored intervals."""
    end_ns = BEGIN_NS + round(days * 86_400) * NS
    start = time.perf_counter()
    for stop in (*np.random.default_rng(0).uniform(0.0, 1.0, 6).tolist(), 1.0):
        with MadeUpTracks(path) as database:
            database.until_ns = BEGIN_NS + int(stop * (end_ns - BEGIN_NS))
            database.append_lanes("cam", BEGIN_NS, "lanes")
            follower = follow(database)
            while follower.step().batches:
                pass
    took_s = time.perf_counter() - start
    with TrafficReader(path) as reader:
        (series,) = reader.traffic_series("cam")
        rows, vehicles = reader.traffic_rows(series.name), reader.traffic_vehicles("cam")
    starts = np.unique(rows["start_ns"])
    edges = CLOCK.edges(BEGIN_NS, series.end_ns - 1)
    print(f"{days} days: {series.intervals} intervals of {len(edges) - 1}, {len(rows)} rows,")
    print(f"  {len(vehicles)} passages, {path.stat().st_size / 1e6:.1f} MB, {took_s:.0f} s")
    print(f"  every interval once: {np.array_equal(starts, edges[:-1])}")
    missing = np.unique(rows["start_ns"][rows["observed"] == 0])
    print(f"  not watched at all: {len(missing)}, marked with observed 0")
    return rows


def compare(rows: NDArray[np.void], days: int) -> None:
    """The same with the offline way."""
    start = time.perf_counter()
    end_ns = BEGIN_NS + days * 86_400 * NS
    blocks = (minute(at_ns) for at_ns in range(BEGIN_NS, end_ns, MINUTE_NS))
    recorded = record(TrafficCounter(lanes()), (b for b in blocks if b is not None), GAP_S)
    expected = pack_measures(np.concatenate(list(all_measures(recorded, SCHEME, CLOCK))))
    same = rows.tobytes() == expected[: len(rows)].tobytes()
    print(f"  offline the same bytes: {same} ({time.perf_counter() - start:.0f} s)")


def year(path: Path, day: NDArray[np.void], cameras: int, days: int) -> None:
    """Fill a database; ask for a camera's year, and for all cameras' day."""
    start = time.perf_counter()
    with TrafficDatabase(path) as database:
        connection = database._connection
        connection.execute("PRAGMA synchronous = OFF")
        for k in range(cameras):
            connection.execute("INSERT INTO camera VALUES (?, ?)", (k + 1, f"cam{k}"))
            values = (k + 1, k + 1, 900, CLOCK.zone, "s")
            connection.execute("INSERT INTO traffic_series VALUES (?, ?, ?, ?, ?)", values)
        first_ns = int(day["start_ns"].min())
        for d in range(days):
            rows, shift_ns = day.copy(), d * 86_400 * NS
            rows["start_ns"] += shift_ns
            rows["end_ns"] += shift_ns
            begin_ns, data = first_ns + shift_ns, encode_rows(rows)
            connection.execute("BEGIN")
            connection.executemany(
                "INSERT INTO traffic_interval (series, start_ns, end_ns, intervals, row_count,"
                " data) VALUES (?, ?, ?, 96, ?, ?)",
                [
                    (k + 1, begin_ns, begin_ns + 86_400 * NS, len(rows), data)
                    for k in range(cameras)
                ],
            )
            connection.execute("COMMIT")
    size = path.stat().st_size
    took_s = time.perf_counter() - start
    print(f"{cameras} cameras, {days} days: {size / 1e9:.2f} GB, filled in {took_s:.0f} s")
    with TrafficReader(path) as reader:
        names = [SeriesName(f"cam{k}", 900, CLOCK.zone, "s") for k in range(cameras)]
        for camera in np.random.default_rng(1).integers(0, cameras, 3).tolist():
            start = time.perf_counter()
            count = len(reader.traffic_rows(names[camera]))
            print(f"  a camera's year, {count} rows: {time.perf_counter() - start:.2f} s")
        begin_ns = first_ns + (days // 2) * 86_400 * NS
        for length_s, what in ((900, "interval"), (86_400, "day")):
            start = time.perf_counter()
            count = sum(
                len(reader.traffic_rows(name, begin_ns, begin_ns + length_s * NS)) for name in names
            )
            print(f"  an {what} of all, {count} rows: {time.perf_counter() - start:.2f} s")
        start = time.perf_counter()
        print(f"  what is there, {len(reader.traffic_series())} series:", end=" ")
        print(f"{time.perf_counter() - start:.2f} s")


def main() -> None:
    """Run both."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--days", type=int, default=14)
    parser.add_argument("--cameras", type=int, default=1000)
    parser.add_argument("--year-days", type=int, default=365)
    parser.add_argument("--folder", type=Path)
    given = parser.parse_args()
    with TemporaryDirectory(dir=given.folder) as folder:
        rows = two_weeks(Path(folder) / "weeks.db", given.days)
        compare(rows, given.days)
        if given.cameras:
            middle_ns = int(CLOCK.start_of(BEGIN_NS + 86_400 * NS // 2))
            of_day = (rows["start_ns"] >= middle_ns) & (rows["start_ns"] < middle_ns + 86_400 * NS)
            year(Path(folder) / "year.db", rows[of_day], given.cameras, given.year_days)


if __name__ == "__main__":
    main()
