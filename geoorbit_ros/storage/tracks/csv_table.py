"""Tracked boxes as CSV with a header, of geoorbit's own columns or of any others.

geoorbit's own columns are `id,time,frame_num,class,conf,x,y,w,h`, with x, y in the middle of the
box. Others are recognised by their names: corners (`x1,y1,x2,y2`; `x_min,…`, as supervision's
CSVSink writes), the upper left corner and a size (`left,top,width,height`), or named by the user.
"""

from __future__ import annotations

import re
from datetime import UTC, datetime, timedelta
from pathlib import Path

import numpy as np
import pyarrow as pa
import pyarrow.compute as pc
from numpy.typing import NDArray

from geoorbit_ros.core.errors import InputFileError, ParameterError
from geoorbit_ros.core.input_report import InputReport, Treatment
from geoorbit_ros.storage.tracks.csv_text import (
    CsvText,
    as_numbers,
    decode,
    first_line,
    read_csv_text,
)
from geoorbit_ros.storage.tracks.raw_tracks import Array, RawTracks

UNKNOWN_NS = -1
EXACT_TIME_S = 2e6
"""Above this a float64 of seconds can be half a nanosecond off (2^51 ns)."""
MAX_TIME_S = 2.0**31
"""builtin_interfaces/Time holds seconds in 32 bits."""
_UNITS = {"s": 1.0, "ms": 1e-3, "us": 1e-6, "ns": 1e-9}
_DIGITS = {"s": 9, "ms": 6, "us": 3, "ns": 0}
"""Decimals of each unit that make a nanosecond."""
_WORDS = {"s": "seconds", "ms": "milliseconds", "us": "microseconds", "ns": "nanoseconds"}
_DAYS = (25_569.0, 80_000.0)
"""Days since 30 December 1899, as spreadsheets count them: from 1970 to the year 2119."""
_SINCE_1970 = ((1e17, "ns"), (1e14, "us"), (1e11, "ms"))
"""A time of this size or more, since 1970: in seconds each would be later than the year 5000."""
_STEP_S = (0.005, 2.0)
"""Usual steps between images: 200 to 0.5 per second. Numbers whose steps are such in milliseconds
(5 to 2000) or less would as seconds be one image in five seconds or fewer: that shows no
traffic."""
_TIME = r"(?P<parts>\d{1,2}(?::[0-5]?\d){1,2}(?:[.,]\d+)?)\s*(?P<half>[AaPp]\.?[Mm]\.?)?"
_CLOCK = re.compile(_TIME)
_SPREADSHEET = re.compile(rf"(\d{{1,4}})([-/.])(\d{{1,2}})[-/.](\d{{2,4}}),?[ T]+(?P<time>{_TIME})")
_MIDNIGHT_GAP_NS = 6 * 3600 * 10**9
"""Times of day with so long a gap between them are those before and after midnight."""
_NUMBER = re.compile(r"[+-]?(\d+\.?\d*|\.\d+)([eE][+-]?\d+)?|nan|inf", re.IGNORECASE)
_HOUR_GAP_NS = 900 * 10**9
"""The same of minutes and seconds, which begin again every hour."""
_FEWEST_STEPS = 10
"""Fewer say nothing of the unit. Chosen: a recording of lanes has hundreds."""
_NAMED_UNIT = re.compile(
    r"(?:_|/|\[|\(|\s)(?:(ms|msecs?|millis|milliseconds?)|(us|µs|μs|micros|microseconds?)"
    r"|(ns|nanos|nanoseconds?)|(s|secs?|seconds?))[\])]?$"
)
"""The unit at the end of a column's name: `time_ms`, `Time [ms]`, `t (milliseconds)`."""


