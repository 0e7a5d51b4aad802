"""Stored ground tracks as CSV or Parquet, piece by piece: memory does not grow with the file.

One row per vehicle and frame, ordered by camera and time; a stable interface: `COLUMNS`.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from contextlib import AbstractContextManager
from pathlib import Path
from typing import Protocol

import numpy as np
import pyarrow as pa
import pyarrow.compute as pc
import pyarrow.csv as pacsv
import pyarrow.parquet as pq
from numpy.typing import NDArray

from geoorbit_ros.core.errors import ParameterError
from geoorbit_ros.core.tables import Frames
from geoorbit_ros.storage.atomic import atomic_output
from geoorbit_ros.storage.database.reader import TrajectoryReader

COLUMNS = {
    "x_m": "x",
    "y_m": "y",
    "vx_mps": "vx",
    "vy_mps": "vy",
    "heading_rad": "heading",
    "length_m": "length",
    "width_m": "width",
    "score": "score",
    "sigma_m": "sigma",
    "class_id": "class_id",
    "flags": "flags",
}
"""Exported column and `TRACK_DTYPE` field, after `camera_id`, `stamp_ns` and `track_id`."""

PLACE_COLUMNS = {
    "latitude_deg": pa.float64(),
    "longitude_deg": pa.float64(),
    "lane_id": pa.int32(),
    "lane_number": pa.int32(),
}
"""Exported columns that a lane map is needed for, at the end; empty where there is none."""

_INTEGERS = {"class_id": pa.int32(), "flags": pa.uint32()}
SCHEMA = pa.schema(
    [
        ("camera_id", pa.string()),
        ("stamp_ns", pa.int64()),
        ("track_id", pa.int32()),
        *((name, _INTEGERS.get(name, pa.float32())) for name in COLUMNS),
        ("local_time", pa.string()),
        *PLACE_COLUMNS.items(),
    ]
)
_ROW_GROUP = 128_000
"""Rows written at once. Chosen: about 7 MB, and large enough for Parquet to compress well."""


Describe = Callable[[str, Frames], Mapping[str, NDArray[np.float64]]]
"""Camera id and frames to the `PLACE_COLUMNS` (N,) of their rows, NaN where not known."""


class _TableWriter(AbstractContextManager["_TableWriter"], Protocol):
    def write_table(self, table: pa.Table) -> None: ...


def export_tracks(
    database: TrajectoryReader,
    out: str | Path,
    camera_ids: Sequence[str] = (),
    start_ns: int | None = None,
    end_ns: int | None = None,
    progress: Callable[[int], None] | None = None,
    describe: Describe | None = None,
    timezone: str = "UTC",
) -> int:
    """Write the frames with start_ns <= stamp < end_ns to a new file; all of it or none.

    Args:
        database: Where from; it may be written meanwhile.
        out: Ends in `.csv` or `.parquet`. NaN (a heading not known yet) is empty in CSV, null in
            Parquet.
        camera_ids: Which cameras, in that order; default: all by name.
        start_ns: Default: the beginning.
        end_ns: Default: the end.
        progress: Called with the number of rows written so far.
        describe: Where on Earth and in which lane rows are; default: empty columns.
        timezone: IANA name of the zone of `local_time` (ISO 8601, milliseconds, with offset).

    Returns:
        Number of rows.

    Raises:
        ParameterError: Another suffix, or a camera that is not in the database.
        InputFileError: The database is damaged, or `out` can't be written.
    """
    writers: dict[str, Callable[[Path], _TableWriter]] = {
        ".csv": lambda path: pacsv.CSVWriter(
            path, SCHEMA, write_options=pacsv.WriteOptions(quoting_header="none")
        ),
        ".parquet": lambda path: pq.ParquetWriter(path, SCHEMA, compression="zstd"),
    }
    make = writers.get(Path(out).suffix.lower())
    if make is None:
        raise ParameterError("export file", f"'{Path(out).name}'", "a name in .csv or .parquet")
    cameras = camera_ids or [content.camera_id for content in database.cameras()]
    rows = 0
    with atomic_output(out) as temporary, make(temporary) as writer:
        for camera_id in cameras:
            batches = (
                _record_batch(camera_id, frames, describe, timezone)
                for frames in database.batches(camera_id, start_ns, end_ns)
            )
            for table in _tables(batches):
                writer.write_table(table)
                rows += table.num_rows
                if progress is not None:
                    progress(rows)
    return rows


def _tables(batches: Iterable[pa.RecordBatch]) -> Iterator[pa.Table]:
    """Batches gathered to tables of about `_ROW_GROUP` rows."""
    waiting: list[pa.RecordBatch] = []
    for batch in batches:
        waiting.append(batch)
        if sum(batch.num_rows for batch in waiting) >= _ROW_GROUP:
            yield pa.Table.from_batches(waiting, SCHEMA).combine_chunks()
            waiting = []
    if waiting:
        yield pa.Table.from_batches(waiting, SCHEMA).combine_chunks()


def _record_batch(
    camera_id: str, frames: Frames, describe: Describe | None, timezone: str
) -> pa.RecordBatch:
    rows = frames.rows
    stamps = frames.row_stamp_ns()
    unknown = np.full(len(rows), np.nan)
    places = describe(camera_id, frames) if describe else dict.fromkeys(PLACE_COLUMNS, unknown)
    columns = [
        pa.repeat(pa.scalar(camera_id), len(rows)),
        pa.array(stamps),
        pa.array(rows["track_id"]),
        *(pa.array(rows[source], from_pandas=True) for source in COLUMNS.values()),
        _local_time(stamps, timezone),
        *(pa.array(places[k], from_pandas=True).cast(kind) for k, kind in PLACE_COLUMNS.items()),
    ]
    return pa.record_batch(columns, schema=SCHEMA)


def _local_time(stamps_ns: NDArray[np.int64], timezone: str) -> pa.Array:
    """ISO 8601 texts such as 2026-05-01T08:00:00.040+02:00."""
    moments = pa.array(stamps_ns // 1_000_000, pa.timestamp("ms", timezone))
    text = pc.strftime(moments, "%Y-%m-%dT%H:%M:%S%z")
    return pc.replace_substring_regex(text, r"(\d\d)$", r":\1")
