"""The trajectory database: ground tracks and lane maps of many cameras over days."""

from __future__ import annotations

import time
import zlib
from collections.abc import Callable, Iterable, Iterator
from contextlib import contextmanager
from dataclasses import astuple, dataclass, field
from pathlib import Path
from urllib.parse import quote

import numpy as np
from numpy.typing import NDArray

from geoorbit_ros.core.errors import InputFileError, MessageError, TableError
from geoorbit_ros.core.tables import TRACK_DTYPE
from geoorbit_ros.core.wall_clock import CLOCK_SET_NS
from geoorbit_ros.storage.database.reader import (
    VIEW_COLUMNS,
    CameraContent,
    TrajectoryReader,
    ViewEvent,
)
from geoorbit_ros.storage.database.schema import AGEING, encode_batch, faults_as_sentences
from geoorbit_ros.storage.ownership import Ownership

__all__ = ["COMMIT_PERIOD_S", "CameraContent", "TrajectoryDatabase", "TrajectoryReader"]

COMMIT_PERIOD_S = 0.8
"""Longest time that a frame is not committed, in wall time and in data time. Chosen: a kill costs
less than a second; shorter writes more."""
_SPAN_NS = int(COMMIT_PERIOD_S * 1e9)
"""Longest batch, below `MAX_BATCH_SPAN_NS` of the schema."""
_MIN_NS, _MAX_NS = -(2**62), 2**62
"""Earlier and later than any stamp."""
PRUNED = ("track_batch", "lane_map", "view_event")
"""Tables of which `prune` deletes old rows."""
PRUNE_STEP = 64
"""Batches deleted in one call of `prune`. Chosen: takes milliseconds; more hold up the frames."""


@dataclass(slots=True)
class _Camera:
    """One camera's frames that are not committed yet, and the time that is free for the next."""

    key: int
    last_ns: int = _MIN_NS
    end_ns: int = _MAX_NS
    stamps: list[int] = field(default_factory=list)
    tables: list[NDArray[np.void]] = field(default_factory=list)


