"""The tables that travel between nodes: one numpy structured row per vehicle and frame.

The same dtypes are the in-memory arrays, the PointCloud2 payloads and the rows of a bag, so the
offline path and the node graph compute on identical bits.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass
from itertools import pairwise

import numpy as np
from numpy.typing import NDArray

from geoorbit_ros.core.errors import TableError

FLAG_PREDICTED = 1
"""`flags` bit: the row is the tracker's prediction, no detection supports it."""
FLAG_TRUNCATED = 2
"""`flags` bit: the box touches the image border, its centre is not the vehicle's centre."""
FLAG_GROUND_POINT = 4
"""`flags` bit: the pixel is already on the ground (`w = h = 0` in a CSV), so that nothing shows the
vehicle's size; a ground track has the usual one of its class."""
FLAG_DOUBTFUL = 8
"""`flags` bit of `tracks`: something speaks against the calibration or the boxes; lanes made of
such rows are not confirmed."""

DETECTION_DTYPE = np.dtype(
    [
        ("x", "<f4"),
        ("y", "<f4"),
        ("width", "<f4"),
        ("height", "<f4"),
        ("score", "<f4"),
        ("class_id", "<i4"),
    ]
)
"""`detections`: pixels, box centre; COCO class numbers."""

PIXEL_TRACK_DTYPE = np.dtype([*DETECTION_DTYPE.descr, ("track_id", "<i4"), ("flags", "<u4")])
"""`tracks_px`: a detection with the tracker's identity."""

TRACK_DTYPE = np.dtype(
    [
        ("x", "<f4"),
        ("y", "<f4"),
        ("vx", "<f4"),
        ("vy", "<f4"),
        ("heading", "<f4"),
        ("length", "<f4"),
        ("width", "<f4"),
        ("score", "<f4"),
        ("sigma", "<f4"),
        ("class_id", "<i4"),
        ("track_id", "<i4"),
        ("flags", "<u4"),
    ]
)
"""`tracks`: metres and m/s in the map frame (ENU, REP-103), heading in radians counter-clockwise
from east (NaN until the vehicle has moved), `sigma` the 1-sigma ground position error in metres."""


@dataclass(frozen=True, slots=True)
class Frames:
    """Rows of many frames, ordered by time.

    Attributes:
        stamp_ns: (F,) int64, capture time of each frame, strictly increasing.
        offset: (F+1,) int64, rows of frame k are `rows[offset[k]:offset[k + 1]]`.
        rows: (N,) structured array of one of the dtypes above.
    """

    stamp_ns: NDArray[np.int64]
    offset: NDArray[np.int64]
    rows: NDArray[np.void]

    def __post_init__(self) -> None:
        if len(self.offset) != len(self.stamp_ns) + 1 or self.offset[-1] != len(self.rows):
            raise TableError(
                "Frames",
                f"{len(self.stamp_ns)} stamps, {len(self.offset)} offsets, {len(self.rows)} rows",
                "one offset more than stamps, the last one equal to the number of rows",
            )
        back = self.stamp_ns[1:] <= self.stamp_ns[:-1]
        if back.any():
            k = int(back.argmax()) + 1
            raise TableError(
                f"Frames, frame {k}",
                f"stamp {self.stamp_ns[k]} ns after {self.stamp_ns[k - 1]} ns",
                "strictly increasing stamps",
            )

    def __len__(self) -> int:
        return len(self.stamp_ns)

    def frame(self, k: int) -> NDArray[np.void]:
        """Rows of frame `k`, a view."""
        return self.rows[self.offset[k] : self.offset[k + 1]]

    def part(self, first: int, last: int) -> Frames:
        """Frames `first` to `last` - 1, views."""
        begin, end = self.offset[first], self.offset[last]
        offset = self.offset[first : last + 1] - begin
        return Frames(self.stamp_ns[first:last], offset, self.rows[begin:end])

    def blocks(self, rows: int) -> Iterator[Frames]:
        """Consecutive frames, as many together as have no more than `rows` rows, at least one."""
        for first, last in bounds_of_blocks(self.offset, rows):
            yield self.part(first, last)

    def between(self, first_ns: int, last_ns: int) -> Frames:
        """Frames from one stamp to another, both included, views."""
        first = int(np.searchsorted(self.stamp_ns, first_ns))
        last = int(np.searchsorted(self.stamp_ns, last_ns, side="right"))
        return self.part(first, max(first, last))

    def tables(self) -> Iterator[tuple[int, NDArray[np.void]]]:
        """Stamp and rows of each frame, views."""
        bounds = pairwise(self.offset.tolist())
        for stamp_ns, (begin, end) in zip(self.stamp_ns.tolist(), bounds, strict=True):
            yield stamp_ns, self.rows[begin:end]

    def row_stamp_ns(self) -> NDArray[np.int64]:
        """(N,) stamp of each row."""
        return np.repeat(self.stamp_ns, np.diff(self.offset))


