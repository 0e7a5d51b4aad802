"""Where to cut an outline that is several vehicles in one."""

from __future__ import annotations

from collections.abc import Iterator

import cv2
import numpy as np
from numpy.typing import NDArray

from geoorbit_ros.detection.motion_sizes import Box, VehicleSizes

MIN_DEPTH = 0.06
"""Dents less deep than this share of a car's size are part of its shape."""
MAX_DENTS = 4
MIN_ALONG = 0.4
"""Outline between the ends of a cut, in car sizes: what is cut off is no corner."""
MIN_AREA = 0.2
"""Of a car's: smaller parts are no vehicle."""
LENGTH_COST = 0.45
"""Price of a cut as long as the way along the outline between its ends, as a natural logarithm."""
MIN_GAIN = 0.08
"""How much more like cars the parts must be than the whole."""
SMALLER_COST = 0.7
"""A part that is smaller than a car may be hidden: that costs less than being larger."""

TRUCK_LEAST, TRUCK_MOST = np.log([1.0, 1.6]), np.log([3.6, 3.0])
"""Width and height of trucks and buses, in cars."""
TRUCK_COST, DENTED_COST, CONVEX = 0.25, 3.0, 0.9
"""Trucks are rarer than cars, and have the outline of a box."""

End = tuple[int, int]


def unlikeness(box: Box, fill: float, sizes: VehicleSizes) -> float:
    """How far a box is from a vehicle's at its place: 0 for a car, natural logarithms of size.

    Args:
        box: The part's.
        fill: Share of its convex hull that it fills.
        sizes: How large a car is at each place.
    """
    width, height = sizes.car(box)
    logs = np.log([(box[2] - box[0]) / width, (box[3] - box[1]) / height])
    car = float(np.minimum(np.where(logs > 0, logs, -SMALLER_COST * logs), 1.5).sum())
    beyond = np.maximum(logs - TRUCK_MOST, 0.0) + np.maximum(TRUCK_LEAST - logs, 0.0)
    truck = TRUCK_COST + float(beyond.sum()) + DENTED_COST * max(CONVEX - fill, 0.0)
    return min(car, truck)


def best_cut(
    outline: NDArray[np.int32], hull: NDArray[np.int32], corner: End, sizes: VehicleSizes
) -> tuple[End, End] | None:
    """Ends of the cut after which the parts are most like cars; None when none helps.

    Args:
        outline: (K, 2) closed.
        hull: Indices of the points of its convex hull.
        corner: Where (0, 0) of the outline is in the image.
        sizes: How large a car is at each place.
    """
    whole = _box(outline, corner)
    width, height = sizes.car(whole)
    size, area = float(np.sqrt(width * height)), width * height
    best, ends = unlikeness(whole, _fill(outline), sizes) - MIN_GAIN, None
    for a, b, narrowness in _candidates(outline, hull, size):
        one, two = outline[a : b + 1], np.vstack([outline[b:], outline[: a + 1]])
        areas = np.array([cv2.contourArea(one), cv2.contourArea(two)])
        if areas.min() < MIN_AREA * area:
            continue
        costs = [unlikeness(_box(part, corner), _fill(part), sizes) for part in (one, two)]
        cost = float(areas @ costs / areas.sum()) + LENGTH_COST * narrowness
        if cost < best:
            best, ends = cost, (a, b)
    if ends is None:
        return None
    (ax, ay), (bx, by) = (outline[k].tolist() for k in ends)
    return (ax, ay), (bx, by)


def _candidates(
    outline: NDArray[np.int32], hull: NDArray[np.int32], size: float
) -> Iterator[tuple[int, int, float]]:
    """Indices of both ends, the lesser first, and length over way, of cuts from dents."""
    try:
        found = cv2.convexityDefects(outline[:, None], hull[:, None])
    except cv2.error:  # an outline that crosses itself has no dents in OpenCV's sense
        return
    dents = np.empty((0, 4), np.int32) if found is None else np.reshape(found, (-1, 4))
    dents = dents[dents[:, 3] / 256.0 > MIN_DEPTH * size]
    deep = dents[np.argsort(-dents[:, 3])[:MAX_DENTS], 2]
    points = outline.astype(np.float64)
    step = np.hypot(*np.diff(np.vstack([points, points[:1]]), axis=0).T)
    arc = np.append(0.0, np.cumsum(step))
    tried: set[tuple[int, int]] = set()
    for dent in deep.tolist():
        distance = np.hypot(*(points - points[dent]).T)
        along = np.abs(arc[:-1] - arc[dent])
        along = np.minimum(along, arc[-1] - along)
        narrow = np.where(along > MIN_ALONG * size, distance / np.maximum(along, 1e-6), np.inf)
        for other in {int(np.argmin(narrow)), *deep.tolist()}:
            ends = min(dent, other), max(dent, other)
            if np.isfinite(narrow[other]) and ends not in tried:
                tried.add(ends)
                yield *ends, float(narrow[other])


def _box(points: NDArray[np.int32], corner: End) -> Box:
    left, top = (points.min(axis=0) + corner).tolist()
    right, bottom = (points.max(axis=0) + corner + 1).tolist()
    return left, top, right, bottom


def _fill(points: NDArray[np.int32]) -> float:
    return float(cv2.contourArea(points) / max(cv2.contourArea(cv2.convexHull(points)), 1.0))
