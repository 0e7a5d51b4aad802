"""Cost of storing and reading tracks, each beside the plain way of doing the same.

8 cameras at 30 Hz with 20 vehicles each are 4,800 rows and 240 frames per second; absolute figures
for that load go to standard error.
"""

from __future__ import annotations

import csv
import json
import sqlite3
import sys
import tempfile
import time
from collections.abc import Callable
from pathlib import Path

import numpy as np
from rclpy.serialization import deserialize_message, serialize_message
from sensor_msgs.msg import PointCloud2

from geoorbit_ros.core.tables import PIXEL_TRACK_DTYPE, TRACK_DTYPE, Frames
from geoorbit_ros.storage.database.writer import TrajectoryDatabase, TrajectoryReader
from geoorbit_ros.storage.pointcloud2 import decode_table, encode_table
from geoorbit_ros.storage.track_bag import read_track_bag, write_track_bag
from geoorbit_ros.storage.track_csv import read_track_csv, write_track_csv

FRAMES, VEHICLES, REPEATS = 1800, 20, 3
LOAD_ROWS_PER_S = 8 * 30 * 20


def made_frames(dtype: np.dtype[np.void]) -> Frames:
    """A minute of vehicles that move evenly, with the noise of a detector."""
    generator = np.random.default_rng(1)
    rows = np.zeros((FRAMES, VEHICLES), dtype)
    seconds = np.arange(FRAMES)[:, None] / 30
    for name in set(dtype.names or ()) & {"x", "y", "vx", "vy", "heading", "width", "height"}:
        start, speed = generator.uniform(10, 900, VEHICLES), generator.uniform(1, 30, VEHICLES)
        rows[name] = start + speed * seconds + generator.normal(0, 0.1, rows.shape)
    rows["score"] = generator.uniform(0.3, 1, rows.shape)
    rows["track_id"] = np.arange(VEHICLES)
    stamp_ns = np.arange(FRAMES, dtype=np.int64) * 33_333_333
    return Frames(stamp_ns, np.arange(FRAMES + 1, dtype=np.int64) * VEHICLES, rows.ravel())


def best_s(work: Callable[[], object]) -> float:
    """Shortest time of a few runs: the others measure what else the machine does."""
    times = []
    for _ in range(REPEATS):
        start = time.perf_counter()
        work()
        times.append(time.perf_counter() - start)
    return min(times)


def report(name: str, ratio: float, limit: float, note: str) -> None:
    print(json.dumps({"name": name, "ratio": round(ratio, 4), "limit": limit}))
    print(f"{name}: {note}", file=sys.stderr)


def compare_csv(folder: Path, frames: Frames) -> None:
    path = folder / "tracks.csv"
    write_s = best_s(lambda: write_track_csv(path, frames))

    def plain() -> int:
        with path.open() as file:
            return sum(len([float(cell) for cell in row.values()]) for row in csv.DictReader(file))

    ours, peer, rows = best_s(lambda: read_track_csv(path)), best_s(plain), len(frames.rows)
    note = f"{rows} rows read in {1e3 * ours:.1f} ms, written in {1e3 * write_s:.1f} ms"
    report("read tracks.csv / Python's csv module", ours / peer, 0.4, note)


def compare_messages(frames: Frames) -> None:
    rows = frames.frame(0)
    cdr = encode_table(1, "pole_7_optical", rows)
    message = deserialize_message(cdr, PointCloud2)

    def many(work: Callable[[], object]) -> Callable[[], None]:
        return lambda: [work() for _ in range(5000)].clear()

    for name, ours, peer in (
        (
            "encode",
            lambda: encode_table(1, "pole_7_optical", rows),
            lambda: serialize_message(message),
        ),
        (
            "decode",
            lambda: decode_table(cdr, rows.dtype, "t"),
            lambda: deserialize_message(cdr, PointCloud2),
        ),
    ):
        own_s, peer_s = best_s(many(ours)), best_s(many(peer))
        note = (
            f"{own_s / 5000 * 1e6:.1f} µs for {len(rows)} rows, rclpy {peer_s / 5000 * 1e6:.1f} µs"
        )
        report(f"{name} a table / rclpy of a ready message", own_s / peer_s, 1.0, note)


