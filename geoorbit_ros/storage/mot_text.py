"""Detections and tracks as MOTChallenge text: `frame,id,x,y,w,h,conf,class,-1,-1`.

One line per box, no header. `frame` counts from 1; `x,y` is the top left corner in pixels, counted
from 0 as TrackEval and today's trackers write it; `id` is -1 for detections; `class` is the COCO
number. Sources: Leal-Taixé et al. 2015, arXiv:1504.01942, table 3, with the eighth column as in its
ground truth files. The format has no time: stamps follow from the frame number and the frame rate.
"""

from __future__ import annotations

import itertools
from collections.abc import Iterable, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import NoReturn

import numpy as np
import pyarrow as pa
import pyarrow.csv as pacsv
from numpy.typing import NDArray

from geoorbit_ros.core.errors import InputFileError, ParameterError, TableError
from geoorbit_ros.core.tables import (
    DETECTION_DTYPE,
    PIXEL_TRACK_DTYPE,
    Frames,
    first_bad_box,
)
from geoorbit_ros.storage.atomic import atomic_output

COLUMNS = ("frame", "id", "x", "y", "w", "h", "conf", "class", "-1", "-1")
_LAYOUT = "lines " + ",".join(COLUMNS)
_MIN_COLUMNS = 7
"""Older files end after the confidence: their class is unknown (-1)."""
_MAX_FRAME = 2**31 - 1
"""Largest frame number: an int32, as other tools read it."""
_MAX_PIXEL = 1e6
"""Largest coordinate. Chosen: a hundred times the widest image; a float32 is exact to 0.06 px
there."""
_MAX_FPS = 1000.0
"""Largest frame rate. Chosen: no camera on a pole is faster; more is a period in milliseconds."""


@dataclass(frozen=True, slots=True)
class MotTable:
    """Boxes by frame number.

    Attributes:
        frame: (F,) int64 numbers of the frames that have boxes, strictly increasing, from 1.
        offset: (F+1,) int64, rows of frame k are `rows[offset[k]:offset[k + 1]]`.
        rows: (N,) `DETECTION_DTYPE` or `PIXEL_TRACK_DTYPE`.
    """

    frame: NDArray[np.int64]
    offset: NDArray[np.int64]
    rows: NDArray[np.void]

    def frames(self, fps: float) -> Frames:
        """The same boxes with stamps: frame 1 at 0, then one every 1/fps seconds.

        Raises:
            ParameterError: A frame rate outside (0, 1000].
        """
        if not 0.0 < fps <= _MAX_FPS:
            raise ParameterError(
                "frame rate", f"{fps:g}", f"above 0, up to {_MAX_FPS:g} per second"
            )
        stamp_ns = np.rint((self.frame - 1) * (1e9 / fps)).astype(np.int64)
        return Frames(stamp_ns, self.offset, self.rows)

    def __iter__(self) -> Iterator[tuple[int, NDArray[np.void]]]:
        for number, (a, b) in zip(
            self.frame.tolist(), itertools.pairwise(self.offset), strict=True
        ):
            yield number, self.rows[a:b]


def read_mot_detections(path: str | Path) -> MotTable:
    """Read detections; the ids in the file, -1 as a rule, are left out.

    Returns:
        `DETECTION_DTYPE` rows, of one frame in file order; class -1 where the file has none.

    Raises:
        InputFileError: Names file, line and what is wrong.
    """
    return _read(path, DETECTION_DTYPE)


def read_mot_tracks(path: str | Path) -> MotTable:
    """Read tracks, results of a tracker or ground truth.

    Returns:
        `PIXEL_TRACK_DTYPE` rows without flags, of one frame in file order.

    Raises:
        InputFileError: Names file, line and what is wrong; an id twice in a frame is.
    """
    return _read(path, PIXEL_TRACK_DTYPE)