class TrajectoryDatabase(TrajectoryReader):
    """Append-only store in one SQLite file. Thread-safe.

    Any number of processes may read while one or more write. `append` commits by itself what is
    older than `COMMIT_PERIOD_S`; a writer whose cameras may fall silent also calls `flush` from a
    timer. Reading sees what is committed.

    Args:
        path: The SQLite file; made when missing.
        wall_ns: This computer's clock, which says when rows were stored.

    Raises:
        InputFileError: By every method, when the file can't be used.
    """

    _read_only = False

    def __init__(self, path: str | Path, wall_ns: Callable[[], int] = time.time_ns) -> None:
        super().__init__(path)
        self._wall_ns = wall_ns
        self._cameras: dict[str, _Camera] = {}
        self._unsaved_since: float | None = None
        self._owned: list[Ownership] = []

    def claim(self, camera_id: str, purpose: str = "") -> None:
        """Be the one writer of a camera's data, under whatever name others opened the file.

        Args:
            camera_id: The camera.
            purpose: What is written, where it is not the recording: it has a writer of its own.

        Raises:
            InputFileError: Another process writes them, and which.
        """
        file = self.path.resolve()
        ends = f".{purpose}.lock" if purpose else ".lock"
        lock = file.with_name(f".{file.name}.{quote(camera_id, safe='')}{ends}")
        what = f"{purpose} in {file}" if purpose else str(file)
        self._owned.append(Ownership(lock, f"{what}, camera {camera_id}"))

    def append(self, camera_id: str, stamp_ns: int, rows: NDArray[np.void]) -> None:
        """Take one frame; a frame without rows counts as seen and empty.

        A stamp that goes back begins to fill the time before what is stored, as after a clock that
        was ahead: one wrong stamp does not stop a recording. Time that is stored stays as it is.

        Args:
            camera_id: Whose frame.
            stamp_ns: Capture time, at which nothing of the camera is stored.
            rows: `TRACK_DTYPE`; copied.

        Raises:
            MessageError: A stamp within the time of stored frames: the same bag again.
            TableError: Rows of another type.
        """
        if rows.dtype != TRACK_DTYPE:
            raise TableError(f"tracks of '{camera_id}'", rows.dtype.names, "the fields of tracks")
        with self._lock:
            camera = self._cameras.get(camera_id) or self._camera(camera_id)
            if not camera.last_ns < stamp_ns < camera.end_ns:
                self.flush()
                camera.last_ns, camera.end_ns = self._free(camera_id, camera.key, stamp_ns)
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
                    "INSERT OR REPLACE INTO lane_map (camera, stamp_ns, geojson, stored_ns)"
                    " VALUES (?, ?, ?, ?)",
                    (camera.key, stamp_ns, packed, self._stored_ns),
                )

    def put_view_events(self, camera_id: str, events: Iterable[ViewEvent]) -> None:
        """Store what happened to the view, at once; one of the same beginning is replaced."""
        with self._lock:
            camera = self._cameras.get(camera_id) or self._camera(camera_id)
            marks = ", ".join("?" * (2 + len(VIEW_COLUMNS.split(","))))
            stored_ns = self._stored_ns
            with self._transaction():
                self._connection.executemany(
                    f"INSERT OR REPLACE INTO view_event (camera, stored_ns, {VIEW_COLUMNS})"
                    f" VALUES ({marks})",
                    [(camera.key, stored_ns, *astuple(event)) for event in events],
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
                for owned in self._owned:
                    owned.close()

    def prune(self, camera_id: str, older_than_ns: int, limit: int = PRUNE_STEP) -> int:
        """Delete a camera's data that were stored before `older_than_ns`, the oldest first.

        By the clock of then, whatever their stamps say; what versions before 5 stored goes by its
        stamps. At most `limit` batches and as many lane maps go per call, so that one call takes
        milliseconds; call it again until it returns 0. Space goes back to the file system in steps
        too, once an eighth of the file is free.

        Returns:
            How many batches and lane maps were deleted.
        """
        with self._lock:
            key = (self._cameras.get(camera_id) or self._camera(camera_id)).key
            with self._transaction():
                deleted = sum(self._delete_old(k, key, older_than_ns, limit) for k in PRUNED)
            self._give_back(16 * limit)  # a batch takes about five pages: space goes back faster
            return deleted

    def newest_stored_ns(self, camera_id: str) -> int | None:
        """When the camera's last frames were stored, by the clock of then; None: not known."""
        with self._lock, faults_as_sentences(self.path):
            row = self._connection.execute(
                "SELECT stored_ns FROM track_batch JOIN camera ON camera.id = camera"
                " WHERE name = ? ORDER BY track_batch.id DESC LIMIT 1",
                (camera_id,),
            ).fetchone()
        return None if row is None else row[0]

    def _delete_old(self, table: str, owner: int, older_than_ns: int, limit: int) -> int:
        """Within a transaction: rows of an owner that were stored before a time."""
        column, ended = AGEING[table]
        age = f"coalesce(stored_ns, {ended})"
        return self._connection.execute(
            f"DELETE FROM {table} WHERE id IN (SELECT id FROM {table}"
            f" WHERE {column} = ? AND {age} < ? ORDER BY {age} LIMIT ?)",
            (owner, older_than_ns, limit),
        ).rowcount

    def _give_back(self, pages: int) -> None:
        """Give so many free pages to the file system, where an eighth of the file is free."""
        with faults_as_sentences(self.path):
            free = self._connection.execute("PRAGMA freelist_count").fetchone()[0]
            if free > self._connection.execute("PRAGMA page_count").fetchone()[0] // 8:
                # executescript: execute() would step this pragma once, for one page.
                self._connection.executescript(f"PRAGMA incremental_vacuum({pages})")

    @property
    def _stored_ns(self) -> int | None:
        """Now; None where this computer's clock is not set."""
        now = self._wall_ns()
        return now if now >= CLOCK_SET_NS else None

    def _free(self, camera_id: str, key: int, stamp_ns: int) -> tuple[int, int]:
        """The time without stored frames that a stamp lies in, both ends excluded.

        Raises:
            MessageError: Frames of that time are stored.
        """
        with faults_as_sentences(self.path):
            last_ns, end_ns = self._connection.execute(
                "SELECT (SELECT end_ns FROM track_batch WHERE camera = ?1 AND start_ns <= ?2"
                " ORDER BY start_ns DESC LIMIT 1),"
                " (SELECT min(start_ns) FROM track_batch WHERE camera = ?1 AND start_ns > ?2)",
                (key, stamp_ns),
            ).fetchone()
        if last_ns is not None and stamp_ns <= last_ns:
            raise MessageError(
                f"tracks of '{camera_id}'",
                f"stamp {stamp_ns / 1e9:.9f} s",
                f"one later than {last_ns / 1e9:.9f} s: until then {self.path} has frames",
            )
        return _MIN_NS if last_ns is None else last_ns, _MAX_NS if end_ns is None else end_ns

    def _camera(self, camera_id: str) -> _Camera:
        """A camera that this object has not written yet, which the file may know."""
        with self._transaction():
            self._connection.execute("INSERT OR IGNORE INTO camera (name) VALUES (?)", (camera_id,))
            (key,) = self._connection.execute(
                "SELECT id FROM camera WHERE name = ?", (camera_id,)
            ).fetchone()
        camera = _Camera(key, _MAX_NS)  # where the first frame lies is looked up when it comes
        self._cameras[camera_id] = camera
        return camera

    def _write_batch(self, camera: _Camera) -> None:
        self._connection.execute(
            "INSERT INTO track_batch (camera, start_ns, end_ns, frames, row_count, data, stored_ns)"
            " VALUES (?, ?, ?, ?, ?, ?, ?)",
            (
                camera.key,
                camera.stamps[0],
                camera.stamps[-1],
                len(camera.stamps),
                sum(len(table) for table in camera.tables),
                encode_batch(camera.stamps, camera.tables),
                self._stored_ns,
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
