"""From pixels that move to one box per vehicle."""

from __future__ import annotations

import math
from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from geoorbit_ros.detection.motion.explain import explain, one_misfit
from geoorbit_ros.detection.motion.lorries import lorry_search
from geoorbit_ros.detection.motion.pixels import busy_rows
from geoorbit_ros.detection.motion.road_axes import RoadAxes
from geoorbit_ros.detection.motion.shared_blobs import refined
from geoorbit_ros.detection.motion.vehicle_shapes import Box, Silhouettes, VehicleSizes

SMALLER_COST = 0.7
"""A part that is smaller than a car may be hidden: that costs less than being larger."""
MOST = 1.5
TRUCK_LEAST, TRUCK_MOST = (1.0, 1.6), (3.6, 3.0)
"""Width and height of trucks and buses, in cars."""
TRUCK_COST, DENTED_COST, CONVEX = 0.25, 3.0, 0.9
"""Trucks are rarer than cars, and have the outline of a box."""


def unlikeness(box: Box, fill: float, sizes: VehicleSizes) -> float:
    """How far a box is from a vehicle's at its place: 0 for a car, natural logarithms of size.

    Args:
        box: The part's.
        fill: Share of its convex hull that it fills.
        sizes: How large a car is at each place.
    """
    car = truck = 0.0
    ratios = zip((box[2] - box[0], box[3] - box[1]), sizes.car(box), strict=True)
    for (side, usual), least, most in zip(ratios, TRUCK_LEAST, TRUCK_MOST, strict=True):
        log = math.log(side / usual)
        car += min(log if log > 0.0 else -SMALLER_COST * log, MOST)
        truck += max(log - math.log(most), 0.0) + max(math.log(least) - log, 0.0)
    truck += TRUCK_COST + DENTED_COST * max(CONVEX - fill, 0.0)
    return min(car, truck)


Mask = NDArray[np.uint8]

MIN_SIDE_PX = 5
MIN_VEHICLE_SHARE = 0.10
"""Of a moving patch, less than this that is no shadow: the shadow of something out of view."""
FIRST_RADIUS_PX, RADIUS_SHARE, MAX_RADIUS_PX = 2.5, 0.10, 16.0
"""Gaps in a vehicle that are closed: pixels at first, then a share of a car's height."""
ONE_WIDTH, ONE_HEIGHT = 1.25, 1.4
"""A patch up to so many cars wide and high is one vehicle."""
MIN_PART = 0.3
"""Parts smaller than this, by height or by area, of a car are no vehicle."""
SOUND_FILL = 0.8
"""A patch by itself that fills this much of its convex hull is a vehicle, of whatever size; cars'
sizes are learnt from such."""
SOUND_LIKENESS = 0.6
MIN_CAR_PX = 5.0
"""Where cars are less high, several are not told apart."""
MIN_LORRY_CAR_PX = 10.0
"""Where cars are less high, a patch shows too little to tell a lorry from a queue; no explanation
looks at larger pictures of cars."""
LORRY_AREA = 1.8
"""Pixels of the smallest lorry, in boxes of a car."""
GOOD_ONE = 0.15
"""What is wrong with less than this, as a share of the pixels, is one vehicle or some cars."""
LEAST_LIKENESS = 0.4
"""Of a vehicle that explains a part of a patch."""


@dataclass(frozen=True, slots=True)
class Blob:
    """One vehicle's pixels.

    Attributes:
        box: Left, top, right, bottom.
        whole: Whether it is one isolated vehicle, wholly in the image.
        fill: Share of its convex hull that it fills.
        likeness: 1 for a patch like a car, less the less it is like any vehicle.
    """

    box: Box
    whole: bool
    fill: float
    likeness: float


@dataclass(frozen=True, slots=True)
class _Patch:
    """A connected piece of the mask: pixels 0 or 1, and where its corner is in the image."""

    pixels: Mask
    left: int
    top: int


def find_blobs(
    moving: Mask, vehicle: Mask, sizes: VehicleSizes, shapes: Silhouettes, axes: RoadAxes
) -> list[Blob]:
    """Vehicles among the pixels that move.

    Args:
        moving: (H, W) 255 where the picture differs from the empty road.
        vehicle: (H, W) the same without shadows.
        sizes: How large a car is at each place.
        shapes: What outline vehicles have at each place; learns from single ones.
        axes: Which way the road runs there.
    """
    rows = busy_rows(moving)
    joined = np.asarray(cv2.morphologyEx(moving[rows], cv2.MORPH_CLOSE, np.ones((3, 3), np.uint8)))
    count, label, stats, _ = cv2.connectedComponentsWithStats(joined, ltype=cv2.CV_16U)
    found: list[Blob] = []
    for k in range(1, count):
        left, top, width, height, area = stats[k].tolist()
        if width < MIN_SIDE_PX or height < MIN_SIDE_PX:
            continue
        window = (slice(top, top + height), slice(left, left + width))
        whole = (label[window] == k).astype(np.uint8)
        solid = stand_up(whole, whole & (vehicle[rows][window] > 0))
        if np.count_nonzero(solid) < max(MIN_VEHICLE_SHARE * area, 8):
            continue
        found += _vehicles(_Patch(solid, left, rows.start + top), moving.shape, sizes, shapes, axes)
    return found


def stand_up(whole: Mask, seen: Mask) -> Mask:
    """Pixels of `whole` (H, W) that are `seen`, or above one that is, without a gap between.

    Shadows lie on the road: what has the colour of a shadow above a part of a vehicle is glass or
    dark paint.
    """
    below = np.cumsum(seen[::-1], axis=0, dtype=np.int32)
    run_start = np.maximum.accumulate(np.where(whole[::-1] == 0, below, 0), axis=0)
    return np.asarray(((below > run_start)[::-1] & (whole > 0)).astype(np.uint8))