def bounds_of_blocks(offset: NDArray[np.int64], rows: int) -> Iterator[tuple[int, int]]:
    """First and behind-the-last frame of each block; see `Frames.blocks`."""
    first = 0
    while first < len(offset) - 1:
        limit = offset[first] + rows
        last = max(first + 1, int(np.searchsorted(offset, limit, side="right")) - 1)
        yield first, last
        first = last


def one_frame(stamp_ns: int, rows: NDArray[np.void]) -> Frames:
    """A single frame of rows (N,)."""
    offset = np.array([0, len(rows)], dtype=np.int64)
    return Frames(np.array([stamp_ns], dtype=np.int64), offset, rows)


def join_frames(
    frames: Sequence[tuple[int, NDArray[np.void]]], dtype: np.dtype[np.void] = PIXEL_TRACK_DTYPE
) -> Frames:
    """Frames of stamps, which increase, and their rows of a dtype."""
    offset = np.cumsum([0, *(len(rows) for _, rows in frames)], dtype=np.int64)
    rows = np.concatenate([np.empty(0, dtype), *(rows for _, rows in frames)])
    return Frames(np.array([stamp_ns for stamp_ns, _ in frames], dtype=np.int64), offset, rows)


def frames_between(
    blocks: Iterable[Frames], first_ns: int | None = None, last_ns: int | None = None
) -> Frames:
    """Frames of `TRACK_DTYPE` from one stamp to another (both included), of blocks in time order.

    Without a stamp, from the beginning or to the end.
    """
    parts = []
    for block in blocks:
        low = 0 if first_ns is None else int(np.searchsorted(block.stamp_ns, first_ns))
        high = len(block)
        if last_ns is not None:
            high = int(np.searchsorted(block.stamp_ns, last_ns, side="right"))
        if low < high:
            parts.append(block.part(low, high))
    return join_blocks(parts)


def join_blocks(blocks: Sequence[Frames], dtype: np.dtype[np.void] = TRACK_DTYPE) -> Frames:
    """Blocks of frames of a dtype in time order as one."""
    counts = [np.diff(block.offset) for block in blocks]
    return Frames(
        np.concatenate([np.empty(0, np.int64), *(block.stamp_ns for block in blocks)]),
        np.append(0, np.cumsum(np.concatenate([np.empty(0, np.int64), *counts]))),
        np.concatenate([np.empty(0, dtype), *(block.rows for block in blocks)], dtype=dtype),
    )


def frames_from_rows(stamp_ns: NDArray[np.int64], rows: NDArray[np.void]) -> Frames:
    """Group rows by their stamp; `stamp_ns` (N,) may come in any order."""
    order = np.argsort(stamp_ns, kind="stable")
    stamps, start = np.unique(stamp_ns[order], return_index=True)
    return Frames(stamps, np.append(start, len(rows)).astype(np.int64), rows[order])


def order_by_id(track_id: NDArray[np.int32]) -> NDArray[np.intp]:
    """(N,) order in which the rows of each track stand together, each track's as they came."""
    if len(track_id) > 1:
        low = int(track_id.min())
        if int(track_id.max()) - low <= np.iinfo(np.uint16).max:
            # Numbers of 16 bits are sorted digit by digit, in a fifth of the time.
            track_id = (track_id.astype(np.int64) - low).astype(np.uint16)
    return np.argsort(track_id, kind="stable")


