"""Traffic beside the tracks: intervals, vehicles, movements, and the maps they were counted on.

Rows are tables of numbers whose columns `traffic.packed` defines; what is stored tells its columns.
"""

from __future__ import annotations

import zlib
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from geoorbit_ros.core.errors import InputFileError
from geoorbit_ros.storage.database.schema import (
    AGEING,
    decode_rows,
    decode_tables,
    encode_rows,
    faults_as_sentences,
)
from geoorbit_ros.storage.database.traffic_events import EVENTS_VERSION, EventReader, EventWriter
from geoorbit_ros.storage.database.traffic_series import SeriesName, joined
from geoorbit_ros.storage.database.writer import PRUNE_STEP

BLOCK_INTERVALS = 96
"""A block with this many intervals is full. Chosen: a day of quarters of an hour; more takes longer
to write again with each interval, less makes a year slower to read."""
BLOCK_ROWS = 2000
"""So is one with this many rows. Chosen: 200 kB before compression."""
LATE_NS = 3_600_000_000_000
"""Passages may have ended so long before the block of their vehicle begins: paths are shorter."""
TABLES = ("traffic_interval", "traffic_vehicle", "traffic_movement", "traffic_event")
"""Tables whose blocks are deleted when they are old."""
_MIN_NS = -(2**62)
_MAX_NS = 2**62


@dataclass(frozen=True, slots=True)
class TrafficMap:
    """A lane map that intervals were counted on.

    Attributes:
        start_ns: Begin of the first of these intervals.
        stamp_ns: When the map was made.
        geojson: Its text.
    """

    start_ns: int
    stamp_ns: int
    geojson: str


@dataclass(frozen=True, slots=True)
class TrafficPart:
    """Intervals one after the other, to be stored together.

    Attributes:
        start_ns: Begin of the first.
        end_ns: End of the last.
        intervals: How many.
        rows: Their rows, with `start_ns`.
        vehicles: Rows of the vehicles that were last seen in them, with `last_ms`.
        movements: Rows of from where to where these went, with `start_ns`.
        lane_map: What they were counted on.
    """

    start_ns: int
    end_ns: int
    intervals: int
    rows: NDArray[np.void]
    vehicles: NDArray[np.void]
    movements: NDArray[np.void]
    lane_map: TrafficMap


