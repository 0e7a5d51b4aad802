"""The trajectory database's layout: SQLite schema, versions, faults as sentences, blocks of rows.

A batch is about a second of ground tracks as one compressed block of bytes: stamps (int64), rows
per frame (uint32) and rows (`TRACK_DTYPE`), each with its bytes transposed so that the slowly
changing ones stand together (the shuffle filter of HDF5), then zlib. On real tracks it takes 30
bytes per row of 48, where a SQLite row per vehicle takes 112.
"""

from __future__ import annotations

import json
import os
import sqlite3
import zlib
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from geoorbit_ros.core.errors import InputFileError
from geoorbit_ros.core.tables import TRACK_DTYPE, Frames

APPLICATION_ID = 0x47654F72
"""ASCII "GeOr", as file(1) and PRAGMA application_id show it."""
MAX_BATCH_SPAN_NS = 1_000_000_000
"""No batch of frames is longer: readers rely on it to find the batch that holds a time. Chosen:
longer reads more than was asked for; it can not shrink without a new version."""
BUSY_TIMEOUT_S = 5.0
"""How long to wait for another process's transaction. Chosen: those of this package take
milliseconds; longer keeps a node waiting behind a stuck process."""
_WAL_LIMIT_BYTES = 16_000_000
"""Size to which the write-ahead log is cut after a checkpoint. Chosen: smaller is cut and grown
again every few seconds, larger fills the disk."""
_WRITER_CACHE_KB = 256
"""Writing at the end touches few pages. SQLite's 2 MB would be filled with old ones over minutes,
in each of a thousand recorders."""

AGEING = {
    "track_batch": ("camera", "end_ns"),
    "lane_map": ("camera", "stamp_ns"),
    "view_event": ("camera", "end_ns"),
    "traffic_interval": ("series", "end_ns"),
    "traffic_vehicle": ("camera", "end_ns"),
    "traffic_movement": ("series", "end_ns"),
    "traffic_event": ("series", "end_ns"),
}
"""Tables of which old rows are deleted, with the column that says whose they are, and the stamp
that says how old those are that were stored before version 5. Part of a released script."""

