"""Capture times as people write them: seconds, milliseconds, since 1970 or not, or ISO 8601."""

from __future__ import annotations

from datetime import UTC, datetime

import numpy as np
import pyarrow as pa
import pyarrow.compute as pc
from numpy.typing import NDArray

from geoorbit_ros.core.input_report import InputReport, Treatment
from geoorbit_ros.storage.tracks.csv_text import as_numbers

UNKNOWN_NS = -1
EXACT_TIME_S = 2e6
"""Above this a float64 of seconds can be half a nanosecond off (2^51 ns)."""
MAX_TIME_S = 2.0**31
"""builtin_interfaces/Time holds seconds in 32 bits."""
_UNITS = {"s": 1.0, "ms": 1e-3, "us": 1e-6, "ns": 1e-9}
_DIGITS = {"s": 9, "ms": 6, "us": 3, "ns": 0}
"""Decimals of each unit that make a nanosecond."""
_WORDS = {"s": "seconds", "ms": "milliseconds", "us": "microseconds", "ns": "nanoseconds"}
_SINCE_1970 = ((1e17, "ns"), (1e14, "us"), (1e11, "ms"))
"""A time of this size or more, since 1970: in seconds each would be later than the year 5000."""
_STEP_MS = (5.0, 2000.0)
"""Steps between images that are milliseconds when all times are whole: 200 to 0.5 per second.
As seconds they would be one image in five seconds or fewer, which shows no traffic."""


def parse_times(text: pa.Array, name: str, report: InputReport) -> NDArray[np.int64]:
    """(N,) nanoseconds, `UNKNOWN_NS` where a text is no time.

    Args:
        text: (N,) the column.
        name: Its name: `time_ms` says the unit.
        report: Takes what was assumed.
    """
    numbers = as_numbers(text)
    if np.isfinite(numbers).sum() * 2 < len(numbers):
        dates = _from_dates(text, report)
        if (dates >= 0).any():
            return dates
    finite = np.isfinite(numbers)
    if not finite.any():
        return np.full(len(numbers), UNKNOWN_NS)
    unit = _unit(name, numbers[finite])
    if unit != "s" and not name.lower().endswith(f"_{unit}"):
        report.note(Treatment.REPAIRED, f"column '{name}' is in {_WORDS[unit]}, by its size")
    seconds = numbers * _UNITS[unit]
    stamps = _exact(text, unit, seconds)
    low = seconds[finite].min()
    if low < 0.0:
        report.note(Treatment.REPAIRED, f"times begin at {low:g} s; they now begin at 0")
        stamps = stamps - stamps[finite].min()
    good = finite & (stamps >= 0) & (seconds <= MAX_TIME_S)
    return np.where(good, stamps, UNKNOWN_NS)


def _unit(name: str, numbers: NDArray[np.float64]) -> str:
    ending = name.lower().rpartition("_")[2]
    if ending in _UNITS and "_" in name:
        return ending
    usual = float(np.median(numbers))
    for least, unit in _SINCE_1970:
        if usual >= least:
            return unit
    whole = bool(np.all(numbers == np.rint(numbers)))
    steps = np.diff(np.unique(numbers))
    if whole and len(steps) and _STEP_MS[0] <= float(np.median(steps)) <= _STEP_MS[1]:
        return "ms"
    return "s"


def _exact(text: pa.Array, unit: str, seconds: NDArray[np.float64]) -> NDArray[np.int64]:
    """Late times (since 1970) are read again as exact decimals."""
    within = np.isfinite(seconds) & (np.abs(seconds) <= MAX_TIME_S)
    rough = np.rint(np.where(within, seconds, UNKNOWN_NS * 1e-9) * 1e9).astype(np.int64)
    if np.nanmax(seconds) < EXACT_TIME_S:
        return rough
    digits = _DIGITS[unit]
    plain = pc.if_else(pa.array(within), text, "0")
    try:
        decimals = pc.cast(plain, pa.decimal128(38, 18))
    except (pa.ArrowInvalid, pa.ArrowNotImplementedError):
        # More digits than the decimal holds: such a text came from a float64 anyway.
        return rough
    exact = pc.round(decimals, digits).cast(pa.decimal128(19, digits))
    words = np.frombuffer(exact.buffers()[1], np.int64)
    return words[2 * exact.offset :: 2][: len(exact)].copy()


def _from_dates(text: pa.Array, report: InputReport) -> NDArray[np.int64]:
    """Dates and times in ISO 8601; each distinct text is read once."""
    encoded = text.dictionary_encode()
    stamps = np.full(len(encoded.dictionary), UNKNOWN_NS)
    local = False
    for k, word in enumerate(encoded.dictionary.to_pylist()):
        try:
            moment = datetime.fromisoformat(word.replace(",", "."))
        except ValueError:
            continue
        if moment.tzinfo is None:
            local, moment = True, moment.replace(tzinfo=UTC)
        whole = int(moment.replace(microsecond=0).timestamp())
        stamps[k] = whole * 10**9 + moment.microsecond * 1000
    if local:
        report.note(Treatment.REPAIRED, "times name no time zone; they are taken as UTC")
    return stamps[np.array(encoded.indices, dtype=np.intp)]
