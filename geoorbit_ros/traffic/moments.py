"""Where each track is, half second by half second, and in which lane: what events are read from.

A half second is complete when a frame after it comes, so that the same rows give the same moments
however frames are handed over.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from geoorbit_ros.core.errors import TableError
from geoorbit_ros.core.lane_order import OPPOSITE_COS, SAME_COS
from geoorbit_ros.core.lanes import Lane
from geoorbit_ros.core.tables import (
    FLAG_PREDICTED,
    TRACK_DTYPE,
    VEHICLE_CLASSES,
    Frames,
)
from geoorbit_ros.traffic.lane_sequence import BEYOND_M
from geoorbit_ros.traffic.road_coordinates import RoadCoordinates

Array = NDArray[np.float64]

TICK_NS = 500_000_000
"""Length of a moment. Chosen: longer blurs fast vehicles over a view of 40 m, shorter leaves the
noise of single boxes."""
JOIN_NS = 1_500_000_000
"""A velocity joins moments of a track up to this far apart. Chosen: two moments may be missed."""
MOVES_MPS = 3.0
"""A faster vehicle has a direction. Chosen: half-second steps of a standing vehicle are slower,
with errors of a metre."""

_ROW = np.dtype(
    [("stamp_ns", "<i8"), ("tick", "<i8"), ("track_id", "<i8")]
    + [(name, "<f8") for name in ("x", "y", "sigma", "length")]
)

MOMENT_DTYPE = np.dtype(
    [
        ("tick", "<i8"),
        ("stamp_ns", "<i8"),
        ("track_id", "<i8"),
        ("x", "<f8"),
        ("y", "<f8"),
        ("sigma", "<f8"),
        ("length", "<f8"),
        ("vx", "<f8"),
        ("vy", "<f8"),
        ("within_x", "<f8"),
        ("within_y", "<f8"),
        ("lane", "<i8"),
        ("arc", "<f8"),
        ("offset", "<f8"),
        ("half_width", "<f8"),
        ("heading", "<f8"),
        ("way", "<i8"),
        ("own_gap", "<f8"),
    ]
)


class Moment(NamedTuple):
    """One track in one half second.

    Attributes:
        tick: Number of the half second since 1970.
        stamp_ns: Mean time of its rows.
        track_id: The track.
        x, y: Mean place, metres in the map frame.
        sigma: Expected 1-sigma error of a row.
        length: Length of the vehicle as learnt so far, NaN if unknown.
        vx, vy: Velocity since the track's moment before, m/s; NaN at its first one.
        within_x, within_y: Velocity within the half second; NaN where a single row is there.
        lane: Index of the lane that the place is in, -1 for none.
        arc: Metres along that lane.
        offset: Metres left of its middle.
        half_width: Half its width there.
        heading: Its direction there, radians CCW from east.
        way: 1 the vehicle moves along the lane, -1 against it, 0 neither.
        own_gap: Metres to the edge of the nearest lane that leads the way the vehicle moves,
            negative within it; infinite where none is near.
    """

    tick: int
    stamp_ns: int
    track_id: int
    x: float
    y: float
    sigma: float
    length: float
    vx: float
    vy: float
    within_x: float
    within_y: float
    lane: int
    arc: float
    offset: float
    half_width: float
    heading: float
    way: int
    own_gap: float


@dataclass(slots=True)
class _Pending:
    """What has come since the newest complete half second."""

    rows: list[NDArray[np.void]]
    stamps: list[NDArray[np.int64]]


class MomentCollector:
    """Makes moments of ground tracks on the lanes of a map.

    Args:
        lanes: The lanes, in the tracks' frame; at least one.
    """

    def __init__(self, lanes: Sequence[Lane]) -> None:
        self._pending = _Pending([], [])
        self._last = np.empty(0, MOMENT_DTYPE)
        self._newest_ns: int | None = None
        self.use_lanes(lanes)

    def use_lanes(self, lanes: Sequence[Lane]) -> None:
        """Place vehicles on these lanes from now on."""
        self.roads = RoadCoordinates(lanes)

    def add(self, frames: Frames) -> Iterator[tuple[int, int, list[Moment]]]:
        """Take frames, later than those before.

        Yields:
            Number of each half second that is complete and had a frame, the stamp of its last
            frame, and its moments in order of their ids.

        Raises:
            TableError: Rows of another kind, or earlier frames.
        """
        if frames.rows.dtype != TRACK_DTYPE:
            raise TableError("ground tracks", frames.rows.dtype, str(TRACK_DTYPE))
        if not len(frames):
            return iter(())
        if self._newest_ns is not None and frames.stamp_ns[0] <= self._newest_ns:
            found = f"stamp {frames.stamp_ns[0]} ns after {self._newest_ns} ns"
            raise TableError("ground tracks", found, "a later stamp")
        before = self._newest_ns
        self._newest_ns = int(frames.stamp_ns[-1])
        self._pending.rows.append(_vehicle_rows(frames))
        self._pending.stamps.append(frames.stamp_ns)
        now = self._newest_ns // TICK_NS
        if before is not None and now == before // TICK_NS:
            return iter(())
        return self._complete(now)

    def place(self, x: float, y: float) -> Moment:
        """The moment of something that stands at a place, at no time."""
        out = np.zeros(1, MOMENT_DTYPE)
        out["x"], out["y"] = x, y
        self._add_lanes(out)
        return Moment._make(out[0].tolist())

    def _complete(self, now: int) -> Iterator[tuple[int, int, list[Moment]]]:
        """Ticks before `now`."""
        stamps = np.concatenate(self._pending.stamps)
        rows = np.concatenate(self._pending.rows)
        frame = int(np.searchsorted(stamps, now * TICK_NS))
        row = int(np.searchsorted(rows["tick"], now))
        self._pending = _Pending([rows[row:]], [stamps[frame:]])
        moments = self._moments(rows[:row])
        return _by_tick(stamps[:frame], moments)

    def _moments(self, rows: NDArray[np.void]) -> NDArray[np.void]:
        rows = rows[np.lexsort((rows["track_id"], rows["tick"]))]
        changed = np.diff(rows["tick"], prepend=-1) != 0
        changed |= np.diff(rows["track_id"], prepend=-1) != 0
        begin = np.flatnonzero(changed)
        end = np.append(begin[1:], len(rows)) - 1 if len(begin) else begin
        group = np.cumsum(changed) - 1
        out = np.zeros(len(begin), MOMENT_DTYPE)
        count = np.bincount(group, minlength=len(begin))
        for name in ("x", "y", "sigma"):
            out[name] = np.bincount(group, rows[name], len(begin)) / np.maximum(count, 1)
        since = (rows["stamp_ns"] - rows["tick"] * TICK_NS).astype(np.float64)
        mean_ns = np.bincount(group, since, len(begin)) / np.maximum(count, 1)
        for name in ("tick", "track_id"):
            out[name] = rows[name][begin]
        out["length"] = rows["length"][end]
        out["stamp_ns"] = out["tick"] * TICK_NS + np.round(mean_ns).astype(np.int64)
        time_s = (rows["stamp_ns"][end] - rows["stamp_ns"][begin]) * 1e-9
        time_s = np.where(time_s > 0.1, time_s, np.nan)
        for axis in ("x", "y"):
            out["within_" + axis] = (rows[axis][end] - rows[axis][begin]) / time_s
        self._add_velocities(out)
        self._add_lanes(out)
        return out

    def _add_velocities(self, out: NDArray[np.void]) -> None:
        """Fill `vx`, `vy` by each track's moment before, and remember the last ones."""
        both = np.concatenate((self._last, out))
        order = np.lexsort((both["tick"], both["track_id"]))
        ordered = both[order]
        same = np.diff(ordered["track_id"], prepend=ordered["track_id"][:1] - 1) == 0
        step_ns = np.diff(ordered["stamp_ns"], prepend=0)
        time_s = np.where(same & (step_ns <= JOIN_NS), step_ns * 1e-9, np.nan)
        for axis in ("x", "y"):
            velocity = np.empty(len(both))
            velocity[order] = np.diff(ordered[axis], prepend=0.0) / time_s
            out["v" + axis] = velocity[len(self._last) :]
        if not len(both):
            return
        newest = np.append(~same[1:], True)
        kept = ordered[newest]
        self._last = kept[kept["stamp_ns"] > both["stamp_ns"].max() - JOIN_NS]

    def _add_lanes(self, out: NDArray[np.void]) -> None:
        places = self.roads.at(np.column_stack((out["x"], out["y"])))
        aside = np.abs(places.offset_m)
        along = (places.arc_m >= -BEYOND_M) & (places.arc_m <= self.roads.length_m + BEYOND_M)
        aside = np.where(along, aside, np.inf)
        index = np.arange(len(out))
        lane = aside.argmin(axis=1) if len(out) else np.empty(0, np.int64)
        within = aside[index, lane] <= places.half_width_m[index, lane]
        out["lane"] = np.where(within, lane, -1)
        for name, table in (
            ("arc", places.arc_m),
            ("offset", places.offset_m),
            ("half_width", places.half_width_m),
            ("heading", places.heading_rad),
        ):
            out[name] = table[index, lane]
        velocity = np.column_stack((out["vx"], out["vy"]))
        inside = np.column_stack((out["within_x"], out["within_y"]))
        velocity = np.where(np.isnan(velocity), inside, velocity)
        speed = np.hypot(*velocity.T)
        moves = speed >= MOVES_MPS
        heading = np.arctan2(velocity[:, 1], velocity[:, 0])
        with np.errstate(invalid="ignore"):
            cos = np.cos(places.heading_rad - heading[:, None])
        out["way"] = np.where(moves & (cos[index, lane] > SAME_COS), 1, 0)
        out["way"][moves & (cos[index, lane] < OPPOSITE_COS)] = -1
        gap = np.where((cos > SAME_COS) & moves[:, None], aside - places.half_width_m, np.inf)
        out["own_gap"] = gap.min(axis=1)


