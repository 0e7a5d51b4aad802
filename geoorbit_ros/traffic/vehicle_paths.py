"""From ground tracks to the paths of vehicles: a track that breaks goes on in the next one.

Only what was seen up to one moment decides, and moments come from the data, never from how rows are
handed over: frame by frame, in blocks, or all at once gives the same paths.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from geoorbit_ros.core.errors import TableError
from geoorbit_ros.core.tables import (
    FLAG_GROUND_POINT,
    FLAG_PREDICTED,
    TRACK_DTYPE,
    Frames,
    order_by_id,
)
from geoorbit_ros.traffic.track_links import Fragment, Links, are_pauses, cut_ns

BIN_NS = 100_000_000
"""Of each track one row in every tenth of a second is kept. Chosen: a vehicle drives three metres
in it at 108 km/h; more rows have the same errors and cost time."""
SPLIT_NS = 10_000_000_000
"""An id that is not seen for this long names another vehicle when it comes back, as for the
projector (`calibration.track_velocity`)."""

PAUSE_NS, SPEED_ROWS = 1_000_000_000, 5
"""After a pause of a second an id's speed before it, over half a second, says where it can be."""
JUMP_M, BRAKING_MPS2 = 10.0, 3.0
"""Distance from that place at which an id has gone over to another vehicle: a short vehicle's two
lengths, and what hard braking (AASHTO's 3.4 m/s2) makes, by half more."""

PATH_DTYPE = np.dtype(
    [
        ("stamp_ns", "<i8"),
        ("track_id", "<i8"),
        ("x", "<f8"),
        ("y", "<f8"),
        ("sigma", "<f8"),
        ("score", "<f4"),
        ("length", "<f4"),
        ("class_id", "<i4"),
    ]
)
"""A place of a vehicle: metres in the map frame, with the 1-sigma error of its track's row."""


@dataclass(frozen=True, slots=True)
class Paths:
    """Paths of vehicles that are gone, ordered by when they were last seen.

    Attributes:
        offset: (V + 1,) rows of vehicle k are `rows[offset[k]:offset[k + 1]]`.
        rows: `PATH_DTYPE`, each vehicle's in time order.
    """

    offset: NDArray[np.int64]
    rows: NDArray[np.void]

    def __len__(self) -> int:
        return len(self.offset) - 1

    def __iter__(self) -> Iterator[NDArray[np.void]]:
        return (self.rows[a:b] for a, b in zip(self.offset[:-1], self.offset[1:], strict=True))

    @property
    def owner(self) -> NDArray[np.int64]:
        """(N,) number of the vehicle of each row."""
        return np.repeat(np.arange(len(self)), np.diff(self.offset))


@dataclass(slots=True)
class PathCollector:
    """Takes ground tracks in time order and gives whole paths of vehicles that are gone.

    Attributes:
        links: Decides which track goes on in which.
    """

    links: Links = field(default_factory=Links)
    _waiting: list[NDArray[np.void]] = field(default_factory=list)
    _oldest_ns: int | None = None
    _newest_ns: int | None = None

    def add(self, frames: Frames) -> None:
        """Take frames of `TRACK_DTYPE`, later than those before.

        Raises:
            TableError: Rows of another kind, or earlier frames.
        """
        if frames.rows.dtype != TRACK_DTYPE:
            raise TableError("ground tracks", frames.rows.dtype, str(TRACK_DTYPE))
        if not len(frames):
            return
        if self._newest_ns is not None and frames.stamp_ns[0] <= self._newest_ns:
            found = f"stamp {frames.stamp_ns[0]} ns after {self._newest_ns} ns"
            raise TableError("ground tracks", found, "a later stamp")
        if self._oldest_ns is None:
            self._oldest_ns = int(frames.stamp_ns[0])
        self._newest_ns = int(frames.stamp_ns[-1])
        rows = _path_rows(frames)
        if len(rows):
            self._waiting.append(rows)

    @property
    def observed_ns(self) -> tuple[int, int]:
        """Stamps of the first and the newest frame; 0 before the first one."""
        return self._oldest_ns or 0, self._newest_ns or 0

    @property
    def open_since_ns(self) -> int | None:
        """When the first of the vehicles was first seen that `take` left; None: it left none."""
        return min((int(rows["stamp_ns"].min()) for rows in self._waiting), default=None)

    def take(self) -> Paths:
        """Paths of the vehicles that can't be seen any more at the newest frame."""
        return self._take(self._newest_ns)

    def finish(self) -> Paths:
        """All the other paths; the collector is empty afterwards."""
        paths = self._take(None)
        self._waiting.clear()
        return paths

    def _take(self, now_ns: int | None) -> Paths:
        if not self._waiting:
            return _no_paths()
        rows = np.concatenate(
            self._waiting, dtype=PATH_DTYPE
        )  # named, so that it isn't searched for
        order = np.lexsort((rows["stamp_ns"], rows["track_id"]))
        order = order[_first_of_bins(rows["stamp_ns"][order], rows["track_id"][order])]
        rows = rows.take(order)
        track = _track_numbers(rows)
        fragments = _fragments(rows, track)
        chains, open_fragments = self.links.join(fragments, now_ns)
        self._waiting = [fragment.rows for fragment in open_fragments]
        return _paths(chains)