class TrafficReader(EventReader):
    """A trajectory database's traffic tables, and all that `TrajectoryReader` reads.

    Files of version 1 have none: they read as empty.
    """

    def traffic_end(self, series: SeriesName) -> int | None:
        """End of the last stored interval; None: there is none."""
        with self._lock, faults_as_sentences(self.path):
            return self._end(self._series_key(series))

    def traffic_rows(
        self, series: SeriesName, start_ns: int = _MIN_NS, end_ns: int = _MAX_NS
    ) -> NDArray[np.void]:
        """Rows of the intervals that begin at start_ns <= time < end_ns, in time order."""
        return self._interval_rows("traffic_interval", series, start_ns, end_ns)

    def traffic_movements(
        self, series: SeriesName, start_ns: int = _MIN_NS, end_ns: int = _MAX_NS
    ) -> NDArray[np.void]:
        """Movements of the intervals that begin at start_ns <= time < end_ns, in time order.

        Files of version 2 have none.
        """
        if self.version < EVENTS_VERSION:
            return np.empty(0, np.dtype([]))
        return self._interval_rows("traffic_movement", series, start_ns, end_ns)

    def traffic_vehicles(
        self, camera_id: str, start_ns: int = _MIN_NS, end_ns: int = _MAX_NS
    ) -> NDArray[np.void]:
        """Passages of vehicles along lanes that ended at start_ns <= time < end_ns, by vehicle.

        Their times are in milliseconds, and so the bounds are exact to a millisecond.
        """
        if not self._has_traffic():
            return np.empty(0, np.dtype([]))
        key = self._key(camera_id)
        rows = self._blocks("traffic_vehicle", "camera", key, start_ns, end_ns + LATE_NS)
        if not rows.dtype.names:
            return rows
        first_ms, last_ms = start_ns // 1_000_000, -(end_ns // -1_000_000)
        return np.asarray(rows[(rows["last_ms"] >= first_ms) & (rows["last_ms"] < last_ms)])

    def traffic_vehicle_count(self, camera_id: str) -> int:
        """How many rows `traffic_vehicles` has."""
        if not self._has_traffic():
            return 0
        key = self._key(camera_id)
        with self._lock, faults_as_sentences(self.path):
            (count,) = self._connection.execute(
                "SELECT coalesce(sum(row_count), 0) FROM traffic_vehicle WHERE camera = ?", (key,)
            ).fetchone()
        return int(count)

    def traffic_newest_vehicle(self, camera_id: str) -> int:
        """Number of the last vehicle; 0: there is none."""
        key = self._key(camera_id)
        with self._lock, faults_as_sentences(self.path):
            row = self._connection.execute(
                "SELECT data, row_count FROM traffic_vehicle WHERE camera = ?"
                " ORDER BY start_ns DESC LIMIT 1",
                (key,),
            ).fetchone()
            return 0 if row is None else int(decode_rows(*row)["vehicle_id"].max(initial=0))

    def traffic_map(self, series: SeriesName, at_ns: int) -> TrafficMap | None:
        """The map that the interval at a time was counted on; before the first one, that one."""
        key = self._series_key(series)
        with self._lock, faults_as_sentences(self.path):
            for where, order in (("start_ns <= ?", "DESC"), ("start_ns > ?", "ASC")):
                row = self._connection.execute(
                    "SELECT start_ns, stamp_ns, geojson FROM traffic_map"
                    f" WHERE series = ? AND {where} ORDER BY start_ns {order} LIMIT 1",
                    (key, at_ns),
                ).fetchone()
                if row is not None:
                    return TrafficMap(row[0], row[1], zlib.decompress(row[2]).decode())
        return None

    def lane_map_at(self, camera_id: str, at_ns: int) -> tuple[int, str] | None:
        """Stamp and text of the newest lane map not later than a time; else the first one."""
        with self._lock, faults_as_sentences(self.path):
            for where, order in (("stamp_ns <= ?", "DESC"), ("stamp_ns > ?", "ASC")):
                row = self._connection.execute(
                    "SELECT stamp_ns, geojson FROM lane_map JOIN camera ON camera.id = camera"
                    f" WHERE name = ? AND {where} ORDER BY stamp_ns {order} LIMIT 1",
                    (camera_id, at_ns),
                ).fetchone()
                if row is not None:
                    return row[0], zlib.decompress(row[1]).decode()
        return None

    def has_camera(self, camera_id: str) -> bool:
        """Whether anything is stored of a camera."""
        with self._lock, faults_as_sentences(self.path):
            found = self._connection.execute("SELECT 1 FROM camera WHERE name = ?", (camera_id,))
            return found.fetchone() is not None

    def _interval_rows(
        self, table: str, series: SeriesName, start_ns: int, end_ns: int
    ) -> NDArray[np.void]:
        rows = self._blocks(table, "series", self._series_key(series), start_ns, end_ns)
        if not rows.dtype.names:
            return rows
        begin, end = np.searchsorted(rows["start_ns"], (start_ns, max(start_ns, end_ns)))
        return rows[begin:end]

    def _end(self, key: int) -> int | None:
        if not key:
            return None
        row = self._connection.execute(
            "SELECT end_ns FROM traffic_interval WHERE series = ? ORDER BY start_ns DESC LIMIT 1",
            (key,),
        ).fetchone()
        return None if row is None else int(row[0])

    def _blocks(
        self, table: str, owner: str, key: int, start_ns: int, end_ns: int
    ) -> NDArray[np.void]:
        """Rows of all blocks that overlap a time."""
        if not key:
            return np.empty(0, np.dtype([]))
        with self._lock, faults_as_sentences(self.path):
            found = self._connection.execute(
                f"SELECT data, row_count FROM {table} WHERE {owner} = ?1 AND start_ns >= coalesce("
                f"(SELECT max(start_ns) FROM {table} WHERE {owner} = ?1 AND start_ns <= ?2), ?2)"
                " AND start_ns < ?3 ORDER BY start_ns",
                (key, start_ns, end_ns),
            )
            return joined(decode_tables(found.fetchall()))


