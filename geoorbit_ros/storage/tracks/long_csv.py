"""Long files of tracked boxes: geoorbit's own CSV piece by piece, without any fault.

A file of which every row is as it should be needs none of `cleaning`'s decisions, which are about
all rows together. Where one would be needed, nothing is decided here, and the file is read as any
other.
"""

from __future__ import annotations

import io
import re
from collections.abc import Callable, Iterator
from pathlib import Path

import numpy as np
import pyarrow as pa
import pyarrow.compute as pc
import pyarrow.csv as pacsv
from numpy.typing import NDArray

from geoorbit_ros.core.frame_spool import SPOOLED_ROWS, AnyFrames, FrameSpool
from geoorbit_ros.core.input_report import InputReport
from geoorbit_ros.core.tables import FLAG_GROUND_POINT, PIXEL_TRACK_DTYPE, Frames
from geoorbit_ros.storage.track_csv import COLUMNS
from geoorbit_ros.storage.tracks.classes import OTHER_CLASS, class_number
from geoorbit_ros.storage.tracks.cleaning import (
    FAR_S,
    FAR_SPANS,
    NO_ID,
    NORMALISED,
    ReadOptions,
)
from geoorbit_ros.storage.tracks.csv_table import (
    EXACT_TIME_S,
    MAX_TIME_S,
    are_days,
    exact_ns,
    unit_by_size,
)
from geoorbit_ros.storage.tracks.csv_text import WHOLE_SHARE
from geoorbit_ros.storage.tracks.reader import read_tracks

LEAST_BYTES = 30_000_000
"""Smaller files are read at once. Chosen: a row takes 40 to 80 bytes, `SPOOLED_ROWS` of them more
than this."""
PIECE_BYTES = 8 << 20
"""So much of a file is taken together. Chosen: more takes memory, less time."""
HEAD_BYTES = 1 << 20
"""How columns write their numbers is seen in so much of a file: 15,000 rows."""
_GROUPED = re.compile(r"[+-]?[1-9]\d{0,2}(\.\d{3})+")
"""Such a number may have marks between thousands (`csv_text`)."""
_NUMBERS = ("conf", "x", "y", "w", "h")

Took = Callable[[], None]


class _OddError(Exception):
    """Something is not as it should be."""


def spool_tracks(path: Path, options: ReadOptions) -> tuple[AnyFrames, InputReport]:
    """As `reader.read_tracks`; many rows are kept in a temporary file.

    A clean CSV of geoorbit's own columns takes little memory, however long it is. All other files
    are read at once.
    """
    frames: AnyFrames
    frames, report = read_clean(path, options) or read_tracks(path, options)
    return spooled(frames), report


def is_long(path: Path, options: ReadOptions) -> bool:
    """Whether a file may be one for `read_clean`."""
    simple = not options.fps and not options.columns and path.is_file()
    return simple and path.stat().st_size >= LEAST_BYTES


def spooled(frames: AnyFrames) -> AnyFrames:
    """The same boxes, in memory or in a file, by how many they are."""
    if isinstance(frames, Frames) and len(frames.rows) > SPOOLED_ROWS:
        return FrameSpool.of(frames.blocks(SPOOLED_ROWS), frames.rows.dtype)
    if isinstance(frames, FrameSpool) and frames.row_count <= SPOOLED_ROWS:
        return frames.part(0, len(frames))
    return frames


def read_clean(
    path: Path, options: ReadOptions, into: FrameSpool | None = None, took: Took | None = None
) -> tuple[FrameSpool, InputReport] | None:
    """What `read_tracks` gives of a long file without any fault; None for any other file.

    Args:
        path: The file.
        options: What the user says about it.
        into: Takes the boxes; they are worth nothing if the file has a fault.
        took: Called after each piece that it took.
    """
    if not is_long(path, options):
        return None
    report = InputReport(str(path), "boxes")
    size = options.size(None, report)
    frames = FrameSpool(PIXEL_TRACK_DTYPE) if into is None else into
    try:
        for piece in _frames(path, options, size):
            frames.append(piece)
            if took is not None:
                took()
        _check_times(frames)
    except (_OddError, pa.ArrowInvalid):
        return None
    report.total = frames.row_count
    return frames, report


