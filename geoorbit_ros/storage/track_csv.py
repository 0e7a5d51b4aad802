"""Tracked boxes as geoorbit's own CSV: `id,time,frame_num,class,conf,x,y,w,h`, a row per box.

`x,y` is the box centre in pixels; `w = h = 0` means that the point is already on the ground. `time`
is in seconds. Rows of one frame stand together, frames in time order. A stable interface: other
trackers write it, other tools read it.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pyarrow as pa
import pyarrow.csv as pacsv

from geoorbit_ros.core.errors import TableError
from geoorbit_ros.core.tables import FLAG_GROUND_POINT, PIXEL_TRACK_DTYPE, Frames, first_bad_box
from geoorbit_ros.storage.atomic import atomic_output
from geoorbit_ros.storage.tracks.cleaning import ReadOptions
from geoorbit_ros.storage.tracks.reader import read_tracks

COLUMNS = ("id", "time", "frame_num", "class", "conf", "x", "y", "w", "h")


def read_track_csv(path: str | Path, image_size: tuple[int, int] | None = None) -> Frames:
    """Read tracked boxes, none of which may have a fault (see `storage/tracks/` for others).

    Args:
        path: The file.
        image_size: (width, height) of the image in pixels, to refuse boxes that lie outside of it.

    Returns:
        `PIXEL_TRACK_DTYPE` rows in time order; stamp = round(time * 1e9) ns, `FLAG_GROUND_POINT`
        where w = h = 0.

    Raises:
        InputFileError: Names file, line and fault.
    """
    frames, _ = read_tracks(Path(path), ReadOptions(image_size=image_size, strict=True))
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
        file.write((",".join(COLUMNS) + "\n").encode())
        options = pacsv.WriteOptions(include_header=False, quoting_style="none")
        pacsv.write_csv(table, file, options)
