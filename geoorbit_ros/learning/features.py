"""What the meta-learner knows of a camera's scene: a fixed vector of numbers, from its tracks.

Everything is computed on the camera from `TRACK_DTYPE` rows: positions and velocities in metres,
and `sigma`, the ground error that the calibration gives to each position (it grows with distance
and flat views, so it carries the view's geometry). No number tells where the camera is or who
drove by.

Each feature is (value - centre) / scale with the constants below, clipped to [-3, 3]. The constants
are physical, not fitted: a camera computes its vector from its own data alone, and one odd
camera can't throw the network far off.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from geoorbit_ros.core.tables import FLAG_PREDICTED, FLAG_TRUNCATED, LARGE_CLASSES, Frames

Array = NDArray[np.float64]

MIN_TRAVEL_M = 8.0
"""Tracks that move less are parked, jitter, or are seen too shortly to have a direction. Chosen:
larger loses short tracks, smaller counts parked vehicles."""
CLIP = 3.0
"""Features are cut to this many scales. Chosen: larger lets one odd value dominate the hidden
layer, smaller makes unusual scenes look alike."""


@dataclass(frozen=True, slots=True)
class Feature:
    """One entry of the vector.

    Attributes:
        name: Its name on the wire.
        centre: Value that becomes 0.
        scale: Difference in value that becomes 1.
        meaning: What it measures, with its unit.
    """

    name: str
    centre: float
    scale: float
    meaning: str


FEATURES = (
    Feature("traffic", 1.5, 0.5, "log10 of vehicles per minute"),
    Feature("speed", 20.0, 10.0, "mean speed, m/s"),
    Feature("speed_spread", 0.15, 0.15, "standard deviation of the speeds / mean speed"),
    Feature("large", 0.15, 0.15, "share of trucks and buses"),
    Feature("axis_cos", 0.0, 0.7, "cos of twice the road's heading: +1 east-west, -1 north-south"),
    Feature("axis_sin", 0.0, 0.7, "sin of twice the road's heading: +1 north-east, -1 north-west"),
    Feature("bend", 0.1, 0.15, "spread of the vehicles' axes of travel, 0 on straight roads"),
    Feature("two_way", 0.25, 0.25, "share of vehicles in the lesser direction"),
    Feature("tilt", 1.2, 0.7, "log10 of the median travel north or south, m"),
    Feature("reach", 2.0, 0.3, "log10 of the median length of a track, m"),
    Feature("across", 1.0, 0.4, "log10 of the tracks' spread across the road, m"),
    Feature("north", 1.2, 0.6, "log10 of the tracks' spread in northing, m"),
    Feature("density", -1.2, 0.4, "log10 of vehicles per minute and metre across the road"),
    Feature("duration", 0.6, 0.3, "log10 of the median time in view, s"),
    Feature("error", -0.1, 0.25, "log10 of the median ground error, m"),
    Feature("far_error", 0.3, 0.25, "log10 of the 90 % quantile of the ground error, m"),
    Feature("hour_cos", 0.0, 1.0, "cos of the time of day: +1 midnight, -1 noon"),
    Feature("hour_sin", 0.0, 1.0, "sin of the time of day: +1 at 6 h, -1 at 18 h"),
)
"""Centres and scales are chosen from physical ranges: others would change what a trained model's
inputs mean, so they belong to the wire format."""
FEATURE_NAMES = tuple(feature.name for feature in FEATURES)


def scene_features(tracks: Frames, longitude_deg: float = 0.0) -> Array:
    """The feature vector of a stretch of tracks.

    Args:
        tracks: `TRACK_DTYPE` frames, about a minute or more.
        longitude_deg: Of the camera; with it the time of day is the sun's instead of UTC.

    Returns:
        (len(FEATURES),) float64 in [-3, 3], in the order of `FEATURES`. Zeros, the typical scene,
        where no vehicle moved.
    """
    values = _values(tracks, longitude_deg)
    if values is None:
        return np.zeros(len(FEATURES))
    centre = np.array([feature.centre for feature in FEATURES])
    scale = np.array([feature.scale for feature in FEATURES])
    return np.asarray(np.clip((values - centre) / scale, -CLIP, CLIP))


def _values(tracks: Frames, longitude_deg: float) -> Array | None:
    """Features in their own units; None where no vehicle moved."""
    rows, stamp_ns = tracks.rows, tracks.row_stamp_ns()
    keep = np.isfinite(rows["x"]) & np.isfinite(rows["y"])
    keep &= (rows["flags"] & (FLAG_PREDICTED | FLAG_TRUNCATED)) == 0
    rows, stamp_ns = rows[keep], stamp_ns[keep]
    if len(rows) == 0:
        return None
    order = np.lexsort((stamp_ns, rows["track_id"]))
    rows, stamp_ns = rows[order], stamp_ns[order]
    first = np.flatnonzero(np.append(True, np.diff(rows["track_id"]) != 0))
    last = np.append(first[1:], len(rows)) - 1
    xy = np.column_stack([rows["x"], rows["y"]]).astype(np.float64)
    travel = xy[last] - xy[first]
    length = np.hypot(travel[:, 0], travel[:, 1])
    moved = length >= MIN_TRAVEL_M
    if not moved.any():
        return None
    count = (last - first + 1)[moved].astype(np.float64)
    mean = np.add.reduceat(xy, first)[moved] / count[:, None]
    large = np.isin(rows["class_id"][first], LARGE_CLASSES)[moved]
    duration = (stamp_ns[last] - stamp_ns[first])[moved] * 1e-9
    travel, length = travel[moved], length[moved]
    speed = length / np.maximum(duration, 1e-3)
    minutes = max(float(tracks.stamp_ns[-1] - tracks.stamp_ns[0]) * 1e-9 / 60.0, 1e-3)

    angle = np.arctan2(travel[:, 1], travel[:, 0])
    resultant = np.mean(np.exp(2j * angle))
    axis = 0.5 * np.angle(resultant)
    along = np.cos(angle - axis) > 0.0
    across = _spread(mean @ np.array([-np.sin(axis), np.cos(axis)]))
    per_minute = len(length) / minutes
    seconds = float(tracks.stamp_ns[0]) * 1e-9 + 240.0 * longitude_deg
    hour_rad = 2.0 * np.pi * (seconds % 86400.0) / 86400.0
    sigma = rows["sigma"][np.isfinite(rows["sigma"])].astype(np.float64)
    error, far_error = np.quantile(sigma, [0.5, 0.9]) if len(sigma) else (0.2, 0.6)
    return np.array(
        [
            np.log10(per_minute),
            np.mean(speed),
            np.std(speed) / max(np.mean(speed), 0.1),
            np.mean(large),
            resultant.real,
            resultant.imag,
            np.sqrt(max(1.0 - abs(resultant), 0.0)),
            min(along.mean(), 1.0 - along.mean()),
            np.log10(max(np.median(np.abs(travel[:, 1])), 0.1)),
            np.log10(np.median(length)),
            np.log10(across),
            np.log10(_spread(mean[:, 1])),
            np.log10(per_minute / across / 60.0),
            np.log10(np.median(np.maximum(duration, 0.1))),
            np.log10(max(error, 1e-3)),
            np.log10(max(far_error, 1e-3)),
            np.cos(hour_rad),
            np.sin(hour_rad),
        ]
    )


def _spread(value: Array) -> float:
    """Distance between the 10 % and 90 % quantiles, at least 0.1 m."""
    low, high = np.quantile(value, [0.1, 0.9])
    return max(float(high - low), 0.1)