def compare_bags(folder: Path, frames: Frames) -> None:
    size, note = {}, []
    for storage in ("mcap", "sqlite3"):
        path = folder / storage
        start = time.perf_counter()
        write_track_bag(path, "pole_7", frames, storage)
        write_s = time.perf_counter() - start
        read_s = best_s(lambda path=path: read_track_bag(path))  # type: ignore[misc]
        size[storage] = sum(file.stat().st_size for file in path.iterdir())
        note.append(
            f"{storage} {size[storage] / 1e3:.0f} kB, written in {1e3 * write_s:.0f} ms, "
            f"read in {1e3 * read_s:.0f} ms"
        )
    report("size of a bag, mcap / sqlite3", size["mcap"] / size["sqlite3"], 0.9, "; ".join(note))


def compare_database(folder: Path, frames: Frames) -> None:
    path, peer_path = folder / "tracks.db", folder / "rows.db"
    append_us = []
    with TrajectoryDatabase(path) as database:
        for k, stamp_ns in enumerate(frames.stamp_ns.tolist()):
            start = time.perf_counter()
            database.append("pole_7", stamp_ns, frames.frame(k))
            append_us.append(1e6 * (time.perf_counter() - start))
    own_s = sum(append_us) / 1e6

    peer = sqlite3.connect(peer_path, isolation_level=None)
    peer.execute("PRAGMA journal_mode = WAL")
    peer.execute("PRAGMA synchronous = NORMAL")
    columns = ", ".join(TRACK_DTYPE.names or ())
    peer.execute(f"CREATE TABLE t (stamp, {columns}, PRIMARY KEY (stamp, track_id)) WITHOUT ROWID")
    marks = ", ".join("?" * (1 + len(TRACK_DTYPE.names or ())))
    start = time.perf_counter()
    for k in range(0, FRAMES, 30):
        rows = frames.rows[frames.offset[k] : frames.offset[k + 30]]
        stamps = frames.row_stamp_ns()[frames.offset[k] : frames.offset[k + 30]].tolist()
        peer.execute("BEGIN")
        values = zip(
            stamps, *(rows[name].tolist() for name in TRACK_DTYPE.names or ()), strict=True
        )
        peer.executemany(f"INSERT INTO t VALUES ({marks})", values)
        peer.execute("COMMIT")
    peer_s = time.perf_counter() - start
    peer.close()
    number, own_size = len(frames.rows), path.stat().st_size
    load = LOAD_ROWS_PER_S * own_s / number
    note = (
        f"{number / own_s:.0f} rows/s, {load:.1%} of one core at 8 cameras; one append "
        f"{np.median(append_us):.1f} µs, 99 % within {np.percentile(append_us, 99):.0f} µs"
    )
    report("append to the database / a SQLite row per vehicle", own_s / peer_s, 1.2, note)
    with TrajectoryReader(path) as reader:
        read_s = best_s(lambda: reader.read("pole_7"))
    gigabytes = own_size / number * LOAD_ROWS_PER_S * 86400 / 1e9
    note = (
        f"{own_size / number:.1f} bytes per row, {gigabytes:.1f} GB a day at 8 cameras; "
        f"{number / read_s:.0f} rows/s read"
    )
    ratio = own_size / peer_path.stat().st_size
    report("size of the database / a SQLite row per vehicle", ratio, 0.5, note)


def main() -> None:
    pixels, ground = made_frames(PIXEL_TRACK_DTYPE), made_frames(TRACK_DTYPE)
    with tempfile.TemporaryDirectory() as name:
        compare_csv(Path(name), pixels)
        compare_messages(pixels)
        compare_bags(Path(name), pixels)
        compare_database(Path(name), ground)


if __name__ == "__main__":
    main()