def _vehicles(
    patch: _Patch,
    image: tuple[int, ...],
    sizes: VehicleSizes,
    shapes: Silhouettes,
    axes: RoadAxes,
) -> list[Blob]:
    """The vehicles in one patch of moving pixels."""
    box = _extent(patch)
    if box is None:
        return []
    if not sizes.known or _is_one(box, sizes):
        blob = _blob(patch, box, image, sizes)
        if blob.whole:
            shapes.add(patch.pixels, box, (patch.left, patch.top))
        sound = blob.fill > SOUND_FILL
        return [blob] if sound or _large_enough(blob, sizes, image) else []
    if sizes.car(box)[1] < MIN_CAR_PX:
        return [_blob(patch, box, image, sizes)]
    blobs = _explained(_closed(patch, sizes), box, image, sizes, shapes, axes)
    return [blob for blob in blobs if _large_enough(blob, sizes, image)]


def _explained(
    patch: _Patch,
    extent: Box,
    image: tuple[int, ...],
    sizes: VehicleSizes,
    shapes: Silhouettes,
    axes: RoadAxes,
) -> list[Blob]:
    """One vehicle of unusual size, or some of usual ones: whichever looks more like the patch."""
    corner = patch.left, patch.top
    one = one_misfit(patch.pixels, corner, extent, shapes)
    search = None
    if one > GOOD_ONE and _holds_lorry(patch, extent, sizes):
        search = lorry_search(extent, _cut_edges(extent, image), sizes, shapes, axes)
    found = explain(patch.pixels, corner, sizes, shapes, search)
    if not len(found.boxes) or one < found.badness:
        return [_blob(patch, extent, image, sizes)]
    blobs = []
    for box in refined(patch.pixels, corner, found):
        likeness = max(float(np.exp(-unlikeness(box, 1.0, sizes))), LEAST_LIKENESS)
        blobs.append(Blob(box, False, 1.0, likeness))
    return blobs


def _holds_lorry(patch: _Patch, extent: Box, sizes: VehicleSizes) -> bool:
    """Whether a patch is large enough for a lorry that can be told from cars."""
    width, height = sizes.car(extent)
    large = cv2.countNonZero(patch.pixels) > LORRY_AREA * width * height
    return large and height >= MIN_LORRY_CAR_PX


def _extent(patch: _Patch) -> Box | None:
    """Box of the pixels, but for rows and columns with a stray one."""
    columns, rows = patch.pixels.sum(axis=0), patch.pixels.sum(axis=1)
    across = np.flatnonzero(columns >= min(2, int(columns.max())))
    down = np.flatnonzero(rows >= min(2, int(rows.max())))
    if len(across) < MIN_SIDE_PX or len(down) < MIN_SIDE_PX:
        return None
    return (
        patch.left + int(across[0]),
        patch.top + int(down[0]),
        patch.left + int(across[-1]) + 1,
        patch.top + int(down[-1]) + 1,
    )


def _is_one(box: Box, sizes: VehicleSizes) -> bool:
    width, height = sizes.car(box)
    return box[2] - box[0] < ONE_WIDTH * width and box[3] - box[1] < ONE_HEIGHT * height


def _large_enough(blob: Blob, sizes: VehicleSizes, image: tuple[int, ...]) -> bool:
    if not sizes.known or _touches_border(blob.box, image):
        return True
    box = blob.box
    width, height = sizes.car(box)
    share = (box[2] - box[0]) * (box[3] - box[1]) / (width * height)
    return box[3] - box[1] > MIN_PART * height and share > MIN_PART


def _touches_border(box: Box, image: tuple[int, ...]) -> bool:
    return any(_cut_edges(box, image))


def _cut_edges(box: Box, image: tuple[int, ...]) -> tuple[bool, bool, bool, bool]:
    """Whether the border of the image cuts the left, top, right, bottom."""
    return box[0] <= 1, box[1] <= 1, box[2] >= image[1] - 1, box[3] >= image[0] - 1


def _blob(patch: _Patch, box: Box, image: tuple[int, ...], sizes: VehicleSizes) -> Blob:
    fill = _fill(patch)
    cut_off = _touches_border(box, image)
    sound = fill > SOUND_FILL
    likeness = SOUND_LIKENESS
    if sizes.known and not cut_off:
        likeness = float(np.exp(-unlikeness(box, fill, sizes)))
    if sound:
        likeness = max(likeness, SOUND_LIKENESS)
    return Blob(box, sound and not cut_off, fill, likeness)


def _fill(patch: _Patch) -> float:
    """Share of the convex hull of all pieces that the largest one fills."""
    outlines, _ = cv2.findContours(patch.pixels, cv2.RETR_EXTERNAL, cv2.CHAIN_APPROX_NONE)
    largest = max(outlines, key=cv2.contourArea)
    hull = cv2.contourArea(cv2.convexHull(np.concatenate(outlines)))
    return cv2.contourArea(largest) / max(hull, 1.0)


def _closed(patch: _Patch, sizes: VehicleSizes) -> _Patch:
    """Gaps closed that are small beside a car."""
    height, width = patch.pixels.shape
    bottom = np.array([float(patch.top + height)])
    car = sizes.at(np.array([patch.left + 0.5 * width]), bottom)[0, 1]
    radius = int(np.clip(RADIUS_SHARE * car, 1.0, MAX_RADIUS_PX))
    kernel = cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (2 * radius + 1, 2 * radius + 1))
    closed = cv2.morphologyEx(patch.pixels, cv2.MORPH_CLOSE, kernel)
    return _Patch(np.asarray(closed, dtype=np.uint8), patch.left, patch.top)