def _path_rows(frames: Frames) -> NDArray[np.void]:
    """The rows of frames that a detection supports; of many frames, the first in each bin."""
    table, stamp_ns = frames.rows, frames.row_stamp_ns()
    seen = (table["flags"] & FLAG_PREDICTED) == 0
    seen &= np.isfinite(table["x"]) & np.isfinite(table["y"])
    kept = seen.nonzero()[0]
    if len(frames) > 1:
        kept = kept[order_by_id(table["track_id"][kept])]
        kept = kept[_first_of_bins(stamp_ns[kept], table["track_id"][kept])]
    table = table.take(kept)
    rows = np.empty(len(table), PATH_DTYPE)
    rows["stamp_ns"] = stamp_ns[kept]
    for name in PATH_DTYPE.names or ():
        if name != "stamp_ns":
            rows[name] = table[name]
    rows["length"][(table["flags"] & FLAG_GROUND_POINT) != 0] = np.nan
    return rows


def _first_of_bins(stamp_ns: NDArray[np.int64], track_id: NDArray[np.integer]) -> NDArray[np.bool_]:
    """(N,) whether a row, sorted by track and time, is its track's first in its bin."""
    bin_of = stamp_ns // BIN_NS
    first = np.ones(len(bin_of), np.bool_)
    first[1:] = (bin_of[1:] != bin_of[:-1]) | (track_id[1:] != track_id[:-1])
    return first


def _track_numbers(rows: NDArray[np.void]) -> NDArray[np.int64]:
    """(N,) number of the track of each sorted row.

    An id that pauses for long starts anew, and so does one that comes back where no vehicle with
    its speed can be: some trackers give the ids of vehicles that are gone to new ones.
    """
    begins = np.ones(len(rows), np.bool_)
    begins[1:] = (np.diff(rows["track_id"]) != 0) | (np.diff(rows["stamp_ns"]) > SPLIT_NS)
    pauses = np.flatnonzero(~begins[1:] & (np.diff(rows["stamp_ns"]) > PAUSE_NS)) + 1
    before = np.maximum(pauses - SPEED_ROWS, 0)
    known = (rows["track_id"][before] == rows["track_id"][pauses]) & (before < pauses - 1)
    time_s = (rows["stamp_ns"][pauses] - rows["stamp_ns"][pauses - 1]) * 1e-9
    span_s = np.maximum((rows["stamp_ns"][pauses - 1] - rows["stamp_ns"][before]) * 1e-9, 0.1)
    error = np.zeros(len(pauses))
    for name in ("x", "y"):
        speed = (rows[name][pauses - 1] - rows[name][before]) / span_s
        error = np.hypot(error, rows[name][pauses] - rows[name][pauses - 1] - speed * time_s)
    allowed = JUMP_M + 3.0 * (rows["sigma"][pauses] + rows["sigma"][pauses - 1])
    allowed = allowed + 1.5 * BRAKING_MPS2 * time_s**2 / 2.0
    begins[pauses[known & (error > allowed)]] = True
    return np.cumsum(begins) - 1


def _fragments(rows: NDArray[np.void], track: NDArray[np.int64]) -> list[Fragment]:
    """Tracks, in parts where they are very long (`track_links.LONGEST_NS`)."""
    begin = np.flatnonzero(np.diff(track, prepend=-1))
    end = np.append(begin[1:], len(rows))
    stamps = rows["stamp_ns"]
    pauses = np.append(0, np.cumsum(are_pauses(stamps)))  # before each row, those of all tracks
    found = list[Fragment]()
    bounds = zip(
        begin.tolist(),
        end.tolist(),
        rows["track_id"][begin].tolist(),
        stamps[begin].tolist(),
        stamps[end - 1].tolist(),
        (pauses[end - 1] > pauses[begin]).tolist(),
        strict=True,
    )
    for a, b, track_id, first_ns, last_ns, paused in bounds:
        while (at_ns := cut_ns(first_ns)) <= last_ns:
            c = a + int(np.searchsorted(stamps[a:b], at_ns))
            part_pauses = bool(pauses[c - 1] > pauses[a])
            before_ns, next_ns = int(stamps[c - 1]), int(stamps[c])
            found.append(Fragment(track_id, rows[a:c], first_ns, before_ns, part_pauses, next_ns))
            a, first_ns, paused = c, next_ns, bool(pauses[b - 1] > pauses[c])
        found.append(Fragment(track_id, rows[a:b], first_ns, last_ns, paused))
    return found


def _no_paths() -> Paths:
    return Paths(np.zeros(1, np.int64), np.empty(0, PATH_DTYPE))


def _paths(chains: list[list[Fragment]]) -> Paths:
    if not chains:
        return _no_paths()
    counts = [sum(len(fragment.rows) for fragment in chain) for chain in chains]
    offset = np.append(0, np.cumsum(counts)).astype(np.int64)
    parts = [fragment.rows for chain in chains for fragment in chain]
    rows = np.concatenate(parts, dtype=PATH_DTYPE)
    vehicle = np.repeat(np.arange(len(chains)), counts)
    return Paths(offset, rows.take(np.lexsort((rows["stamp_ns"], vehicle))))
