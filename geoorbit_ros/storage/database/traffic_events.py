"""Events on the road beside the tracks: what was told of them, row by row, and how far.

Rows are numbered as they are told, and a row is stored once, whoever tells it again. Beside them is
the state of who watches: a watch that is stopped goes on from it, and finds the rows that are
stored already by their numbers.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from geoorbit_ros.storage.database.schema import decode_rows, encode_rows, faults_as_sentences
from geoorbit_ros.storage.database.traffic_series import (
    SeriesName,
    SeriesReader,
    SeriesWriter,
    joined,
)

EVENTS_VERSION = 3
"""Files of earlier versions have no events and no movements."""
_MIN_NS = -(2**62)
_MAX_NS = 2**62


@dataclass(frozen=True, slots=True)
class StoredWatch:
    """State of who watches for events.

    Attributes:
        stamp_ns: The last frame that is in it.
        rows: Rows that it had told by then.
        data: The state, as `traffic.watch_state` packs it.
    """

    stamp_ns: int
    rows: int
    data: bytes


class EventReader(SeriesReader):
    """Events of a database."""

    def traffic_events(
        self, series: SeriesName, start_ns: int = _MIN_NS, end_ns: int = _MAX_NS
    ) -> NDArray[np.void]:
        """All that was told at start_ns <= time < end_ns, in the order in which it was told."""
        key = self._event_key(series)
        with self._lock, faults_as_sentences(self.path):
            found = (
                self._connection.execute(
                    "SELECT data, row_count FROM traffic_event"
                    " WHERE series = ? AND end_ns >= ? AND start_ns < ? ORDER BY first_row",
                    (key, start_ns, end_ns),
                ).fetchall()
                if key
                else []
            )
            rows = joined([decode_rows(*block) for block in found])
        if not len(rows):
            return rows
        told_ns = rows["stamp_ns"]
        return np.asarray(rows[(told_ns >= start_ns) & (told_ns < end_ns)])

    def traffic_event_rows(self, series: SeriesName) -> int:
        """Rows that were stored so far, deleted ones included."""
        key = self._event_key(series)
        return self._event_rows(key) if key else 0

    def traffic_watch(self, series: SeriesName) -> StoredWatch | None:
        """The newest state; None: there is none."""
        key = self._event_key(series)
        if not key:
            return None
        with self._lock, faults_as_sentences(self.path):
            row = self._connection.execute(
                "SELECT stamp_ns, row_count, data FROM traffic_watch WHERE series = ?", (key,)
            ).fetchone()
        return None if row is None else StoredWatch(*row)

    def _event_key(self, series: SeriesName) -> int:
        """0 where there can be no events."""
        return self._series_key(series) if self.version >= EVENTS_VERSION else 0

    def _event_rows(self, key: int) -> int:
        with self._lock, faults_as_sentences(self.path):
            (count,) = self._connection.execute(
                "SELECT max(coalesce((SELECT max(first_row + row_count) FROM traffic_event"
                " WHERE series = ?1), 0), coalesce((SELECT row_count FROM traffic_watch"
                " WHERE series = ?1), 0))",
                (key,),
            ).fetchone()
        return int(count)


class EventWriter(SeriesWriter, EventReader):
    """Stores events."""

    def append_events(
        self,
        series: SeriesName,
        first_row: int,
        rows: NDArray[np.void],
        watch: StoredWatch | None = None,
    ) -> NDArray[np.void]:
        """Store rows that are not stored yet, and the state of who watches: both or none.

        Args:
            series: The series on whose lane maps they were found.
            first_row: Number of the first row.
            rows: What was told, with `stamp_ns`.
            watch: Replaces the state before.

        Returns:
            The rows that were not stored before.
        """
        camera = self._camera_key(series.camera_id)
        with self._lock, self._transaction():
            key = self._new_series(camera, series)
            known = max(self._event_rows(key) - first_row, 0)
            rows = rows[known:]
            if len(rows):
                stamps = rows["stamp_ns"]
                self._connection.execute(
                    "INSERT INTO traffic_event (series, first_row, start_ns, end_ns, row_count,"
                    " data, stored_ns) VALUES (?, ?, ?, ?, ?, ?, ?)",
                    (
                        key,
                        first_row + known,
                        int(stamps.min()),
                        int(stamps.max()),
                        len(rows),
                        encode_rows(rows),
                        self._stored_ns,
                    ),
                )
            if watch is not None:
                self._connection.execute(
                    "INSERT OR REPLACE INTO traffic_watch (series, stamp_ns, row_count, data)"
                    " VALUES (?, ?, ?, ?)",
                    (key, watch.stamp_ns, watch.rows, watch.data),
                )
        return rows