def parse_times(text: pa.Array, name: str, report: InputReport) -> NDArray[np.int64]:
    """(N,) nanoseconds, `UNKNOWN_NS` where a text is no time.

    Args:
        text: (N,) the column.
        name: Its name: `time_ms` says the unit.
        report: Takes what was assumed.
    """
    numbers = as_numbers(text)
    if are_days(numbers[np.isfinite(numbers)]) and not _named_unit(name):
        told = f"column '{name}' is in days, as spreadsheets count them, by the size of its steps"
        report.note(Treatment.REPAIRED, told)
        since = _DAYS[0] if np.nanmax(numbers) >= _DAYS[0] else 0.0
        seconds = np.nan_to_num((numbers - since) * 86_400.0, nan=UNKNOWN_NS * 1e-9)
        return np.rint(seconds * 1e9).astype(np.int64)
    if np.isfinite(numbers).sum() * 2 < len(numbers):
        dates = _from_dates(text, report)
        if (dates >= 0).any():
            return dates
    finite = np.isfinite(numbers)
    if not finite.any():
        return np.full(len(numbers), UNKNOWN_NS)
    named = _named_unit(name)
    unit = named or unit_by_size(numbers[finite])
    if unit != "s" and not named:
        report.note(Treatment.REPAIRED, f"column '{name}' is in {_WORDS[unit]}, by its size")
    seconds = numbers * _UNITS[unit]
    stamps = _exact(text, unit, seconds)
    low = seconds[finite].min()
    if low < 0.0:
        report.note(Treatment.REPAIRED, f"times begin at {low:g} s; they now begin at 0")
        stamps = stamps - stamps[finite].min()
    good = finite & (stamps >= 0) & (seconds <= MAX_TIME_S)
    return np.where(good, stamps, UNKNOWN_NS)


def _named_unit(name: str) -> str | None:
    found = _NAMED_UNIT.search(name.strip().lower())
    return ("ms", "us", "ns", "s")[(found.lastindex or 0) - 1] if found else None


def are_days(numbers: NDArray[np.float64]) -> bool:
    """Whether times are days, or shares of one: a usual step between images apart."""
    steps = np.diff(np.unique(numbers))
    if len(steps) < _FEWEST_STEPS:
        return False
    low, high = float(numbers.min()), float(numbers.max())
    if not (_DAYS[0] <= low <= high <= _DAYS[1] or 0.0 <= low <= high <= 1.0):
        return False
    return bool(_STEP_S[0] <= float(np.median(steps)) * 86_400.0 <= _STEP_S[1])


def unit_by_size(numbers: NDArray[np.float64]) -> str:
    """The unit of times that nobody names: `s`, `ms`, `us` or `ns`."""
    usual = float(np.median(numbers))
    for least, unit in _SINCE_1970:
        if usual >= least:
            return unit
    steps = np.diff(np.unique(numbers))
    if len(steps) >= _FEWEST_STEPS:
        step = float(np.median(steps))
        for unit in ("ms", "us", "ns"):
            if _STEP_S[0] <= step * _UNITS[unit] <= _STEP_S[1]:
                return unit
    return "s"


def _exact(text: pa.Array, unit: str, seconds: NDArray[np.float64]) -> NDArray[np.int64]:
    """Late times (since 1970) are read again as exact decimals."""
    within = np.isfinite(seconds) & (np.abs(seconds) <= MAX_TIME_S)
    rough = np.rint(np.where(within, seconds, UNKNOWN_NS * 1e-9) * 1e9).astype(np.int64)
    if np.nanmax(seconds) < EXACT_TIME_S:
        return rough
    exact = exact_ns(pc.if_else(pa.array(within), text, "0"), unit)
    # More digits than the decimal holds: such a text came from a float64 anyway.
    return rough if exact is None else exact