MIGRATIONS: tuple[str, ...] = (
    # 1: The index over five columns answers what is in the file without touching a block.
    """
    CREATE TABLE camera (
        id INTEGER PRIMARY KEY,
        name TEXT NOT NULL UNIQUE
    );
    CREATE TABLE track_batch (
        id INTEGER PRIMARY KEY,
        camera INTEGER NOT NULL REFERENCES camera (id),
        start_ns INTEGER NOT NULL,
        end_ns INTEGER NOT NULL,
        frames INTEGER NOT NULL,
        row_count INTEGER NOT NULL,
        data BLOB NOT NULL,
        UNIQUE (camera, start_ns)
    );
    CREATE INDEX track_batch_content
        ON track_batch (camera, start_ns, end_ns, frames, row_count);
    CREATE INDEX track_batch_age ON track_batch (end_ns);
    CREATE TABLE lane_map (
        id INTEGER PRIMARY KEY,
        camera INTEGER NOT NULL REFERENCES camera (id),
        stamp_ns INTEGER NOT NULL,
        geojson BLOB NOT NULL,
        UNIQUE (camera, stamp_ns)
    );
    CREATE INDEX lane_map_age ON lane_map (stamp_ns);
    """,
    # 2: Traffic per lane. A block has about a hundred intervals, so that a camera's year is read in
    # 365 steps; its columns answer what is in the file without touching it.
    """
    CREATE TABLE traffic_series (
        id INTEGER PRIMARY KEY,
        camera INTEGER NOT NULL REFERENCES camera (id),
        length_s INTEGER NOT NULL,
        zone TEXT NOT NULL,
        scheme TEXT NOT NULL,
        UNIQUE (camera, length_s, zone, scheme)
    );
    CREATE TABLE traffic_interval (
        id INTEGER PRIMARY KEY,
        series INTEGER NOT NULL REFERENCES traffic_series (id),
        start_ns INTEGER NOT NULL,
        end_ns INTEGER NOT NULL,
        intervals INTEGER NOT NULL,
        row_count INTEGER NOT NULL,
        data BLOB NOT NULL,
        UNIQUE (series, start_ns)
    );
    CREATE INDEX traffic_interval_content
        ON traffic_interval (series, start_ns, end_ns, intervals, row_count);
    CREATE INDEX traffic_interval_age ON traffic_interval (end_ns);
    CREATE TABLE traffic_vehicle (
        id INTEGER PRIMARY KEY,
        camera INTEGER NOT NULL REFERENCES camera (id),
        start_ns INTEGER NOT NULL,
        end_ns INTEGER NOT NULL,
        row_count INTEGER NOT NULL,
        data BLOB NOT NULL,
        UNIQUE (camera, start_ns)
    );
    CREATE INDEX traffic_vehicle_content
        ON traffic_vehicle (camera, start_ns, end_ns, row_count);
    CREATE INDEX traffic_vehicle_age ON traffic_vehicle (end_ns);
    CREATE TABLE traffic_map (
        id INTEGER PRIMARY KEY,
        series INTEGER NOT NULL REFERENCES traffic_series (id),
        start_ns INTEGER NOT NULL,
        stamp_ns INTEGER NOT NULL,
        geojson BLOB NOT NULL,
        UNIQUE (series, start_ns)
    );
    """,
    # 3: Movements beside the intervals; what was told of events, in numbered rows, and how far.
    """
    CREATE TABLE traffic_movement (
        id INTEGER PRIMARY KEY,
        series INTEGER NOT NULL REFERENCES traffic_series (id),
        start_ns INTEGER NOT NULL,
        end_ns INTEGER NOT NULL,
        intervals INTEGER NOT NULL,
        row_count INTEGER NOT NULL,
        data BLOB NOT NULL,
        UNIQUE (series, start_ns)
    );
    CREATE INDEX traffic_movement_age ON traffic_movement (end_ns);
    CREATE TABLE traffic_event (
        id INTEGER PRIMARY KEY,
        series INTEGER NOT NULL REFERENCES traffic_series (id),
        first_row INTEGER NOT NULL,
        start_ns INTEGER NOT NULL,
        end_ns INTEGER NOT NULL,
        row_count INTEGER NOT NULL,
        data BLOB NOT NULL,
        UNIQUE (series, first_row)
    );
    CREATE INDEX traffic_event_age ON traffic_event (end_ns);
    CREATE TABLE traffic_watch (
        series INTEGER PRIMARY KEY REFERENCES traffic_series (id),
        stamp_ns INTEGER NOT NULL,
        row_count INTEGER NOT NULL,
        data BLOB NOT NULL
    );
    """,
    # 4: What happened to a camera's view, a row for each time in which it was in one state.
    """
    CREATE TABLE view_event (
        id INTEGER PRIMARY KEY,
        camera INTEGER NOT NULL REFERENCES camera (id),
        start_ns INTEGER NOT NULL,
        end_ns INTEGER NOT NULL,
        state TEXT NOT NULL,
        blindness TEXT NOT NULL,
        view INTEGER NOT NULL,
        moved_px REAL NOT NULL,
        right_px REAL NOT NULL,
        down_px REAL NOT NULL,
        sway_px REAL NOT NULL,
        found_s REAL NOT NULL,
        UNIQUE (camera, start_ns)
    );
    CREATE INDEX view_event_age ON view_event (end_ns);
    """,
    # 5: When rows were stored, by this computer's clock: what a stamp says deletes nothing.
    "".join(
        f"ALTER TABLE {table} ADD COLUMN stored_ns INTEGER; DROP INDEX {table}_age;"
        f" CREATE INDEX {table}_age ON {table} ({owner}, coalesce(stored_ns, {ended}));"
        for table, (owner, ended) in AGEING.items()
    ).rstrip(";"),
)
"""Script k brings a database of version k to k + 1. Never change one that was released: add.
Scripts add tables, and columns that only writers ask for: readers take older files, too, and find
those tables empty."""


@contextmanager
def faults_as_sentences(path: Path) -> Iterator[None]:
    """Turn SQLite's errors into one sentence about the file.

    Raises:
        InputFileError: Instead of a `sqlite3.Error`, or of what a damaged block raises.
    """
    try:
        yield
    except (sqlite3.Error, zlib.error, ValueError) as error:
        raise InputFileError(str(path), str(error), "a sound trajectory database") from error


