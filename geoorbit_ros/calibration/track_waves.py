"""Remembers a column of numbers per track, and orders rows so that tracks go on side by side.

A track's filters need its rows one after another; tracks don't need each other. So the rows of a
block of frames are taken in waves: first the first row of every track, then the second of every
track that has one, and so on. A block needs as many rounds as its longest track has rows, however
many frames it has.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from geoorbit_ros.core.tables import order_by_id

FORGET_NS = 10_000_000_000
"""An id unseen for 10 s of data time is a new vehicle when it comes back. Chosen: longer joins
vehicles that share an id, shorter forgets a vehicle behind another."""
SWEEP_NS = 1_000_000_000
"""Period of looking for such ids. Chosen: shorter costs time, longer holds more memory."""


@dataclass(frozen=True, slots=True)
class Waves:
    """The rows of some frames in the order in which filters take them.

    Wave k holds the k-th row of the first of T tracks, those with most rows.

    Attributes:
        order: (N,) the row of the frames at each place of this order.
        bounds: (W + 1,) rows of wave k are `slice(bounds[k], bounds[k + 1])`.
        fresh: (N,) in this order: the filters begin anew.
        state: (S, T) column of each track, to be changed in place.
        place: (T,) where it is remembered; -1: nowhere.
    """

    order: NDArray[np.intp]
    bounds: list[int]
    fresh: NDArray[np.bool_]
    state: NDArray[np.float64]
    place: NDArray[np.intp]


class TrackMemory:
    """A column of numbers per track, kept while the track was seen in the last ten seconds.

    What it gives depends on stamps and ids alone, never on when old tracks are swept, nor on how
    frames are put together into calls.

    Args:
        rows: How many numbers a track has.
    """

    def __init__(self, rows: int) -> None:
        self._place: dict[int, int] = {}
        self._free: list[int] = []
        self._last_ns = np.zeros(0, dtype=np.int64)
        self._state = np.zeros((0, rows))
        self._sweep_ns: int | None = None

    def __len__(self) -> int:
        return len(self._place)

    def enter(self, stamp_ns: NDArray[np.int64], track_id: NDArray[np.int32]) -> Waves:
        """Order rows into waves, with what is remembered of their tracks.

        Args:
            stamp_ns: (N,) capture times, none earlier than another before it or in calls before.
            track_id: (N,) negative ids are detections without identity, new every time.
        """
        order, bounds, last = _order(track_id)
        stamp, tracks = stamp_ns[order], bounds[1]
        ids = track_id[order[:tracks]].tolist()
        place = np.array([self._place.get(k, -1) for k in ids], dtype=np.intp)
        old = place >= 0
        state = np.zeros((self._state.shape[1], tracks))
        state[:, old] = self._state[place[old]].T
        fresh = np.ones(len(order), dtype=bool)
        fresh[:tracks][old] = stamp[:tracks][old] - self._last_ns[place[old]] > FORGET_NS
        if len(bounds) > 2:
            fresh[tracks:] = stamp[tracks:] - _one_before(stamp, bounds) > FORGET_NS
        for k in (~old).nonzero()[0].tolist():
            if ids[k] >= 0:
                place[k] = self._new(ids[k])
        named = place >= 0
        self._last_ns[place[named]] = stamp_ns[last[named]]
        return Waves(order, bounds, fresh, state, place)

    def leave(self, waves: Waves, stamp_ns: int) -> None:
        """Keep what became of tracks that entered; forget those that are gone.

        Args:
            waves: What `enter` gave, with its state changed.
            stamp_ns: Capture time of the last frame.
        """
        named = waves.place >= 0
        self._state[waves.place[named]] = waves.state[:, named].T
        if self._sweep_ns is not None and stamp_ns - self._sweep_ns < SWEEP_NS:
            return
        self._sweep_ns = stamp_ns
        old = stamp_ns - self._last_ns > FORGET_NS
        gone = [key for key, place in self._place.items() if old[place]]
        self._free.extend(self._place.pop(key) for key in gone)

    def _new(self, track_id: int) -> int:
        if not self._free:
            size = len(self._last_ns)
            more = max(64, size)
            self._last_ns = np.append(self._last_ns, np.zeros(more, dtype=np.int64))
            self._state = np.concatenate((self._state, np.zeros((more, self._state.shape[1]))))
            self._free = list(range(size + more - 1, size - 1, -1))
        place = self._place[track_id] = self._free.pop()
        return place


_Index = NDArray[np.intp]


def _order(track_id: NDArray[np.int32]) -> tuple[_Index, list[int], _Index]:
    """Order (N,) and bounds of the waves; last row (T,) of each track."""
    n = len(track_id)
    if len(set(track_id.tolist())) == n:
        every = np.arange(n)
        return every, [0, n], every
    by_track = order_by_id(track_id)
    ids = track_id[by_track]
    new = np.ones(n, dtype=bool)
    new[1:] = (ids[1:] != ids[:-1]) | (ids[1:] < 0)
    first = np.flatnonzero(new)
    count = np.diff(np.append(first, n))
    longest = np.argsort(-count, kind="stable")
    first, count = first[longest], count[longest]
    # As many tracks have more than k rows as have not 1, 2, ... or k.
    width = len(first) - np.append(0, np.cumsum(np.bincount(count)[1:-1]))
    bounds = np.append(0, np.cumsum(width))
    track = np.repeat(np.arange(len(first)), count)
    wave = np.arange(n) - np.repeat(np.cumsum(count) - count, count)
    order = np.empty(n, dtype=np.intp)
    order[bounds[wave] + track] = by_track[first[track] + wave]
    return order, bounds.tolist(), by_track[first + count - 1]


def _one_before(stamp: NDArray[np.int64], bounds: list[int]) -> NDArray[np.int64]:
    """Stamps of each track's row before, for all rows after the first wave."""
    width = np.diff(bounds)
    return stamp[np.arange(bounds[1], bounds[-1]) - np.repeat(width[:-1], width[1:])]
