"""Reading a trajectory database, also while another process writes it."""

from __future__ import annotations

import sqlite3
import threading
import zlib
from collections.abc import Callable, Iterator
from contextlib import closing
from dataclasses import dataclass
from pathlib import Path
from typing import Self

import numpy as np

from geoorbit_ros.core.errors import ParameterError
from geoorbit_ros.core.tables import TRACK_DTYPE, Frames
from geoorbit_ros.storage.database.schema import (
    MAX_BATCH_SPAN_NS,
    connect,
    decode_batch,
    faults_as_sentences,
)

_PAGE_BATCHES = 16
"""Batches read at once: about 13 s of one camera. Chosen: more hold the lock longer and take
memory."""
_MIN_NS = -(2**62)
"""Earlier than any stamp, with room to subtract a batch's span: 146 years before 1970."""
_MAX_NS = 2**62
"""Later than any stamp: 146 years after 1970."""


@dataclass(frozen=True, slots=True)
class CameraContent:
    """What is stored of one camera; times of the first and last frame, 0 without one."""

    camera_id: str
    start_ns: int
    end_ns: int
    frames: int
    rows: int
    lane_maps: int


@dataclass(frozen=True, slots=True)
class ViewEvent:
    """A time in which a camera's view was in one state; see `view.timeline.ViewStretch`."""

    start_ns: int
    end_ns: int
    state: str
    blindness: str
    view: int
    moved_px: float
    right_px: float
    down_px: float
    sway_px: float
    found_s: float


VIEW_COLUMNS = ", ".join(ViewEvent.__dataclass_fields__)
"""Of `view_event`, as `ViewEvent` has them."""