def exact_ns(text: pa.Array, unit: str) -> NDArray[np.int64] | None:
    """(N,) nanoseconds of decimal numbers; None where one has more digits than decimals hold."""
    digits = _DIGITS[unit]
    try:
        decimals = pc.cast(text, pa.decimal128(38, 18))
    except (pa.ArrowInvalid, pa.ArrowNotImplementedError):
        return None
    exact = pc.round(decimals, digits).cast(pa.decimal128(19, digits))
    words = np.frombuffer(exact.buffers()[1], np.int64)
    return words[2 * exact.offset :: 2][: len(exact)].copy()


def _from_dates(text: pa.Array, report: InputReport) -> NDArray[np.int64]:
    """Dates and times, or times of day; each distinct text is read once."""
    encoded = text.dictionary_encode()
    words = [word.strip() for word in encoded.dictionary.to_pylist()]
    stamps = np.full(len(words), UNKNOWN_NS)
    local = False
    for k, word in enumerate(words):
        moment = _moment(word)
        if moment is not None:
            if moment.tzinfo is None:
                local, moment = True, moment.replace(tzinfo=UTC)
            whole = int(moment.replace(microsecond=0).timestamp())
            stamps[k] = whole * 10**9 + moment.microsecond * 1000
    if local:
        report.note(Treatment.REPAIRED, "times name no time zone; they are taken as UTC")
    if (stamps < 0).all():
        stamps = _times_of_day(words)
        if (stamps >= 0).any():
            report.note(Treatment.REPAIRED, "times have no date; they count from midnight")
    return stamps[np.array(encoded.indices, dtype=np.intp)]


def _moment(word: str) -> datetime | None:
    """A date with a time: ISO 8601, or as spreadsheets write them."""
    try:
        return datetime.fromisoformat(word.replace(",", "."))
    except ValueError:
        found = _SPREADSHEET.fullmatch(word)
    if found is None:
        return None
    first, mark, second, third = found.group(1, 2, 3, 4)
    if len(first) == 4:
        year, month, day = first, second, third
    elif mark == "." or int(first) > 12:
        day, month, year = first, second, third
    else:  # in the middle of a recording, whether it is March 4th or April 3rd changes nothing
        month, day, year = first, second, third
    seconds = _seconds(found["time"], with_date=True)
    try:
        date = datetime(int(year) + (2000 if len(year) == 2 else 0), int(month), int(day))
    except ValueError:
        return None
    return None if seconds is None else date + timedelta(seconds=seconds)


def _times_of_day(words: list[str]) -> NDArray[np.int64]:
    """Nanoseconds since midnight, the second day's after it, `UNKNOWN_NS` for what is none."""
    seconds = [_seconds(word) for word in words]
    stamps = np.array([UNKNOWN_NS if s is None else round(s * 1e9) for s in seconds], np.int64)
    known = np.unique(stamps[stamps >= 0])
    gap = np.diff(known)
    hourly = all(
        word.count(":") == 1 for word, s in zip(words, seconds, strict=True) if s is not None
    )
    longest, around = (_HOUR_GAP_NS, 3600) if hourly else (_MIDNIGHT_GAP_NS, 24 * 3600)
    if len(gap) and gap.max() > longest:
        early = (stamps >= 0) & (stamps <= known[int(np.argmax(gap))])
        stamps[early] += around * 10**9
    return stamps


def _seconds(word: str, with_date: bool = False) -> float | None:
    """Seconds since midnight; two numbers are minutes and seconds, but hours behind a date."""
    found = _CLOCK.fullmatch(word)
    if found is None:
        return None
    parts = [float(part.replace(",", ".")) for part in found["parts"].split(":")]
    half = (found["half"] or "").lower()[:1]
    if len(parts) == 2 and (half or with_date):
        parts.append(0.0)
    if half:
        parts[0] = parts[0] % 12 + (12 if half == "p" else 0)
    return float(sum(part * 60.0**k for k, part in enumerate(reversed(parts))))


