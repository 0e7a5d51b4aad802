"""Between directions on the road and in the image, for vehicles on a flat road."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]

ROUGH_PLACES = 3
"""Places before and after from which a vehicle's rough direction is taken. Chosen: more cut bends,
fewer follow the noise of boxes."""


def pixels_per_metre(matrix: Array, xy: Array) -> Array:
    """(2, 2, N) slopes of pixels (first axis) with positions (second) on the road."""
    with np.errstate(all="ignore"):
        uvw = matrix[:, :2] @ xy + matrix[:, 3:]
        uv = uvw[:2] / uvw[2]
        return np.asarray((matrix[:2, :2, None] - uv[:, None] * matrix[2, :2, None]) / uvw[2])


def on_road(slope: Array, shown: Array) -> Array:
    """(N,) angle on the road of ways (2, N) in the image."""
    x = slope[1, 1] * shown[0] - slope[0, 1] * shown[1]
    y = slope[0, 0] * shown[1] - slope[1, 0] * shown[0]
    area = slope[0, 0] * slope[1, 1] - slope[0, 1] * slope[1, 0]
    return np.asarray(np.arctan2(np.sign(area) * y, np.sign(area) * x))


def in_image(slope: Array, angle: Array) -> Array:
    """(2, N) ways in the image, in pixels per metre, of ways on the road."""
    return np.asarray(slope[:, 0] * np.cos(angle) + slope[:, 1] * np.sin(angle))


def pixel_turn(slope: Array, angle: Array) -> Array:
    """(N,) how much a way turns in the image when it turns on the road."""
    ahead = in_image(slope, angle)
    area = slope[0, 0] * slope[1, 1] - slope[0, 1] * slope[1, 0]
    return np.asarray(np.abs(area) / ((ahead**2).sum(axis=0) + 1e-12))


def alike(vehicle: NDArray[np.intp], time_s: Array, correlated_s: float) -> Array:
    """(M,) how many boxes of a vehicle have the same slow error; by vehicle and time."""
    first = np.flatnonzero(np.diff(vehicle, prepend=-1))
    lasts = np.maximum.reduceat(time_s, first) - time_s[first]
    spacing = lasts / np.maximum(np.bincount(vehicle) - 1, 1)
    return np.asarray(np.maximum(1.0, correlated_s / np.maximum(spacing, 0.05))[vehicle])


def metres_across(slope: Array, angle: Array) -> Array:
    """(N,) metres across a direction on the road that one pixel in any direction means."""
    area = slope[0, 0] * slope[1, 1] - slope[0, 1] * slope[1, 0]
    cos, sin = np.cos(angle), np.sin(angle)
    # Rows of the inverse slopes, combined across the direction.
    by_u = -sin * slope[1, 1] - cos * slope[1, 0]
    by_v = sin * slope[0, 1] + cos * slope[0, 0]
    return np.asarray(np.hypot(by_u, by_v) / np.maximum(np.abs(area), 1e-12))


def rough_angle(xy: Array, vehicle: NDArray[np.intp]) -> Array:
    """(M,) where vehicles head, from the places before and after; ordered by vehicle and time."""
    place = np.arange(len(vehicle))
    first = np.flatnonzero(np.diff(vehicle, prepend=-1))
    last = np.append(first[1:], len(vehicle)) - 1
    number = np.cumsum(np.diff(vehicle, prepend=-1) > 0) - 1
    before = np.maximum(place - ROUGH_PLACES, first[number])
    after = np.minimum(place + ROUGH_PLACES, last[number])
    off = xy[:, after] - xy[:, before]
    return np.asarray(np.arctan2(off[1], off[0]))