def write_mot(path: str | Path, frames: Iterable[tuple[int, NDArray[np.void]]]) -> int:
    """Write frames as they come; the file appears when the last one is written.

    Positions and sizes are rounded to a thousandth of a pixel. Flags have no place in the format.

    Args:
        path: The text file; an existing one is replaced.
        frames: Frame number, from 1 and increasing, and its rows, `DETECTION_DTYPE` or
            `PIXEL_TRACK_DTYPE`; a frame without rows leaves no line.

    Returns:
        How many boxes were written.

    Raises:
        TableError: Rows of another type, a box that the reader would refuse, or frames not in
            order.
    """
    count, last = 0, 0
    with atomic_output(path) as temporary, temporary.open("w", encoding="ascii") as file:
        for number, rows in frames:
            if not last < number <= _MAX_FRAME:
                expected = f"numbers that go up, from 1 to {_MAX_FRAME}"
                raise TableError(f"{path}, frame to write", f"{number} after {last}", expected)
            file.write(_lines(number, rows, f"{path}, frame {number} to write"))
            count, last = count + len(rows), number
    return count


def _lines(number: int, rows: NDArray[np.void], place: str) -> str:
    if rows.dtype not in (DETECTION_DTYPE, PIXEL_TRACK_DTYPE):
        raise TableError(place, rows.dtype.names, "the fields of detections or tracks_px")
    bad = first_bad_box(rows)
    if bad is not None:
        raise TableError(place, rows[bad], "finite numbers, a size not negative")
    tracked = rows.dtype == PIXEL_TRACK_DTYPE
    ids = rows["track_id"].tolist() if tracked else itertools.repeat(-1, len(rows))
    size = [rows["width"].astype(np.float64), rows["height"].astype(np.float64)]
    corner = [rows["x"] - 0.5 * size[0], rows["y"] - 0.5 * size[1]]
    boxes = np.column_stack([*corner, *size]).tolist()
    scores, classes = rows["score"].astype(np.float64).tolist(), rows["class_id"].tolist()
    return "".join(
        f"{number},{identity},{x:.3f},{y:.3f},{w:.3f},{h:.3f},{score:.6g},{kind},-1,-1\n"
        for identity, (x, y, w, h), score, kind in zip(ids, boxes, scores, classes, strict=True)
    )


def _read(path: str | Path, dtype: np.dtype[np.void]) -> MotTable:
    columns = _columns(str(path))
    frame, identity, x, y, w, h, score, kind = columns
    _check(path, "frame", _whole(frame, 1, _MAX_FRAME), "a whole number from 1")
    _check(path, "id", _whole(identity, -(2**31), 2**31 - 1), "a whole number of 32 bits")
    for name, values in (("x", x), ("y", y), ("w", w), ("h", h)):
        _check(path, name, np.abs(values) <= _MAX_PIXEL, f"pixels, up to {_MAX_PIXEL:g}")
    for name, values in (("w", w), ("h", h)):
        _check(path, name, values > 0.0, "a size in pixels above 0")
    _check(path, "conf", (score >= 0.0) & (score <= 1.0), "a confidence from 0 to 1")
    _check(path, "class", _whole(kind, -1, 2**31 - 1), "a class number, or -1 for unknown")
    order = np.argsort(frame, kind="stable")  # ground truth files are sorted by id
    rows = np.zeros(len(frame), dtype)
    rows["x"], rows["y"] = (x + 0.5 * w)[order], (y + 0.5 * h)[order]
    rows["width"], rows["height"] = w[order], h[order]
    rows["score"], rows["class_id"] = score[order], kind[order]
    number, start = np.unique(frame[order].astype(np.int64), return_index=True)
    if dtype == PIXEL_TRACK_DTYPE:
        _check(path, "id", identity >= 0, "the id of a track, not negative")
        rows["track_id"] = identity[order]
        _check(path, "id", ~_repeated(frame, identity), "every id at most once in a frame")
    return MotTable(number, np.append(start, len(rows)).astype(np.int64), rows)


def _repeated(frame: NDArray[np.float64], identity: NDArray[np.float64]) -> NDArray[np.bool_]:
    """(N,) whether an earlier line has the same frame and id."""
    order = np.lexsort((identity, frame))
    again = (np.diff(frame[order]) == 0) & (np.diff(identity[order]) == 0)
    repeated = np.zeros(len(frame), dtype=bool)
    repeated[order[1:][again]] = True
    return repeated