class TrajectoryReader:
    """What is committed in a trajectory database; never changes the file. Thread-safe.

    Use it as a context manager, or call `close`.

    Args:
        path: The SQLite file.

    Raises:
        InputFileError: By every method, when the file can't be used.
    """

    _read_only = True

    def __init__(self, path: str | Path) -> None:
        self.path = Path(path)
        self._lock = threading.RLock()
        self._connection = connect(self.path, read_only=self._read_only)

    def close(self) -> None:
        """Close the file; the object can't be used afterwards."""
        with self._lock:
            self._connection.close()

    def read(
        self, camera_id: str, start_ns: int | None = None, end_ns: int | None = None
    ) -> Frames:
        """All frames with start_ns <= stamp < end_ns, `TRACK_DTYPE`.

        Raises:
            ParameterError: No such camera; names those there are.
        """
        parts = list(self.batches(camera_id, start_ns, end_ns))
        if not parts:
            return Frames(np.empty(0, np.int64), np.zeros(1, np.int64), np.empty(0, TRACK_DTYPE))
        counts = np.concatenate([np.diff(part.offset) for part in parts])
        return Frames(
            np.concatenate([part.stamp_ns for part in parts]),
            np.append(0, np.cumsum(counts)).astype(np.int64),
            np.concatenate([part.rows for part in parts]),
        )

    def batches(
        self, camera_id: str, start_ns: int | None = None, end_ns: int | None = None
    ) -> Iterator[Frames]:
        """As `read`, piece by piece in time order: memory stays small and no lock is held."""
        start = _MIN_NS if start_ns is None else start_ns
        end = _MAX_NS if end_ns is None else end_ns
        key, after = self._key(camera_id), start - MAX_BATCH_SPAN_NS
        while page := self._page(key, after, end):
            for first_ns, frames, rows, data in page:
                with faults_as_sentences(self.path):
                    part = _cut(decode_batch(data, frames, rows), start, end)
                if len(part):
                    yield part
                after = first_ns

    def lane_maps(
        self, camera_id: str, start_ns: int = _MIN_NS, end_ns: int = _MAX_NS
    ) -> list[tuple[int, str]]:
        """Stored lane maps with start_ns <= stamp < end_ns as (stamp_ns, GeoJSON text)."""
        key = self._key(camera_id)
        with self._lock, faults_as_sentences(self.path):
            found = self._connection.execute(
                "SELECT stamp_ns, geojson FROM lane_map WHERE camera = ? AND stamp_ns >= ?"
                " AND stamp_ns < ? ORDER BY stamp_ns",
                (key, start_ns, end_ns),
            )
            return [(stamp_ns, zlib.decompress(packed).decode()) for stamp_ns, packed in found]

    def lane_map_stamps(self, camera_id: str) -> list[int]:
        """Stamps of the stored lane maps, increasing."""
        key = self._key(camera_id)
        with self._lock, faults_as_sentences(self.path):
            found = self._connection.execute(
                "SELECT stamp_ns FROM lane_map WHERE camera = ? ORDER BY stamp_ns", (key,)
            )
            return [stamp_ns for (stamp_ns,) in found]

    def view_events(
        self, camera_id: str, start_ns: int = _MIN_NS, end_ns: int = _MAX_NS
    ) -> list[ViewEvent]:
        """What happened to the view in that time, by its beginning; none in files of before."""
        key = self._key(camera_id)
        with self._lock, faults_as_sentences(self.path):
            if not self._connection.execute(
                "SELECT 1 FROM sqlite_master WHERE name = 'view_event'"
            ).fetchone():
                return []
            found = self._connection.execute(
                f"SELECT {VIEW_COLUMNS} FROM view_event WHERE camera = ? AND end_ns >= ?"
                " AND start_ns < ? ORDER BY start_ns",
                (key, start_ns, end_ns),
            )
            return [ViewEvent(*row) for row in found]

    def cameras(self) -> tuple[CameraContent, ...]:
        """What is committed, by camera id."""
        with self._lock, faults_as_sentences(self.path):
            found = self._connection.execute(
                "SELECT name, coalesce(min(start_ns), 0), coalesce(max(end_ns), 0),"
                " coalesce(sum(frames), 0), coalesce(sum(row_count), 0),"
                " (SELECT count(*) FROM lane_map WHERE lane_map.camera = camera.id)"
                " FROM camera LEFT JOIN track_batch ON track_batch.camera = camera.id"
                " GROUP BY camera.id ORDER BY name"
            ).fetchall()
        return tuple(CameraContent(*row) for row in found)

    def copy_to(
        self, out: Path, pages: int, progress: Callable[[int, int], None] | None = None
    ) -> None:
        """Copy what is committed at one moment into a new file, so many pages at once."""

        def told(_: int, left: int, total: int) -> None:
            if progress is not None:
                progress(total - left, total)

        with self._lock, faults_as_sentences(self.path), closing(sqlite3.connect(out)) as copy:
            self._connection.backup(copy, pages=pages, progress=told)

    def _key(self, camera_id: str) -> int:
        with self._lock, faults_as_sentences(self.path):
            found = dict(self._connection.execute("SELECT name, id FROM camera ORDER BY name"))
        if camera_id not in found:
            known = ", ".join(f"'{name}'" for name in found) or "none yet"
            raise ParameterError(
                "camera id", f"'{camera_id}'", f"a camera in {self.path} ({known})"
            )
        return int(found[camera_id])

    def _page(self, key: int, after_ns: int, end_ns: int) -> list[tuple[int, int, int, bytes]]:
        """The next batches: start_ns, frames, rows, data."""
        with self._lock, faults_as_sentences(self.path):
            return self._connection.execute(
                "SELECT start_ns, frames, row_count, data FROM track_batch"
                " WHERE camera = ? AND start_ns > ? AND start_ns < ? ORDER BY start_ns LIMIT ?",
                (key, after_ns, end_ns, _PAGE_BATCHES),
            ).fetchall()

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()


def _cut(frames: Frames, start_ns: int, end_ns: int) -> Frames:
    """The frames with start_ns <= stamp < end_ns."""
    first, last = np.searchsorted(frames.stamp_ns, (start_ns, max(start_ns, end_ns)))
    offset = frames.offset[first : last + 1]
    rows = frames.rows[offset[0] : offset[-1]]
    return Frames(frames.stamp_ns[first:last], offset - offset[0], rows)