def _vehicle_rows(frames: Frames) -> NDArray[np.void]:
    """The rows of frames that a detection of a vehicle supports."""
    table = frames.rows
    seen = (table["flags"] & FLAG_PREDICTED) == 0
    seen &= np.isfinite(table["x"]) & np.isfinite(table["y"])
    seen &= np.isin(table["class_id"], VEHICLE_CLASSES)
    rows = np.empty(int(np.count_nonzero(seen)), _ROW)
    rows["stamp_ns"] = frames.row_stamp_ns()[seen]
    rows["tick"] = rows["stamp_ns"] // TICK_NS
    for name in ("track_id", "x", "y", "sigma", "length"):
        rows[name] = table[name][seen]
    return rows


def _by_tick(
    stamps: NDArray[np.int64], moments: NDArray[np.void]
) -> Iterator[tuple[int, int, list[Moment]]]:
    ticks, last = np.unique(stamps[::-1] // TICK_NS, return_index=True)
    begin = np.searchsorted(moments["tick"], ticks)
    end = np.searchsorted(moments["tick"], ticks, side="right")
    newest = stamps[::-1][last]
    for tick, stamp_ns, a, b in zip(
        ticks.tolist(), newest.tolist(), begin.tolist(), end.tolist(), strict=True
    ):
        yield tick, stamp_ns, [Moment._make(row) for row in moments[a:b].tolist()]