NAMES: dict[str, tuple[str, ...]] = {
    "id": ("id", "track_id", "tracker_id", "trackid", "object_id", "vehicle_id", "obj_id", "tid"),
    "time": (
        "time", "time_s", "timestamp", "timestamp_s", "t", "seconds", "datetime", "stamp",
        "time_ms", "timestamp_ms", "time_ns", "timestamp_ns", "stamp_ns", "time_us", "timestamp_us",
    ),
    "frame": (
        "frame_num", "frame", "frame_id", "frame_index", "frame_idx", "frame_number", "frame_no",
    ),
    "class": ("class", "class_name", "class_id", "label", "category", "cls", "type"),
    "conf": ("conf", "confidence", "score", "prob", "probability"),
    "x": ("x", "cx", "xc", "x_center", "center_x", "x_centre"),
    "y": ("y", "cy", "yc", "y_center", "center_y", "y_centre"),
    "w": ("w", "width", "bbox_width", "box_width", "bb_width", "bbox_w"),
    "h": ("h", "height", "bbox_height", "box_height", "bb_height", "bbox_h"),
    "x1": ("x1", "xmin", "x_min", "xtl", "bbox_x1", "bbox_xmin", "x_1"),
    "y1": ("y1", "ymin", "y_min", "ytl", "bbox_y1", "bbox_ymin", "y_1"),
    "x2": ("x2", "xmax", "x_max", "xbr", "bbox_x2", "bbox_xmax", "x_2", "right"),
    "y2": ("y2", "ymax", "y_max", "ybr", "bbox_y2", "bbox_ymax", "y_2", "bottom"),
    "left": ("left", "bbox_left", "bb_left", "x_left", "bbox_x"),
    "top": ("top", "bbox_top", "bb_top", "y_top", "bbox_y"),
}  # fmt: skip
"""Names of columns by what they mean, the first that a file has counts; case and blanks don't."""
_CENTRE, _CORNERS = ("x", "y", "w", "h"), ("x1", "y1", "x2", "y2")
_CORNER, _EDGES = ("left", "top", "w", "h"), ("left", "top", "x2", "y2")
_FIRST_CORNER = ("x1", "y1", "w", "h")
_POINT = ("x", "y")


class CsvTable:
    """`TrackFormat` for CSV files with a header."""

    name = "CSV"
    expected = "a CSV file of tracks with the columns id,time,frame_num,class,conf,x,y,w,h"

    def recognises(self, path: Path, head: bytes) -> bool:
        """Whether the first line with content has words where other lines have numbers."""
        try:
            text = decode(head, str(path), self.expected)
        except InputFileError:
            return False
        header, _, _, body = first_line(text)
        cells = re.split(r"[,;\t]", header)
        if len(cells) == 1:  # values between blanks: as many in the next line
            cells = header.split()
            cells = cells if len(cells) == len(first_line(body)[0].split()) else []
        words = [c for c in cells if re.search(r"[A-Za-z]", c) and not _NUMBER.fullmatch(c.strip())]
        return len(cells) > 1 and 2 * len(words) > len(cells)

    def read(self, path: Path, columns: dict[str, str]) -> RawTracks:
        """See `TrackFormat.read`."""
        table = read_csv_text(path, self.expected)
        roles = _roles(table, columns, str(path))
        shape = _shape(roles, table, str(path))
        box = {role: table.numbers(roles[role]) for role in shape}
        x, y, width, height = _centre(box)
        count = len(table.line)
        ground = np.zeros(count, dtype=np.bool_)
        if shape == _POINT:
            ground[:] = True
            table.report.note(
                Treatment.NOTED, "no column has the boxes' sizes: x, y are taken as ground points"
            )
        elif shape == _CENTRE:
            ground = (width == 0.0) & (height == 0.0)
        unknown = pa.array([""] * count, pa.string())
        score = table.numbers(roles["conf"]) if "conf" in roles else np.full(count, np.nan)
        if "conf" not in roles:
            table.report.note(Treatment.NOTED, "no column has scores: all boxes count as sure")
        raw = RawTracks(
            self.name,
            table.line,
            "line",
            x, y, width, height,
            ground,
            table.words(roles["id"]) if "id" in roles else unknown,
            table.words(roles["class"]) if "class" in roles else unknown,
            score,
            table.report,
        )  # fmt: skip
        if "frame" in roles:
            raw.frame = table.numbers(roles["frame"])
        if "time" in roles:
            name = roles["time"]
            text: pa.Array = table.columns[table.names.index(name)]
            # `--columns time_ms=t` names the unit, too.
            said = next((word for word, column in columns.items() if column == name), name)
            raw.time_text = text
            raw.stamp_ns = parse_times(text, said if _named_unit(said) else name, table.report)
        return raw


