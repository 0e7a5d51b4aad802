"""Rows of tracks as columns: what lanes are derived from, a tenth of a frame's bytes."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from geoorbit_ros.core.tables import (
    FLAG_PREDICTED,
    FLAG_TRUNCATED,
    LARGE_CLASSES,
    TRACK_DTYPE,
    VEHICLE_CLASSES,
)

MIN_SIGMA_M = 0.02
"""Least error of a row, so that a track that says 0 does not outweigh all others. Chosen: larger
levels exact tracks, smaller lets one row decide alone."""


@dataclass(frozen=True, slots=True)
class TrackRows:
    """N rows of tracks from which lanes can be derived, column by column.

    Attributes:
        time_s: (N,) capture time, seconds since the evidence's epoch.
        track: (N,) track id.
        x: (N,) map frame, metres.
        y: (N,) map frame, metres.
        sigma: (N,) 1-sigma ground error, metres.
        large: (N,) 1 for a bus or a truck, else 0.
        vehicle: (N,) 1 for a class that drives in lanes, else 0.
    """

    time_s: NDArray[np.float64]
    track: NDArray[np.int32]
    x: NDArray[np.float64]
    y: NDArray[np.float64]
    sigma: NDArray[np.float64]
    large: NDArray[np.float64]
    vehicle: NDArray[np.float64]

    def __len__(self) -> int:
        return len(self.time_s)

    def columns(self) -> tuple[NDArray[Any], ...]:
        """All columns, in the order of the attributes."""
        return self.time_s, self.track, self.x, self.y, self.sigma, self.large, self.vehicle

    def take(self, index: NDArray[np.int64]) -> TrackRows:
        """The rows `index`."""
        return TrackRows(*(column.take(index) for column in self.columns()))

    def followed_by(self, other: TrackRows) -> TrackRows:
        """These rows and then the other ones."""
        if len(self) == 0:
            return other
        pairs = zip(self.columns(), other.columns(), strict=True)
        return TrackRows(*(np.concatenate(pair) for pair in pairs))


def usable_rows(
    time_s: NDArray[np.float64], rows: NDArray[np.void], max_sigma_m: float
) -> TrackRows:
    """Observed, whole and sufficiently certain rows.

    Args:
        time_s: (N,) capture times.
        rows: (N,) `TRACK_DTYPE`.
        max_sigma_m: Rows less certain than this are left out.
    """
    usable = (rows["flags"] & (FLAG_PREDICTED | FLAG_TRUNCATED)) == 0
    usable &= rows["sigma"] <= max_sigma_m
    index = np.flatnonzero(usable)
    kind = rows["class_id"][index]
    return TrackRows(
        time_s[index],
        rows["track_id"][index],
        rows["x"][index].astype(np.float64),
        rows["y"][index].astype(np.float64),
        np.maximum(rows["sigma"][index].astype(np.float64), MIN_SIGMA_M),
        _is_any(kind, LARGE_CLASSES),
        _is_any(kind, VEHICLE_CLASSES),
    )


def no_rows() -> TrackRows:
    """Nothing seen yet."""
    return usable_rows(np.empty(0), np.empty(0, TRACK_DTYPE), 0.0)


def order_by_track(track: NDArray[np.int32]) -> NDArray[np.int64]:
    """Order by track id; rows arrive in time order, so a stable sort keeps each track's in it."""
    from_zero = track - track.min()
    # numpy sorts 16-bit integers in linear time, six times as fast.
    small = from_zero.max() < 2**16
    return np.argsort(from_zero.astype(np.uint16) if small else track, kind="stable")


def _is_any(kind: NDArray[np.int32], classes: tuple[int, ...]) -> NDArray[np.float64]:
    return np.asarray(np.logical_or.reduce([kind == k for k in classes]), np.float64)