def connect(
    path: Path, *, read_only: bool, migrations: Sequence[str] = MIGRATIONS
) -> sqlite3.Connection:
    """Open a trajectory database, made or brought up to date first unless `read_only`.

    WAL mode: readers see committed batches while a writer goes on. With synchronous=NORMAL a commit
    is in the operating system's hands, so a killed process loses nothing committed; only power loss
    can cost commits since the last checkpoint, and it never damages the file
    (https://sqlite.org/wal.html, https://sqlite.org/pragma.html#pragma_synchronous).

    Raises:
        InputFileError: No such file (when reading), something else, damaged, locked, or written by
            a newer version.
    """
    if read_only and not path.is_file():
        raise InputFileError(str(path), "no such file", "a trajectory database")
    with faults_as_sentences(path):
        connection = sqlite3.connect(
            f"{path.absolute().as_uri()}?mode={_mode(path, read_only=read_only)}",
            uri=True,
            timeout=BUSY_TIMEOUT_S,
            isolation_level=None,
            check_same_thread=False,  # the owner holds a lock
        )
        try:
            version = _check(connection, path, len(migrations), read_only)
            if not read_only:
                _prepare(connection, path, fresh=version == 0)
                _migrate(connection, migrations)
        except BaseException:
            connection.close()
            raise
    return connection


def _mode(path: Path, *, read_only: bool) -> str:
    """How SQLite opens the file.

    Readers share memory with writers in a file beside it. Where none can be made (a read-only disk,
    another user's folder) and nothing waits in the write-ahead log, nobody writes either, and the
    file is read as it is (https://sqlite.org/wal.html, "Read-Only Databases").
    """
    if not read_only:
        return "rwc"
    log, shared = (path.with_name(path.name + end) for end in ("-wal", "-shm"))
    waiting = log.exists() and log.stat().st_size > 0
    if os.access(path.absolute().parent, os.W_OK) or waiting or shared.exists():
        return "ro"
    return "ro&immutable=1"


def _value(connection: sqlite3.Connection, pragma: str) -> int:
    return int(connection.execute(f"PRAGMA {pragma}").fetchone()[0])


def _check(connection: sqlite3.Connection, path: Path, latest: int, read_only: bool) -> int:
    """The file's schema version, 0 for an empty file that may become a database."""
    connection.execute("BEGIN")  # one state of the file, should another process be making it
    version = _value(connection, "user_version")
    foreign = _value(connection, "application_id") != APPLICATION_ID
    empty = _value(connection, "schema_version") == 0
    connection.execute("COMMIT")
    if (foreign and not empty) or (empty and read_only):
        found = "an empty file" if empty else "a SQLite database of another program"
        raise InputFileError(str(path), found, "a trajectory database")
    if version > latest:
        raise InputFileError(
            str(path),
            f"schema version {version}, written by a newer geoorbit",
            f"version {latest} or older",
        )
    return version


def _prepare(connection: sqlite3.Connection, path: Path, *, fresh: bool) -> None:
    if fresh:  # only possible before the first table
        connection.execute("PRAGMA auto_vacuum = INCREMENTAL")
    (mode,) = connection.execute("PRAGMA journal_mode = WAL").fetchone()
    if mode != "wal":
        raise InputFileError(
            str(path), f"a file system where SQLite uses journal mode '{mode}'", "a local disk"
        )
    connection.execute("PRAGMA synchronous = NORMAL")
    connection.execute("PRAGMA foreign_keys = ON")
    connection.execute(f"PRAGMA journal_size_limit = {_WAL_LIMIT_BYTES}")
    connection.execute(f"PRAGMA cache_size = -{_WRITER_CACHE_KB}")


def _migrate(connection: sqlite3.Connection, migrations: Sequence[str]) -> None:
    """Run the missing scripts, all or none; another process that does the same waits."""
    connection.execute("BEGIN IMMEDIATE")
    try:
        for script in migrations[_value(connection, "user_version") :]:
            for statement in script.split(";"):  # executescript() would commit in between
                connection.execute(statement)
        connection.execute(f"PRAGMA application_id = {APPLICATION_ID}")
        connection.execute(f"PRAGMA user_version = {len(migrations)}")
        connection.execute("COMMIT")
    except BaseException:
        connection.execute("ROLLBACK")
        raise


_STAMP = np.dtype("<i8")
_COUNT = np.dtype("<u4")
_LEVEL = 1
"""Of zlib. Measured: level 6 takes half as long again for 3 % less."""


_ROWS_LEVEL = 6
"""Of zlib for tables that are kept for years. Measured: a fifth smaller than level 1."""