class TrafficDatabase(EventWriter, TrafficReader):
    """Writes traffic tables; any number of processes may read meanwhile.

    Args:
        path: The SQLite file; made when missing, brought up to date when older.
    """

    def append_traffic(self, series: SeriesName, part: TrafficPart) -> None:
        """Store intervals that come after those that are stored, with their vehicles: all or none.

        Vehicles that another series of the camera has stored already are not stored again.

        Raises:
            InputFileError: An interval is there already.
        """
        camera = self._camera_key(series.camera_id)
        with self._lock, self._transaction():
            key = self._new_series(camera, series)
            end_ns = self._end(key)
            if end_ns is not None and part.start_ns < end_ns:
                found = f"an interval from {part.start_ns / 1e9:.0f} s of '{series.camera_id}'"
                expected = f"one from {end_ns / 1e9:.0f} s on: no interval is stored twice"
                raise InputFileError(str(self.path), found, expected)
            self._append_map(key, part.lane_map)
            self._append_rows("traffic_interval", key, part, part.rows)
            self._append_rows("traffic_movement", key, part, part.movements)
            self._append_vehicles(camera, part)

    def prune_traffic(self, camera_id: str, older_than_ns: int, limit: int = PRUNE_STEP) -> int:
        """Delete a camera's blocks that were last written before `older_than_ns`; see `prune`.

        Returns:
            How many blocks were deleted.
        """
        camera, deleted = self._camera_key(camera_id), 0
        with self._lock, self._transaction():
            series = self._connection.execute(
                "SELECT id FROM traffic_series WHERE camera = ?", (camera,)
            ).fetchall()
            for table in TABLES:
                owners = [camera] if AGEING[table][0] == "camera" else [key for (key,) in series]
                for owner in owners:
                    deleted += self._delete_old(table, owner, older_than_ns, limit)
        return deleted

    def _append_map(self, key: int, lane_map: TrafficMap) -> None:
        """Unless it is the one that is in use already."""
        row = self._connection.execute(
            "SELECT stamp_ns FROM traffic_map WHERE series = ? ORDER BY start_ns DESC LIMIT 1",
            (key,),
        ).fetchone()
        if row is None or row[0] != lane_map.stamp_ns:
            packed = zlib.compress(lane_map.geojson.encode())
            self._connection.execute(
                "INSERT INTO traffic_map (series, start_ns, stamp_ns, geojson) VALUES (?, ?, ?, ?)",
                (key, lane_map.start_ns, lane_map.stamp_ns, packed),
            )

    def _append_rows(self, table: str, key: int, part: TrafficPart, rows: NDArray[np.void]) -> None:
        """Into the last block while that isn't full."""
        last = self._connection.execute(
            f"SELECT id, start_ns, end_ns, intervals, row_count, data FROM {table}"
            " WHERE series = ? ORDER BY start_ns DESC LIMIT 1",
            (key,),
        ).fetchone()
        start_ns, intervals = part.start_ns, part.intervals
        if last is not None and _has_room(last[3], last[4]) and last[2] == part.start_ns:
            rows = joined([decode_rows(last[5], last[4]), rows])
            start_ns, intervals = last[1], last[3] + intervals
            self._connection.execute(f"DELETE FROM {table} WHERE id = ?", (last[0],))
        self._connection.execute(
            f"INSERT INTO {table}"
            " (series, start_ns, end_ns, intervals, row_count, data, stored_ns)"
            " VALUES (?, ?, ?, ?, ?, ?, ?)",
            (key, start_ns, part.end_ns, intervals, len(rows), encode_rows(rows), self._stored_ns),
        )

    def _append_vehicles(self, camera: int, part: TrafficPart) -> None:
        last = self._connection.execute(
            "SELECT id, start_ns, end_ns, row_count, data FROM traffic_vehicle"
            " WHERE camera = ? ORDER BY start_ns DESC LIMIT 1",
            (camera,),
        ).fetchone()
        start_ns, rows = part.start_ns, part.vehicles
        if last is not None and last[2] > start_ns:
            start_ns = last[2]
            rows = _of_vehicles_after(rows, start_ns)
        if part.end_ns <= start_ns or not len(rows):
            return
        if last is not None and _has_room(0, last[3]):
            rows, start_ns = joined([decode_rows(last[4], last[3]), rows]), last[1]
            self._connection.execute("DELETE FROM traffic_vehicle WHERE id = ?", (last[0],))
        self._connection.execute(
            "INSERT INTO traffic_vehicle (camera, start_ns, end_ns, row_count, data, stored_ns)"
            " VALUES (?, ?, ?, ?, ?, ?)",
            (camera, start_ns, part.end_ns, len(rows), encode_rows(rows), self._stored_ns),
        )


def _of_vehicles_after(rows: NDArray[np.void], stamp_ns: int) -> NDArray[np.void]:
    """The rows of vehicles that were last seen at a time or later."""
    _, vehicle = np.unique(rows["vehicle_id"], return_inverse=True)
    last = np.full(int(vehicle.max(initial=-1)) + 1, _MIN_NS)
    np.maximum.at(last, vehicle, rows["last_ms"])
    return np.asarray(rows[last[vehicle] >= stamp_ns // 1_000_000])


def _has_room(intervals: int, rows: int) -> bool:
    return intervals < BLOCK_INTERVALS and rows < BLOCK_ROWS
