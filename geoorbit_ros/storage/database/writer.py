"""The trajectory database: ground tracks and lane maps of many cameras over days."""

from __future__ import annotations

import time
import zlib
from collections.abc import Iterable, Iterator
from contextlib import contextmanager
from dataclasses import astuple, dataclass, field
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from geoorbit_ros.core.errors import InputFileError, MessageError, TableError
from geoorbit_ros.core.tables import TRACK_DTYPE
from geoorbit_ros.storage.database.reader import (
    VIEW_COLUMNS,
    CameraContent,
    TrajectoryReader,
    ViewEvent,
)
from geoorbit_ros.storage.database.schema import encode_batch, faults_as_sentences

__all__ = ["COMMIT_PERIOD_S", "CameraContent", "TrajectoryDatabase", "TrajectoryReader"]

COMMIT_PERIOD_S = 0.8
"""Longest time that a frame is not committed, in wall time and in data time. Chosen: a kill costs
less than a second; shorter writes more."""
_SPAN_NS = int(COMMIT_PERIOD_S * 1e9)
"""Longest batch, below `MAX_BATCH_SPAN_NS` of the schema."""
_MIN_NS = -(2**62)
"""Earlier than any stamp."""
PRUNED = (("track_batch", "end_ns"), ("lane_map", "stamp_ns"), ("view_event", "end_ns"))
"""Tables of which old rows are deleted, with the column that says how old."""
PRUNE_STEP = 64
"""Batches deleted in one call of `prune`. Chosen: takes milliseconds; more hold up the frames."""


@dataclass(slots=True)
class _Camera:
    """One camera's frames that are not committed yet."""

    key: int
    last_ns: int = _MIN_NS
    stamps: list[int] = field(default_factory=list)
    tables: list[NDArray[np.void]] = field(default_factory=list)