def _roles(table: CsvText, columns: dict[str, str], place: str) -> dict[str, str]:
    """Which column has which meaning."""
    named: dict[str, str] = {}
    for word, name in columns.items():
        named[_meaning(word)] = name
        if name not in table.names:
            raise InputFileError(
                place, f"no column '{name}' in '{_shortened(table.names)}'", "that of --columns"
            )
    plain = {_plain(name): name for name in reversed(table.names)}
    found = {
        meaning: plain[name]
        for meaning, names in NAMES.items()
        for name in reversed(names)
        if name in plain
    }
    # A column that the user named has no other meaning: `left=x` says that x is not the middle.
    return {m: name for m, name in found.items() if name not in named.values()} | named


def _meaning(word: str) -> str:
    """Of a column, by any of its usual names.

    Raises:
        ParameterError: No column has such a meaning.
    """
    plain = _plain(word)
    for meaning, names in NAMES.items():
        if plain == meaning or plain in names:
            return meaning
    raise ParameterError("option --columns", repr(word), f"one of {', '.join(NAMES)}")


def _shape(roles: dict[str, str], table: CsvText, place: str) -> tuple[str, ...]:
    """Which columns say where the boxes are."""
    # The corner first: MOTChallenge's x, y beside left, top are places in the world.
    shapes = (_CORNER, _CENTRE, _CORNERS, _EDGES, _FIRST_CORNER, _POINT)
    shape = next((shape for shape in shapes if all(role in roles for role in shape)), None)
    missing, named = [], []
    if "frame" not in roles and "time" not in roles:
        missing.append("that says when")
        named.append("time=NAME or frame=NAME")
    if "id" not in roles:
        missing.append("with the tracks' ids")
        named.append("id=NAME")
    if shape is None:
        missing.append("with boxes (x,y,w,h: middle and size; x1,y1,x2,y2; left,top,width,height)")
        named.append("x=NAME, y=NAME and so on")
    if missing or shape is None:
        found = f"no column {', none '.join(missing)}, in '{_shortened(table.names)}'"
        raise InputFileError(place, found, f"such columns, or --columns {', '.join(named)}")
    return shape


def _centre(box: dict[str, Array]) -> tuple[Array, Array, Array, Array]:
    """Middle and size of boxes given in any of the ways."""
    if "x" in box:
        nothing: NDArray[np.float64] = np.zeros(len(box["x"]))
        return box["x"], box["y"], box.get("w", nothing), box.get("h", nothing)
    left, top = box.get("x1", box.get("left")), box.get("y1", box.get("top"))
    assert left is not None
    assert top is not None
    width = box["w"] if "w" in box else box["x2"] - left
    height = box["h"] if "h" in box else box["y2"] - top
    return left + 0.5 * width, top + 0.5 * height, width, height


def _plain(name: str) -> str:
    """A column's name without case, blanks, units in brackets."""
    text = re.sub(r"[\[(].*?[\])]", "", name.strip().lower())
    return re.sub(r"[\s.\-]+", "_", text.strip()).strip("_")


def _shortened(names: tuple[str, ...]) -> str:
    text = ",".join(names)
    return text if len(text) < 200 else f"{text[:200]}…"