def _frames(path: Path, options: ReadOptions, size: tuple[int, int] | None) -> Iterator[Frames]:
    """All frames of the file, in pieces.

    Raises:
        _OddError, ArrowInvalid: A row is not as it should be.
    """
    _check_hexadecimal(path)
    types, unsure = _types(path)
    whole = dict.fromkeys(unsure, 0)
    pieces = pacsv.open_csv(
        path,
        pacsv.ReadOptions(block_size=PIECE_BYTES),
        convert_options=pacsv.ConvertOptions(
            column_types=types, strings_can_be_null=False, null_values=[]
        ),
    )
    rest, rest_ns, rest_frame = np.empty(0, PIXEL_TRACK_DTYPE), np.empty(0, np.int64), 0
    seconds, largest, sized, count = list[NDArray[np.float64]](), 0.0, False, 0
    for piece in pieces:
        if not len(piece):
            continue
        rows, most = _boxes(piece, options, size)
        largest, sized = max(largest, most), sized or bool((rows["width"] > 0).any())
        stamp_ns, of_frames = _times(piece["time"])
        seconds.append(of_frames)
        for name in unsure:
            whole[name] += int(np.count_nonzero(np.asarray(piece[name]) % 1.0 == 0.0))
        count += len(piece)
        number = np.asarray(piece["frame_num"])
        before = (rest_frame, rest_ns[-1]) if len(rest) else (number[0], stamp_ns[0])
        _check_order(np.append(before[0], number), np.append(before[1], stamp_ns))
        rows, stamp_ns = np.concatenate((rest, rows)), np.concatenate((rest_ns, stamp_ns))
        # The last frame may go on in the next piece.
        ended = int(np.searchsorted(stamp_ns, stamp_ns[-1]))
        rest, rest_ns, rest_frame = rows[ended:], stamp_ns[ended:], number[-1]
        yield _checked(stamp_ns[:ended], rows[:ended])
    yield _checked(rest_ns, rest)
    times = np.unique(np.concatenate(seconds))
    if (sized and largest <= NORMALISED) or are_days(times) or unit_by_size(times) != "s":
        raise _OddError
    # Where hardly any number is whole, points are those of decimals.
    if any(found >= WHOLE_SHARE * count for found in whole.values()):
        raise _OddError


def _types(path: Path) -> tuple[dict[str, pa.DataType], list[str]]:
    """How the columns are read, by the first rows; in which the points may be between thousands."""
    with path.open("rb") as file:
        head = file.read(HEAD_BYTES)
    header, _, body = head.partition(b"\n")
    body = body[: body.rfind(b"\n") + 1]
    if header.strip() != ",".join(COLUMNS).encode() or not body or b'"' in body:
        raise _OddError
    texts = pacsv.read_csv(
        io.BytesIO(body),
        pacsv.ReadOptions(column_names=COLUMNS),
        convert_options=pacsv.ConvertOptions(
            column_types=dict.fromkeys(COLUMNS, pa.string()), strings_can_be_null=False
        ),
    )
    if pc.any(pc.match_substring_regex(texts["id"], "[^0-9]")).as_py():
        raise _OddError
    words, unsure = pa.dictionary(pa.int32(), pa.string()), list[str]()
    types = {"id": pa.int32(), "time": words, "frame_num": pa.int64(), "class": words}
    for name in ("time", "class", *_NUMBERS):
        marked = pc.unique(texts[name].filter(pc.match_substring(texts[name], "."))).to_pylist()
        if marked and all(_GROUPED.fullmatch(text) for text in marked):
            unsure.append(name)
        if name in _NUMBERS:
            # Where no number has a point, one that has is odd.
            types[name] = pa.float64() if marked else pa.int64()
    if not set(unsure) <= set(_NUMBERS):
        raise _OddError
    return types, unsure


def _check_hexadecimal(path: Path) -> None:
    """Arrow reads `0x10` as 16 in columns of whole numbers; for `csv_text` it is no number."""
    last = b""
    with path.open("rb", buffering=0) as file:
        while piece := file.read(PIECE_BYTES):
            # One letter is found ten times as fast as two.
            if b"x" in piece or b"X" in piece:
                text = (last + piece).lower()
                if b"0x" in text:
                    raise _OddError
            last = piece[-1:]