class TrajectoryDatabase(TrajectoryReader):
    """Append-only store in one SQLite file. Thread-safe.

    Any number of processes may read while one or more write. `append` commits by itself what is
    older than `COMMIT_PERIOD_S`; a writer whose cameras may fall silent also calls `flush` from a
    timer. Reading sees what is committed.

    Args:
        path: The SQLite file; made when missing.

    Raises:
        InputFileError: By every method, when the file can't be used.
    """

    _read_only = False

    def __init__(self, path: str | Path) -> None:
        super().__init__(path)
        self._cameras: dict[str, _Camera] = {}
        self._unsaved_since: float | None = None

    def append(self, camera_id: str, stamp_ns: int, rows: NDArray[np.void]) -> None:
        """Take one frame; a frame without rows counts as seen and empty.

        Args:
            camera_id: Whose frame.
            stamp_ns: Capture time, later than that of the camera's last stored frame.
            rows: `TRACK_DTYPE`; copied.

        Raises:
            MessageError: A stamp that is not later: the same bag again, or a clock set back.
            TableError: Rows of another type.
        """
        if rows.dtype != TRACK_DTYPE:
            raise TableError(f"tracks of '{camera_id}'", rows.dtype.names, "the fields of tracks")
        with self._lock:
            camera = self._cameras.get(camera_id) or self._camera(camera_id)
            if stamp_ns <= camera.last_ns:
                raise MessageError(
                    f"tracks of '{camera_id}'",
                    f"stamp {stamp_ns / 1e9:.9f} s",
                    f"one later than {camera.last_ns / 1e9:.9f} s, the last in {self.path}",
                )
            now = time.monotonic()
            since = self._unsaved_since
            if (since is not None and now - since >= COMMIT_PERIOD_S) or (
                camera.stamps and stamp_ns - camera.stamps[0] >= _SPAN_NS
            ):
                self.flush()
            if self._unsaved_since is None:
                self._unsaved_since = now
            camera.last_ns = stamp_ns
            camera.stamps.append(stamp_ns)
            camera.tables.append(rows.copy())

    def append_lanes(self, camera_id: str, stamp_ns: int, geojson_text: str) -> None:
        """Store a lane map, at once; one with the same stamp is replaced."""
        with self._lock:
            camera = self._cameras.get(camera_id) or self._camera(camera_id)
            packed = zlib.compress(geojson_text.encode())
            with self._transaction():
                self._connection.execute(
                    "INSERT OR REPLACE INTO lane_map (camera, stamp_ns, geojson) VALUES (?, ?, ?)",
                    (camera.key, stamp_ns, packed),
                )

    def put_view_events(self, camera_id: str, events: Iterable[ViewEvent]) -> None:
        """Store what happened to the view, at once; one of the same beginning is replaced."""
        with self._lock:
            camera = self._cameras.get(camera_id) or self._camera(camera_id)
            marks = ", ".join("?" * (1 + len(VIEW_COLUMNS.split(","))))
            with self._transaction():
                self._connection.executemany(
                    f"INSERT OR REPLACE INTO view_event (camera, {VIEW_COLUMNS}) VALUES ({marks})",
                    [(camera.key, *astuple(event)) for event in events],
                )

    def flush(self) -> None:
        """Commit all frames taken so far.

        Raises:
            InputFileError: The disk is full, or the like. The frames are given up, so that memory
                stays bounded, and counted in the error.
        """
        with self._lock:
            waiting = [camera for camera in self._cameras.values() if camera.stamps]
            self._unsaved_since = None
            if not waiting:
                return
            try:
                with self._transaction():
                    for camera in waiting:
                        self._write_batch(camera)
            except InputFileError as error:
                lost = sum(len(camera.stamps) for camera in waiting)
                raise InputFileError(
                    error.place, f"{error.found}; {lost} frames lost", error.expected
                ) from error
            finally:
                for camera in waiting:
                    camera.stamps, camera.tables = [], []

    def close(self) -> None:
        """Commit and close; the object can't be used afterwards."""
        with self._lock:
            try:
                self.flush()
            finally:
                super().close()

    def prune(self, older_than_ns: int, limit: int = PRUNE_STEP) -> int:
        """Delete data that ended before `older_than_ns`, the oldest first.

        At most `limit` batches and as many lane maps go per call, so that one call takes
        milliseconds; call it again until it returns 0. Space goes back to the file system in steps
        too, once an eighth of the file is free.

        Returns:
            How many batches and lane maps were deleted.
        """
        with self._lock:
            deleted = 0
            with self._transaction():
                for table, column in PRUNED:
                    deleted += self._connection.execute(
                        f"DELETE FROM {table} WHERE id IN (SELECT id FROM {table}"
                        f" WHERE {column} < ? ORDER BY {column} LIMIT ?)",
                        (older_than_ns, limit),
                    ).rowcount
            with faults_as_sentences(self.path):
                free = self._connection.execute("PRAGMA freelist_count").fetchone()[0]
                pages = self._connection.execute("PRAGMA page_count").fetchone()[0]
                if free > pages // 8:
                    steps = 16 * limit  # a batch takes about five pages: space goes back faster
                    # executescript: execute() would step this pragma once, for one page.
                    self._connection.executescript(f"PRAGMA incremental_vacuum({steps})")
            return deleted

    def _camera(self, camera_id: str) -> _Camera:
        """A camera that this object has not written yet, which the file may know."""
        with self._transaction():
            self._connection.execute("INSERT OR IGNORE INTO camera (name) VALUES (?)", (camera_id,))
            key, last_ns = self._connection.execute(
                "SELECT camera.id, max(end_ns) FROM camera LEFT JOIN track_batch"
                " ON track_batch.camera = camera.id WHERE name = ?",
                (camera_id,),
            ).fetchone()
        camera = _Camera(key, _MIN_NS if last_ns is None else last_ns)
        self._cameras[camera_id] = camera
        return camera

    def _write_batch(self, camera: _Camera) -> None:
        self._connection.execute(
            "INSERT INTO track_batch (camera, start_ns, end_ns, frames, row_count, data)"
            " VALUES (?, ?, ?, ?, ?, ?)",
            (
                camera.key,
                camera.stamps[0],
                camera.stamps[-1],
                len(camera.stamps),
                sum(len(table) for table in camera.tables),
                encode_batch(camera.stamps, camera.tables),
            ),
        )

    @contextmanager
    def _transaction(self) -> Iterator[None]:
        """All or nothing, committed on the way out."""
        with faults_as_sentences(self.path):
            self._connection.execute("BEGIN IMMEDIATE")
            try:
                yield
                self._connection.execute("COMMIT")
            except BaseException:
                if self._connection.in_transaction:  # SQLite itself rolls back on a full disk
                    self._connection.execute("ROLLBACK")
                raise