def _whole(values: NDArray[np.float64], low: float, high: float) -> NDArray[np.bool_]:
    good: NDArray[np.bool_] = (values == np.rint(values)) & (values >= low) & (values <= high)
    return good


def _columns(place: str) -> list[NDArray[np.float64]]:
    """The first eight columns, finite; a missing class is -1."""
    count = _column_count(place)
    names = [f"c{k}" for k in range(count)]
    wanted = names[: len(COLUMNS) - 2]
    options = pacsv.ConvertOptions(
        column_types=dict.fromkeys(names, pa.float64()), include_columns=wanted
    )
    try:
        table = pacsv.read_csv(
            place, read_options=pacsv.ReadOptions(column_names=names), convert_options=options
        )
    except (pa.ArrowInvalid, UnicodeDecodeError) as error:
        _name_fault(place, count)
        raise InputFileError(place, str(error).split("\n")[0], _LAYOUT) from None
    values = [table[name].to_numpy() for name in wanted]
    if not all(np.isfinite(column).all() for column in values):
        _name_fault(place, count)
    if len(values) < len(COLUMNS) - 2:
        values.append(np.full(len(values[0]), -1.0))
    return values


def _column_count(place: str) -> int:
    try:
        with open(place, "rb") as file:
            head = file.read(1 << 16)
    except FileNotFoundError:
        raise InputFileError(place, "no such file", f"MOTChallenge text, {_LAYOUT}") from None
    except OSError as error:
        raise InputFileError(place, str(error.strerror), f"MOTChallenge text, {_LAYOUT}") from None
    if b"\0" in head:
        raise InputFileError(place, "binary data", f"MOTChallenge text, {_LAYOUT}")
    number, line = next(
        ((k, line) for k, line in enumerate(head.splitlines(), 1) if line.strip()), (0, b"")
    )
    if not line:
        raise InputFileError(place, "no line with a box", f"MOTChallenge text, {_LAYOUT}")
    count = line.count(b",") + 1
    if not _MIN_COLUMNS <= count <= len(COLUMNS):
        raise InputFileError(
            f"{place}, line {number}", f"{count} values", f"{_MIN_COLUMNS} to 10: {_LAYOUT}"
        )
    return count


def _data_lines(place: str) -> Iterator[tuple[int, list[str]]]:
    """Line number and cells of every line with content."""
    with open(place, encoding="utf-8", errors="replace") as file:
        for number, line in enumerate(file, 1):
            if line.strip("\r\n"):
                yield number, line.strip("\r\n").split(",")


def _name_fault(place: str, count: int) -> None:
    """Find the line that the bulk reader refused; cell by cell, so only after a refusal."""
    for number, cells in _data_lines(place):
        if len(cells) != count:
            expected = f"{count} as in the first line (is it cut short?)"
            raise InputFileError(f"{place}, line {number}", f"{len(cells)} values", expected)
        for name, cell in zip(COLUMNS[:-2], cells, strict=False):
            if not _is_finite(cell):
                _raise_for(place, number, name, cell, "a finite number")


def _check(path: str | Path, name: str, good: NDArray[np.bool_], expected: str) -> None:
    if good.all():
        return
    bad = int(np.argmin(good))
    for k, (number, cells) in enumerate(_data_lines(str(path))):
        if k == bad:
            _raise_for(str(path), number, name, cells[COLUMNS.index(name)], expected)
    raise InputFileError(f"{path}, box {bad + 1}", "a file that changed", expected)


def _raise_for(place: str, number: int, name: str, cell: str, expected: str) -> NoReturn:
    text = repr(cell if len(cell) < 60 else cell[:60] + "...")
    raise InputFileError(f"{place}, line {number}, column '{name}'", text, expected)


def _is_finite(cell: str) -> bool:
    try:
        return bool(np.isfinite(float(cell)))
    except ValueError:
        return False
