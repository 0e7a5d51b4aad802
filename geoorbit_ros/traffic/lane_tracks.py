"""Vehicles in time and space: where along their lanes they were at which time, and how fast."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from geoorbit_ros.core.lanes import Lane
from geoorbit_ros.core.tables import Frames
from geoorbit_ros.traffic.lane_sequence import LaneMatcher, cut_at_oncoming
from geoorbit_ros.traffic.passages import find_runs
from geoorbit_ros.traffic.road_coordinates import RoadCoordinates
from geoorbit_ros.traffic.vehicle_paths import BIN_NS, PathCollector

Array = NDArray[np.float64]

SMOOTH_S = 1.0
"""A speed is that between this long before and after. Chosen: a shorter time shows the noise of
boxes far off, a longer one hides braking."""

LANE_TRACK_DTYPE = np.dtype(
    [
        ("run", "<i8"),
        ("lane_id", "<i8"),
        ("stamp_ns", "<i8"),
        ("arc_m", "<f8"),
        ("speed_mps", "<f8"),
    ]
)
"""A place of a vehicle along its lane. Rows of one `run` are those of one vehicle in one lane, in
time order; `arc_m` counts along the centreline from its beginning."""


def lane_tracks(lanes: Sequence[Lane], frames: Frames) -> NDArray[np.void]:
    """The vehicles of some frames in their lanes, as the counter sees them.

    Args:
        lanes: The lanes, in the tracks' frame; at least one.
        frames: Frames of `TRACK_DTYPE`.

    Returns:
        (N,) `LANE_TRACK_DTYPE`, ordered by run and time.
    """
    collector = PathCollector()
    collector.add(frames)
    paths = collector.finish()
    found = LaneMatcher(RoadCoordinates(lanes)).lanes_of(paths)
    runs = find_runs(cut_at_oncoming(paths, found), found)
    lane = runs.lane[runs.run]
    out = np.zeros(len(runs.rows), LANE_TRACK_DTYPE)
    out["run"] = runs.run
    out["lane_id"] = np.array([lane.lane_id for lane in lanes], np.int64)[lane]
    out["stamp_ns"] = paths.rows["stamp_ns"][runs.rows]
    out["arc_m"] = found.places.arc_m[runs.rows, lane]
    out["speed_mps"] = _speeds(out)
    return out


def _speeds(rows: NDArray[np.void]) -> Array:
    """(N,) metres per second along the lane, from the places `SMOOTH_S` before and after."""
    if not len(rows):
        return np.empty(0)
    reach, index = round(SMOOTH_S * 1e9 / BIN_NS), np.arange(len(rows))
    begin = np.flatnonzero(np.diff(rows["run"], prepend=-1))
    count = np.diff(np.append(begin, len(rows)))
    first, last = np.repeat(begin, count), np.repeat(begin + count - 1, count)
    back, ahead = np.maximum(index - reach, first), np.minimum(index + reach, last)
    time_s = (rows["stamp_ns"][ahead] - rows["stamp_ns"][back]) * 1e-9
    return np.asarray((rows["arc_m"][ahead] - rows["arc_m"][back]) / np.maximum(time_s, 1e-3))
