"""Tracked boxes as CSV: `id,time,frame_num,class,conf,x,y,w,h`, one row per box and frame.

`x,y` is the box centre in pixels; `w = h = 0` means that the point is already on the ground. `time`
is in seconds. Rows of one frame stand together, frames in time order. A stable interface: other
trackers write it, other tools read it.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
import pyarrow.compute as pc
import pyarrow.csv as pacsv
from numpy.typing import NDArray

from geoorbit_ros.core.errors import TableError
from geoorbit_ros.core.tables import (
    FLAG_GROUND_POINT,
    PIXEL_TRACK_DTYPE,
    Frames,
    first_bad_box,
    first_repeated_id,
)
from geoorbit_ros.storage.atomic import atomic_output
from geoorbit_ros.storage.csv_columns import CsvColumns, read_columns

_TYPES = {
    "id": pa.float64(),  # trackers write '12' and '12.0'; float64 takes both and is exact
    "time": pa.float64(),
    "frame_num": pa.float64(),
    "class": pa.float64(),
    "conf": pa.float32(),
    "x": pa.float32(),
    "y": pa.float32(),
    "w": pa.float32(),
    "h": pa.float32(),
}
_EXACT_TIME_S = 2e6
"""Above this a float64 of seconds can be half a nanosecond off (2^51 ns)."""
_MAX_TIME_S = 2**31
"""builtin_interfaces/Time holds seconds in 32 bits."""
_TIME_RANGE = "seconds in [0, 2^31)"


def read_track_csv(path: str | Path, image_size: tuple[int, int] | None = None) -> Frames:
    """Read tracked boxes.

    Args:
        path: The CSV file; more columns than the nine are ignored, in any order.
        image_size: (width, height) of the image in pixels, to refuse boxes that lie outside of it.

    Returns:
        `PIXEL_TRACK_DTYPE` rows in file order; stamp = round(time * 1e9) ns, `FLAG_GROUND_POINT`
        where w = h = 0.

    Raises:
        InputFileError: Names file, line, column and value.
    """
    columns = read_columns(path, _TYPES, "a CSV file of tracks")
    v = columns.values
    # A float64 just below 2^31 may round up to it: the bound is checked again on exact stamps.
    _check(columns, "time", (v["time"] >= 0) & (v["time"] <= _MAX_TIME_S), _TIME_RANGE)
    _check(columns, "frame_num", _whole(v["frame_num"], 0, 2**53), "a whole number from 0")
    for name in ("id", "class"):
        _check(columns, name, _whole(v[name], -(2**31), 2**31 - 1), "a whole number of 32 bits")
    for name in ("w", "h"):
        _check(columns, name, v[name] >= 0, "a size in pixels, not negative")
    ground = v["w"] == 0
    both = np.where(ground, v["h"] == 0, v["h"] > 0)
    _check(columns, "h", both, "w and h both positive, or both 0 for a point on the ground")
    if image_size is not None:
        for name, size, limit in (("x", "w", image_size[0]), ("y", "h", image_size[1])):
            inside = (v[name] + v[size] / 2 >= 0) & (v[name] - v[size] / 2 <= limit)
            at = f"a box that reaches into the image of {image_size[0]}x{image_size[1]} pixels"
            _check(columns, name, inside, at)
    stamp_ns = _stamps(columns)
    _check(columns, "time", stamp_ns < _MAX_TIME_S * 10**9, _TIME_RANGE)
    start = _frame_starts(columns, stamp_ns)
    rows = np.empty(len(stamp_ns), PIXEL_TRACK_DTYPE)
    for field, name in (("x", "x"), ("y", "y"), ("width", "w"), ("height", "h"), ("score", "conf")):
        rows[field] = v[name]
    rows["class_id"], rows["track_id"] = v["class"], v["id"]
    rows["flags"] = np.where(ground, FLAG_GROUND_POINT, 0)
    offset = np.append(start, len(rows)).astype(np.int64)
    frames = Frames(stamp_ns[start], offset, rows)
    again = first_repeated_id(frames)
    if again is not None:
        found = f"id {rows['track_id'][again]} twice in one frame"
        columns.fail(again, "id", "every id at most once in a frame", found)
    return frames


def write_track_csv(path: str | Path, frames: Frames) -> None:
    """Write what `read_track_csv` reads back to the same bits.

    Two things have no place in this format and are lost: frames without a row, and flags other
    than `FLAG_GROUND_POINT`.

    Raises:
        TableError: Rows of another type, or a box that the reader would refuse.
    """
    rows = frames.rows
    if rows.dtype != PIXEL_TRACK_DTYPE:
        raise TableError(f"{path}, rows to write", rows.dtype.names, "the fields of tracks_px")
    ground = (rows["flags"] & FLAG_GROUND_POINT) != 0
    k = first_bad_box(rows)
    if k is None:
        flat = ~ground & ((rows["width"] == 0) | (rows["height"] == 0))
        k = int(np.argmax(flat)) if flat.any() else None
    if k is not None:
        raise TableError(f"{path}, row {k} to write", rows[k], "finite numbers, a size above 0")
    number = np.repeat(np.arange(len(frames)), np.diff(frames.offset))
    # Decimal text, because a float64 of seconds since 1970 is exact to 0.2 microseconds only.
    seconds = [f"{s // 10**9}.{s % 10**9:09d}" for s in frames.stamp_ns.tolist()]
    table = pa.table(
        {
            "id": rows["track_id"],
            "time": pa.array(seconds, pa.string()).take(pa.array(number)),
            "frame_num": number,
            "class": rows["class_id"],
            "conf": rows["score"],
            "x": rows["x"],
            "y": rows["y"],
            "w": np.where(ground, np.float32(0), rows["width"]),
            "h": np.where(ground, np.float32(0), rows["height"]),
        }
    )
    with atomic_output(path) as temporary, temporary.open("wb") as file:
        file.write((",".join(_TYPES) + "\n").encode())
        options = pacsv.WriteOptions(include_header=False, quoting_style="none")
        pacsv.write_csv(table, file, options)


def _check(columns: CsvColumns, name: str, good: NDArray[np.bool_], expected: str) -> None:
    if not good.all():
        columns.fail(int(np.argmin(good)), name, expected)


def _whole(values: NDArray[Any], low: float, high: float) -> NDArray[np.bool_]:
    good: NDArray[np.bool_] = (values == np.rint(values)) & (values >= low) & (values <= high)
    return good


def _stamps(columns: CsvColumns) -> NDArray[np.int64]:
    """(N,) nanoseconds; late times (a Unix epoch) are read again as exact decimals."""
    time = columns.values["time"]
    if time.max() >= _EXACT_TIME_S:
        layout = pacsv.ReadOptions(column_names=list(columns.names), skip_rows=columns.header_line)
        options = pacsv.ConvertOptions(
            column_types={"time": pa.decimal128(38, 18)}, include_columns=["time"]
        )
        try:
            table = pacsv.read_csv(columns.path, read_options=layout, convert_options=options)
        except pa.ArrowInvalid:
            # More digits than the decimal holds: such a text came from a float64 anyway.
            return np.rint(time * 1e9).astype(np.int64)
        exact = pc.round(table["time"].combine_chunks(), 9).cast(pa.decimal128(19, 9))
        words = np.frombuffer(exact.buffers()[1], np.int64)
        return words[2 * exact.offset :: 2][: len(exact)].copy()
    return np.rint(time * 1e9).astype(np.int64)


def _frame_starts(columns: CsvColumns, stamp_ns: NDArray[np.int64]) -> NDArray[np.intp]:
    """Index of each frame's first row, after checking that frames and times go forward together."""
    time, frame = columns.values["time"], columns.values["frame_num"]
    later, next_frame = np.diff(stamp_ns), np.diff(frame)
    wrong = (np.sign(later) != np.sign(next_frame)) | (later < 0)
    if wrong.any():
        k = int(np.argmax(wrong))
        before = f"frame {frame[k]:.0f} at {time[k]:.9f} s"
        here = f"frame {frame[k + 1]:.0f} at {time[k + 1]:.9f} s after {before}"
        if later[k] < 0:
            columns.fail(k + 1, "time", "rows in time order", here)
        if next_frame[k] == 0:
            columns.fail(k + 1, "time", "one time for all rows of a frame", here)
        if later[k] == 0:
            columns.fail(k + 1, "time", "a later time for another frame", here)
        columns.fail(k + 1, "frame_num", "frame numbers that go up with time", here)
    return np.append(0, np.flatnonzero(later) + 1)