def _boxes(
    piece: pa.RecordBatch, options: ReadOptions, size: tuple[int, int] | None
) -> tuple[NDArray[np.void], float]:
    """`PIXEL_TRACK_DTYPE` of a piece, and the largest number of a box."""
    score, x, y, width, height = (np.asarray(piece[k], np.float64) for k in _NUMBERS)
    ground = (width == 0.0) & (height == 0.0)
    good = (score >= 0.0) & (score <= 1.0) & (((width > 0.0) & (height > 0.0)) | ground)
    if size is not None:
        good &= (x + 0.5 * width >= 0) & (x - 0.5 * width <= size[0])
        good &= (y + 0.5 * height >= 0) & (y - 0.5 * height <= size[1])
    largest = max(float(np.abs(numbers).max()) for numbers in (x, y, width, height))
    track_id = np.asarray(piece["id"])
    if not good.all() or not np.isfinite(largest) or (track_id == NO_ID).any():
        raise _OddError
    rows = np.zeros(len(piece), PIXEL_TRACK_DTYPE)
    for name, numbers in (("x", x), ("y", y), ("score", score), ("track_id", track_id)):
        rows[name] = numbers
    rows["width"], rows["height"] = np.where(ground, 0.0, width), np.where(ground, 0.0, height)
    rows["class_id"] = _classes(piece["class"], options)
    rows["flags"] = np.where(ground, FLAG_GROUND_POINT, 0)
    return rows, largest


def _classes(words: pa.DictionaryArray, options: ReadOptions) -> NDArray[np.int32]:
    names = words.dictionary.to_pylist()
    numbers = np.array([class_number(name, options.classes) for name in names], np.int32)
    if (numbers == OTHER_CLASS).any() or any(_GROUPED.fullmatch(name) for name in names):
        raise _OddError
    return numbers.take(np.asarray(words.indices))


def _times(words: pa.DictionaryArray) -> tuple[NDArray[np.int64], NDArray[np.float64]]:
    """(N,) stamps, and the seconds of each distinct time."""
    text = pc.utf8_trim_whitespace(words.dictionary)
    seconds = np.asarray(pc.cast(text, pa.float64()))
    if not ((seconds >= 0.0) & (seconds <= MAX_TIME_S)).all():
        raise _OddError
    late = seconds >= EXACT_TIME_S
    stamps = exact_ns(text, "s") if late.any() else np.rint(seconds * 1e9).astype(np.int64)
    if stamps is None or (late.any() and not late.all()):
        raise _OddError
    return stamps[np.asarray(words.indices)], seconds


def _check_order(number: NDArray[np.int64], stamp_ns: NDArray[np.int64]) -> None:
    """Later frames have later times and larger numbers, and one frame has one time."""
    numbered, later = np.diff(number), np.diff(stamp_ns)
    if (numbered < 0).any() or (later < 0).any() or ((numbered > 0) != (later > 0)).any():
        raise _OddError


def _checked(stamp_ns: NDArray[np.int64], rows: NDArray[np.void]) -> Frames:
    """Frames of rows in order, in which no id is twice in a frame."""
    new = np.append(True, np.diff(stamp_ns) > 0)[: len(stamp_ns)]
    track_id = rows["track_id"].astype(np.int64)
    if not (new[1:] | (np.diff(track_id) > 0)).all():
        key = np.sort((np.cumsum(new) << 32) + track_id)
        if (np.diff(key) == 0).any():
            raise _OddError
    first = np.flatnonzero(new)
    return Frames(stamp_ns[first], np.append(first, len(rows)), rows)


def _check_times(frames: FrameSpool) -> None:
    """No time is far from the recording's: see `cleaning.FAR_SPANS`."""
    if not frames.row_count:
        raise _OddError
    last = frames.row_count - 1
    low, high = (
        frames.stamp_ns[_owner(frames, row)] for row in (np.ceil(0.05 * last), 0.95 * last)
    )
    reach = FAR_SPANS * float(high - low) + FAR_S * 1e9
    if frames.stamp_ns[0] < low - reach or frames.stamp_ns[-1] > high + reach:
        raise _OddError


def _owner(frames: FrameSpool, row: float) -> int:
    """Which frame a row belongs to."""
    return int(np.searchsorted(frames.offset, row, side="right")) - 1