def distinct(numbers: NDArray[np.int32]) -> NDArray[np.int64]:
    """The different ones of (N,) numbers, increasing."""
    low = int(numbers.min(initial=2**31 - 1))
    span = int(numbers.max(initial=low)) - low + 1
    if span > 2 * len(numbers) + 1000:  # a table of what is there would be longer than the numbers
        return np.unique(numbers).astype(np.int64)
    there = np.zeros(span, np.bool_)
    there[numbers.astype(np.int64) - low] = True
    return np.flatnonzero(there) + low


def one_class_each(rows: NDArray[np.void]) -> NDArray[np.int64]:
    """(N,) classes of `PIXEL_TRACK_DTYPE` rows, in which each track has one.

    It is the class of most of its rows, weighted by their score and area: the nearer a vehicle,
    the better it shows what it is.
    """
    ids, track = np.unique(rows["track_id"], return_inverse=True)
    kinds, kind = np.unique(rows["class_id"], return_inverse=True)
    votes = np.zeros((len(ids), max(len(kinds), 1)))
    area = rows["width"].astype(np.float64) * rows["height"]
    np.add.at(votes, (track, kind), rows["score"] * area)
    return np.asarray(kinds[votes.argmax(axis=1)[track]], dtype=np.int64)


def first_bad_box(rows: NDArray[np.void]) -> int | None:
    """Index of the first row with a number that is not finite or a negative size."""
    good = (rows["width"] >= 0) & (rows["height"] >= 0)
    for name in ("x", "y", "width", "height", "score"):
        good &= np.isfinite(rows[name])
    return None if good.all() else int(np.argmin(good))


def table_fault(rows: object, dtype: np.dtype[np.void]) -> str | None:
    """What is wrong with something that should be (N,) sound boxes of a dtype; None: nothing."""
    if not isinstance(rows, np.ndarray):
        return "None" if rows is None else f"a {type(rows).__name__}"
    if rows.dtype != dtype:
        fields = rows.dtype.names
        return f"an array with the fields {', '.join(fields)}" if fields else f"{rows.dtype} values"
    if rows.ndim != 1:
        return f"an array of shape {rows.shape}"
    if (k := first_bad_box(rows)) is not None:
        return f"row {k}: {rows[k]}, not finite or of negative size"
    return None


MAX_CLASS = 79
"""COCO's last number (Lin et al. 2014: 80 classes, from 0)."""
RANGES = f"score from 0 to 1, class_id from -1 (unknown) to {MAX_CLASS} (COCO)"
"""What scores and classes of boxes can be, in words."""


def range_fault(rows: NDArray[np.void]) -> str | None:
    """What score or class of (N,) boxes can't be; None: all can."""
    for name, low, high in (("score", 0.0, 1.0), ("class_id", UNKNOWN_CLASS, MAX_CLASS)):
        good = (rows[name] >= low) & (rows[name] <= high)
        if not good.all():
            k = int(np.argmin(good))
            return f"row {k}: {name} {rows[name][k]:g}"
    return None


def first_repeated_id(frames: Frames) -> int | None:
    """Index of the first row whose `track_id` an earlier row of the same frame has.

    An id names one vehicle: twice in a frame, it would cut every track in two.
    """
    frame = np.repeat(np.arange(len(frames)), np.diff(frames.offset)) << 32
    key = frame + frames.rows["track_id"]
    if (np.diff(np.sort(key)) > 0).all():  # a plain sort is several times faster than argsort
        return None
    order = np.argsort(key, kind="stable")
    again = np.flatnonzero(np.diff(key[order]) == 0)
    return int(order[again + 1].min())


UNKNOWN_CLASS = -1
"""A tracker that was told no class: its tracks are taken for vehicles."""
CAR = 2
"""COCO's number of cars and vans (Lin et al. 2014, 80 classes, from 0)."""
MOTORCYCLE = 3
"""COCO's number."""
BUS = 5
"""COCO's number."""
TRUCK = 7
"""COCO's number."""
LARGE_CLASSES = (BUS, TRUCK)
"""Vehicles that hide others."""
VEHICLE_CLASSES = (UNKNOWN_CLASS, CAR, MOTORCYCLE, *LARGE_CLASSES)
"""Classes that lanes are made of. People and bicycles have paths that are no lanes."""
VEHICLE_CLASS_TEXT = "2 (car), 3 (motorcycle), 5 (bus), 7 (truck) or -1 (unknown)"
