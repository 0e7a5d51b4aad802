"""Evidence: the segments a camera remembers, in bounded memory, however long it runs."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np
from numpy.typing import NDArray

from geoorbit_ros.core.tables import TRACK_DTYPE
from geoorbit_ros.lanes.estimators.curvilinear.grouped import changes, lengths
from geoorbit_ros.lanes.estimators.curvilinear.track_rows import (
    TrackRows,
    no_rows,
    order_by_track,
    usable_rows,
)
from geoorbit_ros.lanes.estimators.curvilinear.trajectory_segments import (
    MAX_GAP_S,
    MAX_PIECE_S,
    TrajectorySegments,
    concatenate,
    condense,
    newest,
    no_segments,
    select,
)
from geoorbit_ros.lanes.estimators.estimator import State

MAX_SEGMENTS = 1500
"""Newest segments kept: ten minutes of a busy motorway, most of a day on a quiet road. Chosen: more
make centrelines steadier but derivations slower and changes of the road later to show."""
MAX_SURPLUS = 1.2
"""They are trimmed when there are so many times as many, not at each new one. Chosen: larger takes
more memory, smaller copies more often."""
HALF_LIFE_S = 6 * 3600.0
"""Time after which a segment counts half: a work zone shows by the next rush hour. Chosen: longer
follows changes later, shorter forgets lanes over a quiet night."""
FRAME_PERIOD_S = 1.0 / 15.0
"""One frame per period is enough: what is wrong with a box is alike from frame to frame. Chosen:
longer leaves fast vehicles few rows, shorter costs time."""
MAX_SIGMA_M = 2.0
"""Rows less certain than this are not used. Chosen: half a lane and a little; larger
blurs neighbouring lanes, smaller ends lanes nearer to the camera."""


class Evidence:
    """Collects track rows and turns finished tracks into segments."""

    def __init__(
        self,
        max_segments: int = MAX_SEGMENTS,
        half_life_s: float = HALF_LIFE_S,
        max_sigma_m: float = MAX_SIGMA_M,
    ) -> None:
        self._max_passes = max_segments
        self._half_life_s = half_life_s
        self._max_sigma_m = max_sigma_m
        self._epoch_ns: int | None = None
        self._now_ns = 0
        self._stamps: list[int] = []
        self._chunks: list[bytes] = []
        self._frame = (-1.0, -1.0)
        self._open = no_rows()
        self._finished = [no_segments()]
        self._finished_ever = 0

    @property
    def stamp_ns(self) -> int:
        """Capture time of the newest row."""
        return self._stamps[-1] if self._stamps else self._now_ns

    def add(self, stamp_ns: int, rows: NDArray[np.void]) -> None:
        """Take one frame; rows are copied."""
        self._stamps.append(stamp_ns)
        self._chunks.append(rows.tobytes())

    def segments(self) -> tuple[TrajectorySegments, NDArray[np.float64]]:
        """All segments, finished ones first, and the weight (P,) of each by its age."""
        now_s = self.settle()
        self._finished = [self._trim(concatenate(self._finished), now_s)]
        every = concatenate([*self._finished, condense(self._open)])
        return every, self._weight(every, now_s)

    def finished(self) -> int:
        """Segments finished since the beginning, those forgotten included."""
        self.settle()
        return self._finished_ever

    def finished_after(self, count: int, stamp_ns: int) -> TrajectorySegments:
        """Segments finished after the first `count` that also began after `stamp_ns`."""
        wanted, parts = self.finished() - count, list[TrajectorySegments]()
        for part in reversed(self._finished):
            if sum(map(len, parts)) >= wanted:
                break
            parts.insert(0, part)
        new = newest(concatenate(parts), wanted)
        begin_s = new.time_s[new.offset[:-1]]
        return select(new, begin_s > (stamp_ns - (self._epoch_ns or 0)) * 1e-9)

    def state(self) -> State:
        """What is remembered, but for vehicles still in view."""
        self.settle()
        times = np.array([self._epoch_ns or 0, self._now_ns, self._finished_ever], np.int64)
        return pack_segments(concatenate(self._finished)) | {"evidence": times}

    def restore(self, state: Mapping[str, NDArray[Any]], stamp_ns: int) -> None:
        """Go on from `state` with a frame at `stamp_ns`; where that is earlier, time is moved.

        Raises:
            KeyError, ValueError: Not such a state.
        """
        self._finished = [unpack_segments(state)]
        epoch_ns, now_ns, self._finished_ever = (int(value) for value in state["evidence"])
        self._now_ns = min(now_ns, stamp_ns - 1)
        self._epoch_ns = epoch_ns + self._now_ns - now_ns

    def settle(self) -> float:
        """Move tracks that have ended from rows to segments; return the time in seconds."""
        rows = self._open.followed_by(self._fresh_rows()) if self._chunks else no_rows()
        now_s = (self._now_ns - (self._epoch_ns or 0)) * 1e-9
        if len(rows) == 0:
            return now_s
        order = order_by_track(rows.track)
        track, time_s = rows.track[order], rows.time_s[order]
        new = changes(track)
        new[1:] |= np.diff(time_s) > MAX_GAP_S
        first = np.flatnonzero(new)
        counts = lengths(first, len(rows))
        begin_s, end_s = time_s[first], time_s[first + counts - 1]
        # All of a track that has ended, and the whole pieces of one that goes on.
        until_s = begin_s + MAX_PIECE_S * np.floor((end_s - begin_s) / MAX_PIECE_S)
        until_s[end_s < now_s - MAX_GAP_S] = np.inf
        done = time_s < np.repeat(until_s, counts)
        part = condense(rows.take(order[done]))
        self._finished_ever += len(part)
        self._finished.append(part)
        if sum(map(len, self._finished)) > MAX_SURPLUS * self._max_passes:
            self._finished = [self._trim(concatenate(self._finished), now_s)]
        self._open = rows.take(order[~done])
        return now_s

    def _fresh_rows(self) -> TrackRows:
        """The rows that came since the last call."""
        if not self._chunks:
            return no_rows()
        if self._epoch_ns is None:
            self._epoch_ns = self._stamps[0]
        self._now_ns = self._stamps[-1]
        time_s = (np.array(self._stamps) - self._epoch_ns) * 1e-9
        # The first frame of each period, in as many calls as it came.
        period = np.floor(time_s / FRAME_PERIOD_S + 0.25)
        new = changes(np.append(self._frame[0], period))[1:]
        frame_s = np.append(self._frame[1], time_s[new])[np.cumsum(new)]
        self._frame = float(period[-1]), float(frame_s[-1])
        index = np.flatnonzero(time_s == frame_s)
        # Joining bytes is far cheaper than concatenating thousands of structured arrays.
        chunks = [self._chunks[k] for k in index.tolist()]
        rows = np.frombuffer(b"".join(chunks), TRACK_DTYPE)
        counts = [len(chunk) // TRACK_DTYPE.itemsize for chunk in chunks]
        self._stamps, self._chunks = [], []
        return usable_rows(np.repeat(time_s[index], counts), rows, self._max_sigma_m)

    def _weight(self, segments: TrajectorySegments, now_s: float) -> NDArray[np.float64]:
        end = segments.time_s[segments.offset[1:] - 1] if len(segments) else np.empty(0)
        return np.asarray(0.5 ** ((now_s - end) / self._half_life_s))

    def _trim(self, segments: TrajectorySegments, now_s: float) -> TrajectorySegments:
        weight = self._weight(segments, now_s)
        keep = weight > 0.02
        if keep.sum() > self._max_passes:
            keep &= weight >= np.partition(weight, -self._max_passes)[-self._max_passes]
        return segments if keep.all() else select(segments, keep)


def pack_segments(segments: TrajectorySegments) -> State:
    """The arrays of `TrajectorySegments`."""
    return {
        "segments_xy": segments.xy,
        "segments_sigma": segments.sigma,
        "segments_heading": segments.heading,
        "segments_time_s": segments.time_s,
        "segments_offset": segments.offset,
        "segments_large": segments.large,
    }


def unpack_segments(state: Mapping[str, NDArray[Any]]) -> TrajectorySegments:
    """The inverse of `pack_segments`.

    Raises:
        KeyError, ValueError: Arrays that are missing or don't fit together.
    """
    names = ("xy", "sigma", "heading", "time_s", "offset", "large")
    segments = TrajectorySegments(*(state[f"segments_{name}"] for name in names))
    nodes = int(segments.offset[-1])
    if segments.xy.shape != (nodes, 2) or len(segments.large) != len(segments):
        raise ValueError(
            f"{len(segments)} segments, {segments.xy.shape} nodes, offset ends at {nodes}"
        )
    return segments
