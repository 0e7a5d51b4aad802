"""What is known of a vehicle that drove by: its lanes, and when it was at the counting station.

All measures (volumes, speeds, headways, movements) are made of these two tables alone, so that the
offline way, the node and the database agree.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

NO_LANE = 0
"""`lane_id` of a place that belongs to no lane; lanes count from 1."""

PASSAGE_DTYPE = np.dtype(
    [
        ("vehicle_id", "<i8"),
        ("track_id", "<i8"),
        ("lane_id", "<i8"),
        ("class_id", "<i4"),
        ("first_ns", "<i8"),
        ("last_ns", "<i8"),
        ("first_arc_m", "<f8"),
        ("last_arc_m", "<f8"),
        ("speed_mps", "<f8"),
        ("speed_sigma_mps", "<f8"),
        ("length_m", "<f8"),
        ("from_lane", "<i8"),
        ("to_lane", "<i8"),
    ]
)
"""One row per vehicle and lane that it drove along.

`vehicle_id` counts vehicles from 1; `track_id` is the id of the vehicle's first track (a track that
breaks leaves one vehicle). `class_id` is COCO's, -1 unknown. Times are when it was first and last
seen in this lane, arcs where along the lane's centreline that was. `speed_mps` is the mean over the
passage, along the lane, with its 1-sigma error. `length_m` is NaN where no box shows it.
`from_lane` and `to_lane` are the vehicle's lanes before and after, `NO_LANE` for none."""

PIECE_DTYPE = np.dtype(
    [
        ("vehicle_id", "<i8"),
        ("lane_id", "<i8"),
        ("class_id", "<i4"),
        ("first_ns", "<i8"),
        ("last_ns", "<i8"),
        ("way_m", "<f8"),
        ("length_m", "<f8"),
    ]
)
"""Passages in pieces one after the other: how far a vehicle drove along its lane in which time. Who
stops on the way has not driven evenly, and intervals may end meanwhile."""

CROSSING_DTYPE = np.dtype(
    [
        ("vehicle_id", "<i8"),
        ("track_id", "<i8"),
        ("lane_id", "<i8"),
        ("station_id", "<i4"),
        ("class_id", "<i4"),
        ("stamp_ns", "<i8"),
        ("front_ns", "<i8"),
        ("rear_ns", "<i8"),
        ("offset_m", "<f8"),
        ("speed_mps", "<f8"),
        ("speed_sigma_mps", "<f8"),
        ("speed_scale_sigma", "<f8"),
        ("length_m", "<f8"),
    ]
)
"""One row per vehicle and counting station: when its middle crossed the line, in which lane.

`front_ns` and `rear_ns` are when its front came to the line and its rear left it, as far as it was
seen; both are `stamp_ns` where no length is known. `offset_m` is how far left of the lane's middle
it was.

A station is a line across the lanes of one direction, so that nobody is counted in two of them.
`speed_mps` is the spot speed, from the path near the line; `speed_scale_sigma` is the part of its
error, relative to it, that all vehicles of the lane share: the calibration's."""


def last_seen(passages: NDArray[np.void]) -> NDArray[np.int64]:
    """(P,) when the vehicle of each passage was last seen in a lane."""
    _, vehicle = np.unique(passages["vehicle_id"], return_inverse=True)
    last = np.full(int(vehicle.max(initial=-1)) + 1, np.iinfo(np.int64).min)
    np.maximum.at(last, vehicle, passages["last_ns"])
    return np.asarray(last[vehicle])
