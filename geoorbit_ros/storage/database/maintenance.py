"""What is done with a whole database beside recording: part of it deleted, saved, brought back."""

from __future__ import annotations

import sqlite3
from collections.abc import Callable
from contextlib import closing
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from geoorbit_ros.core.errors import InputFileError
from geoorbit_ros.storage.atomic import atomic_output
from geoorbit_ros.storage.database.reader import TrajectoryReader
from geoorbit_ros.storage.database.schema import (
    MAX_BATCH_SPAN_NS,
    decode_batch,
    decode_rows,
    encode_batch,
    encode_rows,
    faults_as_sentences,
)
from geoorbit_ros.storage.database.traffic import TrafficDatabase

TIMES = {
    "traffic_interval": ("start_ns", 1),
    "traffic_movement": ("start_ns", 1),
    "traffic_event": ("stamp_ns", 1),
    "traffic_vehicle": ("last_ms", 1_000_000),
}
"""The column that says when a row was, and its unit in nanoseconds."""
COPY_PAGES = 1000
"""Pages copied at once. Chosen: 4 MB take milliseconds; more hold up who writes meanwhile."""


@dataclass(frozen=True, slots=True)
class Deleted:
    """What went.

    Attributes:
        frames: Frames of tracks.
        lane_maps: Lane maps.
        traffic_rows: Rows of intervals, movements, vehicles and events.
    """

    frames: int
    lane_maps: int
    traffic_rows: int


def delete(path: Path, camera_id: str, start_ns: int, end_ns: int) -> Deleted:
    """Delete what a camera recorded at start_ns <= time < end_ns: all of it or, on a fault, none.

    What is deleted is overwritten in the file, so that nobody finds it there later. A recorder may
    go on meanwhile; what it adds afterwards stays. What happened to the view is kept: it tells
    nothing of vehicles.

    Raises:
        ParameterError: No such camera.
        InputFileError: The file can't be used.
    """
    if not path.is_file():
        raise InputFileError(str(path), "no such file", "a trajectory database")
    with _Deletion(path) as database:
        return database.delete(camera_id, start_ns, end_ns)


class _Deletion(TrafficDatabase):
    """Opens a database to delete parts of it."""

    def delete(self, camera_id: str, start_ns: int, end_ns: int) -> Deleted:
        """See `delete`."""
        key = self._key(camera_id)
        with self._lock:
            with faults_as_sentences(self.path):
                self._connection.execute("PRAGMA secure_delete = ON")
            with self._transaction():
                frames = self._delete_frames(key, start_ns, end_ns)
                lane_maps = self._connection.execute(
                    "DELETE FROM lane_map WHERE camera = ? AND stamp_ns >= ? AND stamp_ns < ?",
                    (key, start_ns, end_ns),
                ).rowcount
                series = self._connection.execute(
                    "SELECT id FROM traffic_series WHERE camera = ?", (key,)
                ).fetchall()
                rows = self._delete_rows("traffic_vehicle", "camera", key, start_ns, end_ns)
                for (owner,) in series:
                    for table in ("traffic_interval", "traffic_movement", "traffic_event"):
                        rows += self._delete_rows(table, "series", owner, start_ns, end_ns)
                self._connection.execute(
                    "DELETE FROM traffic_watch WHERE stamp_ns >= ? AND stamp_ns < ? AND series IN"
                    " (SELECT id FROM traffic_series WHERE camera = ?)",
                    (start_ns, end_ns, key),
                )
            with faults_as_sentences(self.path):
                self._connection.execute("PRAGMA wal_checkpoint(TRUNCATE)")
                self._connection.executescript("PRAGMA incremental_vacuum")
        return Deleted(frames, lane_maps, rows)

    def _delete_frames(self, key: int, start_ns: int, end_ns: int) -> int:
        found = self._connection.execute(
            "SELECT id, frames, row_count, data FROM track_batch WHERE camera = ?"
            " AND start_ns > ? AND start_ns < ? AND end_ns >= ?",
            (key, start_ns - MAX_BATCH_SPAN_NS, end_ns, start_ns),
        ).fetchall()
        deleted = 0
        for number, frames, rows, data in found:
            batch = decode_batch(data, frames, rows)
            kept = np.flatnonzero((batch.stamp_ns < start_ns) | (batch.stamp_ns >= end_ns))
            deleted += frames - len(kept)
            if not len(kept):
                self._connection.execute("DELETE FROM track_batch WHERE id = ?", (number,))
            elif len(kept) < frames:
                stamps, tables = (
                    batch.stamp_ns[kept].tolist(),
                    [batch.frame(k) for k in kept.tolist()],
                )
                self._connection.execute(
                    "UPDATE track_batch SET start_ns = ?, end_ns = ?, frames = ?, row_count = ?,"
                    " data = ? WHERE id = ?",
                    (
                        stamps[0],
                        stamps[-1],
                        len(stamps),
                        sum(len(table) for table in tables),
                        encode_batch(stamps, tables),
                        number,
                    ),
                )
        return deleted

    def _delete_rows(self, table: str, owner: str, key: int, start_ns: int, end_ns: int) -> int:
        """Rows of blocks; a block keeps its times, which say what was counted already."""
        column, unit = TIMES[table]
        found = self._connection.execute(
            f"SELECT id, row_count, data FROM {table} WHERE {owner} = ? AND end_ns >= ?"
            " AND start_ns < ?",
            (key, start_ns, end_ns),
        ).fetchall()
        deleted = 0
        for number, count, data in found:
            rows = decode_rows(data, count)
            times_ns = rows[column].astype(np.int64) * unit
            kept = rows[(times_ns < start_ns) | (times_ns >= end_ns)]
            deleted += count - len(kept)
            if len(kept) < count:
                self._connection.execute(
                    f"UPDATE {table} SET row_count = ?, data = ? WHERE id = ?",
                    (len(kept), encode_rows(kept), number),
                )
        return deleted


def backup(path: Path, out: Path, progress: Callable[[int, int], None] | None = None) -> None:
    """Copy a database as it is at one moment, also while recorders write.

    Args:
        path: The database.
        out: New file.
        progress: Called with pages done and pages in all.

    Raises:
        InputFileError: It can't be read, or the copy can't be written.
    """
    with TrajectoryReader(path) as reader, atomic_output(out) as temporary:
        reader.copy_to(temporary, COPY_PAGES, progress)


def restore(saved: Path, path: Path) -> None:
    """Put a backup where no database is.

    Raises:
        InputFileError: There is one already, or the backup is damaged.
    """
    for name in (path, path.with_name(f"{path.name}-wal")):
        if name.exists():
            expected = "a new name; move the old database and its -wal file away first"
            raise InputFileError(str(name), "a file", expected)
    with TrajectoryReader(saved):  # it is one, of a version that is known
        pass
    with faults_as_sentences(saved), closing(sqlite3.connect(saved)) as connection:
        (found,) = connection.execute("PRAGMA quick_check(1)").fetchone()
    if found != "ok":
        raise InputFileError(str(saved), f"damage ({found})", "a whole backup")
    backup(saved, path)