def encode_batch(stamp_ns: Sequence[int], tables: Sequence[NDArray[np.void]]) -> bytes:
    """Pack one `TRACK_DTYPE` table per stamp."""
    return zlib.compress(
        _transposed(np.array(stamp_ns, _STAMP))
        + _transposed(np.array([len(table) for table in tables], _COUNT))
        + _transposed(np.concatenate(tables)),
        _LEVEL,
    )


def decode_batch(data: bytes, frames: int, rows: int) -> Frames:
    """Unpack a batch of `frames` stamps and `rows` rows.

    Raises:
        ValueError, zlib.error: Bytes that are no such batch.
    """
    raw = np.frombuffer(zlib.decompress(data), np.uint8)
    ends = np.cumsum([frames * _STAMP.itemsize, frames * _COUNT.itemsize])
    if len(raw) != ends[1] + rows * TRACK_DTYPE.itemsize:
        raise ValueError(f"{len(raw)} bytes for {frames} frames of {rows} rows")
    stamp, count, table = np.split(raw, ends)
    offset = np.zeros(frames + 1, np.int64)
    np.cumsum(_restored(count, _COUNT), out=offset[1:])
    if offset[-1] != rows:
        raise ValueError(f"frames of {offset[-1]} rows instead of {rows}")
    return Frames(_restored(stamp, _STAMP), offset, _restored(table, TRACK_DTYPE))


def encode_rows(rows: NDArray[np.void]) -> bytes:
    """Pack a table of little-endian numbers together with the names and types of its columns."""
    head = json.dumps([list(column) for column in rows.dtype.descr]).encode()
    raw = len(head).to_bytes(4, "little") + head + _transposed(np.ascontiguousarray(rows))
    return zlib.compress(raw, _ROWS_LEVEL)


def decode_rows(data: bytes, rows: int) -> NDArray[np.void]:
    """Unpack what `encode_rows` packed.

    Raises:
        ValueError, zlib.error: Bytes that are no such table of `rows` rows.
    """
    dtype, planes = _planes(data, rows)
    return _restored(planes, dtype)


def decode_tables(packed: Sequence[tuple[bytes, int]]) -> list[NDArray[np.void]]:
    """Unpack many tables, each with its number of rows; those of the same columns become one.

    Raises:
        ValueError, zlib.error: See `decode_rows`.
    """
    groups = list[tuple[np.dtype[np.void], list[NDArray[np.uint8]]]]()
    for data, rows in packed:
        dtype, planes = _planes(data, rows)
        if not groups or groups[-1][0] != dtype:
            groups.append((dtype, []))
        groups[-1][1].append(planes)
    return [_side_by_side(dtype, parts) for dtype, parts in groups]


def _side_by_side(dtype: np.dtype[np.void], parts: list[NDArray[np.uint8]]) -> NDArray[np.void]:
    """Tables below one another; each byte is copied once."""
    size = dtype.itemsize
    out = np.empty((sum(len(part) for part in parts) // size, size), np.uint8)
    begin = 0
    for part in parts:
        end = begin + len(part) // size
        out[begin:end] = part.reshape(size, -1).T
        begin = end
    return out.view(dtype).ravel()


def _planes(data: bytes, rows: int) -> tuple[np.dtype[np.void], NDArray[np.uint8]]:
    """Columns and bytes of a packed table."""
    raw = zlib.decompress(data)
    end = 4 + int.from_bytes(raw[:4], "little")
    try:
        dtype = np.dtype([(str(name), str(kind)) for name, kind in json.loads(raw[4:end])])
    except (TypeError, ValueError) as error:
        raise ValueError(f"columns that can't be read: {error}") from None
    if dtype.itemsize == 0 or len(raw) - end != rows * dtype.itemsize:
        raise ValueError(f"{len(raw) - end} bytes for {rows} rows of {dtype.itemsize}")
    return dtype, np.frombuffer(raw, np.uint8, offset=end)


def _transposed(values: NDArray[Any]) -> bytes:
    return values.view(np.uint8).reshape(len(values), values.dtype.itemsize).T.tobytes()


def _restored(raw: NDArray[np.uint8], dtype: np.dtype[Any]) -> NDArray[Any]:
    return np.ascontiguousarray(raw.reshape(dtype.itemsize, -1).T).view(dtype).ravel()
