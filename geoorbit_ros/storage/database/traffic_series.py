"""Which traffic is stored in a trajectory database: series of intervals of a camera.

A series is one camera's intervals of one length, on one clock, for one set of classes.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from geoorbit_ros.storage.database.reader import TrajectoryReader
from geoorbit_ros.storage.database.schema import faults_as_sentences
from geoorbit_ros.storage.database.writer import TrajectoryDatabase


@dataclass(frozen=True, slots=True)
class SeriesName:
    """Which intervals of a camera.

    Attributes:
        camera_id: Whose.
        length_s: Their length.
        zone: IANA name of the time zone on whose clock they end.
        scheme: The classes of vehicles, as `traffic.class_schemes` writes them.
    """

    camera_id: str
    length_s: int
    zone: str
    scheme: str


@dataclass(frozen=True, slots=True)
class SeriesContent:
    """What is stored of a series: begin of the first and end of the last interval; how many."""

    name: SeriesName
    start_ns: int
    end_ns: int
    intervals: int
    rows: int


class SeriesReader(TrajectoryReader):
    """The series of a database. Files of version 1 have none."""

    def traffic_series(self, camera_id: str | None = None) -> tuple[SeriesContent, ...]:
        """What is stored, by camera, length, zone and scheme."""
        if not self._has_traffic():
            return ()
        with self._lock, faults_as_sentences(self.path):
            found = self._connection.execute(
                "SELECT name, length_s, zone, scheme, min(start_ns), max(end_ns), sum(intervals),"
                " sum(row_count) FROM traffic_series JOIN camera ON camera.id = camera"
                " JOIN traffic_interval ON series = traffic_series.id"
                " WHERE ?1 IS NULL OR name = ?1"
                " GROUP BY traffic_series.id ORDER BY name, length_s, zone, scheme",
                (camera_id,),
            ).fetchall()
        return tuple(SeriesContent(SeriesName(*row[:4]), *row[4:]) for row in found)

    @property
    def version(self) -> int:
        """Version of the file's layout; see `schema.MIGRATIONS`."""
        with self._lock, faults_as_sentences(self.path):
            return int(self._connection.execute("PRAGMA user_version").fetchone()[0])

    def _has_traffic(self) -> bool:
        return self.version > 1

    def _series_key(self, series: SeriesName) -> int:
        """0 where nothing is stored."""
        if not self._has_traffic():
            return 0
        with self._lock, faults_as_sentences(self.path):
            row = self._connection.execute(
                "SELECT traffic_series.id FROM traffic_series JOIN camera ON camera.id = camera"
                " WHERE name = ? AND length_s = ? AND zone = ? AND scheme = ?",
                (series.camera_id, series.length_s, series.zone, series.scheme),
            ).fetchone()
        return 0 if row is None else int(row[0])


class SeriesWriter(TrajectoryDatabase, SeriesReader):
    """Adds series."""

    def _camera_key(self, camera_id: str) -> int:
        return (self._cameras.get(camera_id) or self._camera(camera_id)).key

    def _new_series(self, camera: int, series: SeriesName) -> int:
        """Key of a camera's series, which is added if it is not there; within a transaction."""
        values = (camera, series.length_s, series.zone, series.scheme)
        self._connection.execute(
            "INSERT OR IGNORE INTO traffic_series (camera, length_s, zone, scheme)"
            " VALUES (?, ?, ?, ?)",
            values,
        )
        (key,) = self._connection.execute(
            "SELECT id FROM traffic_series WHERE camera = ? AND length_s = ? AND zone = ?"
            " AND scheme = ?",
            values,
        ).fetchone()
        return int(key)


def joined(tables: Sequence[NDArray[np.void]]) -> NDArray[np.void]:
    """Tables below one another, with the columns that all of them have."""
    if not tables:
        return np.empty(0, np.dtype([]))
    if len(tables) == 1:
        return tables[0]
    if all(table.dtype == tables[0].dtype for table in tables):
        return np.concatenate(tables)
    names = [
        name
        for name in tables[-1].dtype.names or ()
        if all(name in (table.dtype.names or ()) for table in tables)
    ]
    dtype = np.dtype([(name, tables[-1].dtype[name]) for name in names])
    return np.concatenate([table[names].astype(dtype) for table in tables])
