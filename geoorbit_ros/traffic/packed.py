"""Measures, passages, movements as they are stored: whole numbers with the digits that tables show.

Unpacked, they give the same bytes in `tables` as what was packed, in a third of the space.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from geoorbit_ros.traffic.measures import MEASURE_DTYPE
from geoorbit_ros.traffic.movements import MOVEMENT_DTYPE
from geoorbit_ros.traffic.records import PASSAGE_DTYPE
from geoorbit_ros.traffic.tables import DECIMALS

UNKNOWN = np.iinfo(np.int32).min
"""Stands for NaN."""
DIGITS = 2
"""After the point where `tables.DECIMALS` says nothing, as in `tables.interval_table`."""
_MS_NS = 1_000_000


PACKED_MEASURE_DTYPE = np.dtype(
    [(name, "<i8" if name.endswith("_ns") else "<i4") for name in MEASURE_DTYPE.names or ()]
)
"""As `MEASURE_DTYPE`; numbers with a fraction are times 10 to the power of their digits."""

PACKED_MOVEMENT_DTYPE = np.dtype(
    [(name, "<i8" if name.endswith("_ns") else "<i4") for name in MOVEMENT_DTYPE.names or ()]
)
"""As `movements.MOVEMENT_DTYPE`, in fewer bytes."""

PACKED_PASSAGE_DTYPE = np.dtype(
    [
        ("vehicle_id", "<i8"),
        ("first_ms", "<i8"),
        ("last_ms", "<i8"),
        ("track_id", "<i4"),
        ("lane_id", "<i4"),
        ("class_id", "<i4"),
        ("length_m", "<f4"),
        ("first_arc_cm", "<i4"),
        ("last_arc_cm", "<i4"),
        ("speed_ckmh", "<i4"),
        ("speed_sigma_ckmh", "<i4"),
        ("from_lane", "<i4"),
        ("to_lane", "<i4"),
    ]
)
"""As `records.PASSAGE_DTYPE`, in milliseconds, centimetres and hundredths of km/h."""
_AS_THEY_ARE = ("vehicle_id", "track_id", "lane_id", "class_id", "from_lane", "to_lane", "length_m")
_SCALES = {
    "first_arc_m": ("first_arc_cm", 100.0),
    "last_arc_m": ("last_arc_cm", 100.0),
    "speed_mps": ("speed_ckmh", 360.0),
    "speed_sigma_mps": ("speed_sigma_ckmh", 360.0),
}


def pack_measures(measures: NDArray[np.void]) -> NDArray[np.void]:
    """(M,) `PACKED_MEASURE_DTYPE` of `MEASURE_DTYPE`."""
    out = np.empty(len(measures), PACKED_MEASURE_DTYPE)
    for name in MEASURE_DTYPE.names or ():
        whole = MEASURE_DTYPE[name].kind != "f"
        out[name] = measures[name] if whole else _whole(measures[name] * _scale(name))
    return out


def unpack_measures(packed: NDArray[np.void]) -> NDArray[np.void]:
    """(M,) `MEASURE_DTYPE`, rounded as tables show it; a measure that isn't there is NaN."""
    out = np.zeros(len(packed), MEASURE_DTYPE)
    there = packed.dtype.names or ()
    for name in MEASURE_DTYPE.names or ():
        whole = MEASURE_DTYPE[name].kind != "f"
        if name in there:
            out[name] = packed[name] if whole else _number(packed[name]) / _scale(name)
        elif not whole:
            out[name] = np.nan
    return out


def pack_passages(passages: NDArray[np.void]) -> NDArray[np.void]:
    """(P,) `PACKED_PASSAGE_DTYPE` of `PASSAGE_DTYPE`."""
    out = np.empty(len(passages), PACKED_PASSAGE_DTYPE)
    for name in _AS_THEY_ARE:
        out[name] = passages[name]
    for end in ("first", "last"):
        out[f"{end}_ms"] = np.round(passages[f"{end}_ns"] / _MS_NS)
    for name, (packed, scale) in _SCALES.items():
        shown = 3.6 * passages[name] if scale == 360.0 else passages[name]
        out[packed] = _whole(shown * 100.0)
    return out


def unpack_passages(packed: NDArray[np.void]) -> NDArray[np.void]:
    """(P,) `PASSAGE_DTYPE`."""
    out = np.zeros(len(packed), PASSAGE_DTYPE)
    if not len(packed):
        return out
    for name in _AS_THEY_ARE:
        out[name] = packed[name]
    for end in ("first", "last"):
        out[f"{end}_ns"] = packed[f"{end}_ms"] * _MS_NS
    for name, (stored, scale) in _SCALES.items():
        out[name] = _number(packed[stored]) / scale
    return out


def _scale(name: str) -> float:
    return float(10 ** DECIMALS.get(name, DIGITS))


def _whole(value: NDArray[np.float64]) -> NDArray[np.int64]:
    known = np.isfinite(value)
    limit = float(np.iinfo(np.int32).max)
    rounded = np.rint(np.clip(np.where(known, value, 0.0), -limit, limit))
    return np.where(known, rounded, UNKNOWN).astype(np.int64)


def _number(whole: NDArray[np.int32]) -> NDArray[np.float64]:
    return np.where(whole == UNKNOWN, np.nan, whole.astype(np.float64))
