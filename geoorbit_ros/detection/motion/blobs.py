"""Blobs of moving pixels, and the vehicles in each of them."""

from __future__ import annotations

import math
from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from geoorbit_ros.detection.motion.lorries import lorry_search
from geoorbit_ros.detection.motion.road_axes import RoadAxes
from geoorbit_ros.detection.motion.shared_blobs import explain, fit_edges, misfit_of_one
from geoorbit_ros.detection.motion.vehicle_shapes import Box, VehicleOutlines, VehicleSizes

Mask = NDArray[np.uint8]

MIN_SIDE_PX = 5
"""Smaller blobs are noise. Chosen: larger misses far vehicles, smaller finds more leaves."""
MIN_VEHICLE_SHARE = 0.10
"""Share of a blob that must be no shadow; with less it is the shadow of something out of view.
Chosen: larger misses vehicles as dark as their shadow."""
RADIUS_SHARE = 0.10
"""Gaps in a vehicle are closed that are this share of a car's height wide. Chosen: larger joins
neighbours, smaller leaves windows open."""
MAX_RADIUS_PX = 16.0
"""Gaps are closed up to this radius. Chosen: the time that it takes grows with its square."""
ONE_WIDTH = 1.25
"""A blob up to so many cars wide is one vehicle. Chosen: larger joins cars side by side, smaller
splits a car that turns."""
ONE_HEIGHT = 1.4
"""A blob up to so many cars high is one vehicle. Chosen: as `ONE_WIDTH`; vans are 1.35 cars
high."""
MIN_PART = 0.3
"""Parts smaller than this share of a car, by height or by area, are no vehicle. Chosen: larger
misses motorcycles and half-hidden cars, smaller finds fragments."""
CONVEX_FILL = 0.8
"""A blob by itself that fills this share of its convex hull is a vehicle of whatever size; the
sizes of cars are learnt from such. Chosen: larger learns later, smaller learns from joined
vehicles."""
CONVEX_SIMILARITY = 0.6
"""Similarity that such a blob has at least. Chosen: its score then is 0.54, which begins a track
(`TrackerParameters.birth_score`)."""
MOST_MISFIT = 1.0
"""Where sizes are known, that holds up to this misfit (`size_misfit`), the natural logarithm of a
ratio of areas. Chosen: larger takes leaves above the road for vehicles, smaller drops vehicles
where the size of a car is not known well yet."""
MIN_CAR_PX = 6.0
"""Where cars are less high, nothing is found. Chosen: seen from a pole of 10 m with a usual lens,
one pixel there is 7 m of the road; smaller gives tracks that break and swap there."""
MIN_HILL_PX = 16
"""Unless it is at least so high, on a road where vehicles have travelled: height grows with the row
only on a plane. Chosen: larger misses cars on the top of a hill, smaller finds leaves."""
MIN_HEIGHT_PX = 8
"""Where sizes are known, less high boxes are no vehicles. Chosen: larger misses far cars, smaller
gives pieces of far vehicles, each with an id of its own."""
MIN_HEIGHT_SHARE = 1 / 107
"""And this share of the image's width: 12 px of 1280. Chosen: three quarters of the height from
which boxes are useful (docs/detection.md)."""
MIN_LORRY_CAR_PX = 10.0
"""Where cars are less high, no lorry is looked for. Chosen: a dense queue looks like one there;
smaller joins queues."""
LORRY_AREA = 1.8
"""Pixels of the smallest lorry, in boxes of a car. Chosen: larger misses lorries, smaller takes
more time."""
GOOD_ONE = 0.15
"""Where a blob differs from one vehicle in less than this share of its pixels, no lorry is looked
for. Chosen: larger leaves lorries in pieces, smaller takes more time."""
MIN_PART_SIMILARITY = 0.4
"""Least similarity of a vehicle that explains a part of a blob. Chosen: its score then is 0.36,
more than `min_score`: its shape says more than its size."""
SMALLER_COST = 0.7
"""Cost of a box smaller than a car, relative to a larger one. Chosen below 1: a part may be
hidden."""
MAX_SIDE_COST = 1.5
"""Most that one side costs, natural logarithm. Chosen: beyond, it is no car in any case."""
TRUCK_LEAST = (1.0, 1.6)
"""Least width and height of trucks and buses, in cars. Chosen: a 2.5 m wide, 3 m high truck seen
from behind is 1.4 by 2 cars."""
TRUCK_MOST = (3.6, 3.0)
"""Largest width and height of trucks and buses, in cars. Chosen: a 16.5 m trailer seen from the
side is 3.7 cars long and 2.7 high."""
TRUCK_COST = 0.25
"""Cost of a truck beside a car's: trucks are rarer. Chosen: larger gives lorries low scores."""
DENTED_COST = 3.0
"""Cost of a truck for each unit of fill that it lacks: trucks have the outline of a box. Chosen:
larger gives trucks low scores, smaller takes joined cars for trucks."""
CONVEX = 0.9
"""Fill of a truck from which it costs nothing. Chosen: as `DENTED_COST`."""


@dataclass(frozen=True, slots=True)
class Vehicle:
    """One vehicle in the image.

    Attributes:
        box: Left, top, right, bottom.
        whole: Whether it is one isolated vehicle, wholly in the image.
        fill: Share of its convex hull that it fills.
        similarity: 1 for a blob like a car, less the less it is like any vehicle.
    """

    box: Box
    whole: bool
    fill: float
    similarity: float


@dataclass(frozen=True, slots=True)
class Blob:
    """Connected pixels that move, 0 or 1, and where their corner is in the image."""

    pixels: Mask
    left: int
    top: int


def busy_rows(mask: Mask) -> slice:
    """The rows from the first to the last that has a pixel set; at least one."""
    busy = np.flatnonzero(mask.any(axis=1))
    return slice(int(busy[0]), int(busy[-1]) + 1) if len(busy) else slice(0, 1)


def find_vehicles(
    moving: Mask, unshaded: Mask, sizes: VehicleSizes, outlines: VehicleOutlines, axes: RoadAxes
) -> list[Vehicle]:
    """Vehicles among the pixels that move.

    Args:
        moving: (H, W) 255 where the image differs from the empty road.
        unshaded: (H, W) the same without shadows.
        sizes: How large a car is at each place.
        outlines: What outline vehicles have at each place; learns from single ones.
        axes: Which way the road runs there.
    """
    rows = busy_rows(moving)
    solid = cv2.medianBlur(moving[rows], 3)  # single pixels of noise would join what stands apart
    joined = np.asarray(cv2.morphologyEx(solid, cv2.MORPH_CLOSE, np.ones((3, 3), np.uint8)))
    count, label, stats, _ = cv2.connectedComponentsWithStats(joined, ltype=cv2.CV_16U)
    found: list[Vehicle] = []
    for k in range(1, count):
        left, top, width, height, area = stats[k].tolist()
        if width < MIN_SIDE_PX or height < MIN_SIDE_PX:
            continue
        window = (slice(top, top + height), slice(left, left + width))
        whole = (label[window] == k).astype(np.uint8)
        seen = stand_up(whole, whole & (unshaded[rows][window] > 0))
        if np.count_nonzero(seen) < max(MIN_VEHICLE_SHARE * area, 8):
            continue
        found += _vehicles(Blob(seen, left, rows.start + top), moving.shape, sizes, outlines, axes)
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
    blob: Blob,
    image_shape: tuple[int, ...],
    sizes: VehicleSizes,
    outlines: VehicleOutlines,
    axes: RoadAxes,
) -> list[Vehicle]:
    """The vehicles in one blob of moving pixels."""
    box = _extent(blob)
    if box is None:
        return []
    known = sizes.knows(box)
    if known and sizes.car(box)[1] < MIN_CAR_PX:
        return _beyond(blob, box, image_shape, axes)
    if not known or _is_one(box, sizes):
        vehicle = _vehicle(blob, box, image_shape, sizes)
        if vehicle.whole and known:
            outlines.add(blob.pixels, box, (blob.left, blob.top))
        sound = vehicle.fill > CONVEX_FILL and not touches_border(box, image_shape)
        low = sizes.known and box[3] - box[1] < _min_height_px(image_shape)
        kept = not low and (sound or _large_enough(vehicle, sizes, image_shape))
        return [vehicle] if kept else []
    vehicles = _explained(_closed(blob, sizes), box, image_shape, sizes, outlines, axes)
    return [vehicle for vehicle in vehicles if _large_enough(vehicle, sizes, image_shape)]


def _beyond(blob: Blob, box: Box, image_shape: tuple[int, ...], axes: RoadAxes) -> list[Vehicle]:
    """A vehicle where, by the sizes nearer by, none could be seen: the road goes over a hill."""
    cut_off, fill = touches_border(box, image_shape), _fill(blob)
    if box[3] - box[1] < MIN_HILL_PX or fill <= CONVEX_FILL or not axes.is_driven(box):
        return []
    return [Vehicle(box, not cut_off, fill, CONVEX_SIMILARITY)]


def _explained(
    blob: Blob,
    extent: Box,
    image_shape: tuple[int, ...],
    sizes: VehicleSizes,
    outlines: VehicleOutlines,
    axes: RoadAxes,
) -> list[Vehicle]:
    """One vehicle of unusual size, or several of usual ones: what looks more like the blob."""
    corner = blob.left, blob.top
    one = misfit_of_one(blob.pixels, corner, extent, outlines)
    search = None
    if one > GOOD_ONE and _holds_lorry(blob, extent, sizes):
        search = lorry_search(extent, _cut_edges(extent, image_shape), sizes, outlines, axes)
    found = explain(blob.pixels, corner, sizes, outlines, search)
    if not len(found.boxes) or one < found.badness:
        return [_vehicle(blob, extent, image_shape, sizes)]
    vehicles = []
    for box in fit_edges(blob.pixels, corner, found):
        similarity = max(float(np.exp(-size_misfit(box, 1.0, sizes))), MIN_PART_SIMILARITY)
        vehicles.append(Vehicle(box, False, 1.0, similarity))
    return vehicles


def _holds_lorry(blob: Blob, extent: Box, sizes: VehicleSizes) -> bool:
    """Whether a blob is large enough for a lorry that can be told from cars."""
    width, height = sizes.car(extent)
    large = cv2.countNonZero(blob.pixels) > LORRY_AREA * width * height
    return large and height >= MIN_LORRY_CAR_PX


def _extent(blob: Blob) -> Box | None:
    """Box of the pixels; an outer row or column with a single pixel is left out."""
    columns, rows = blob.pixels.sum(axis=0), blob.pixels.sum(axis=1)
    across = np.flatnonzero(columns >= min(2, int(columns.max())))
    down = np.flatnonzero(rows >= min(2, int(rows.max())))
    if len(across) < MIN_SIDE_PX or len(down) < MIN_SIDE_PX:
        return None
    return (
        blob.left + int(across[0]),
        blob.top + int(down[0]),
        blob.left + int(across[-1]) + 1,
        blob.top + int(down[-1]) + 1,
    )


def _is_one(box: Box, sizes: VehicleSizes) -> bool:
    width, height = sizes.car(box)
    return box[2] - box[0] < ONE_WIDTH * width and box[3] - box[1] < ONE_HEIGHT * height


def _large_enough(vehicle: Vehicle, sizes: VehicleSizes, image_shape: tuple[int, ...]) -> bool:
    box = vehicle.box
    if not sizes.knows(box):
        return True
    width, height = sizes.car(box)
    share = (box[2] - box[0]) * (box[3] - box[1]) / (width * height)
    high = box[3] - box[1] > MIN_PART * height or touches_border(box, image_shape)
    return high and share > MIN_PART and box[3] - box[1] >= _min_height_px(image_shape)


def _min_height_px(image_shape: tuple[int, ...]) -> float:
    return max(MIN_HEIGHT_PX, MIN_HEIGHT_SHARE * image_shape[1])


def touches_border(box: Box, image_shape: tuple[int, ...]) -> bool:
    """Whether the border of the image cuts a box."""
    return any(_cut_edges(box, image_shape))


def _cut_edges(box: Box, image_shape: tuple[int, ...]) -> tuple[bool, bool, bool, bool]:
    """Whether the border of the image cuts the left, top, right, bottom."""
    return box[0] <= 1, box[1] <= 1, box[2] >= image_shape[1] - 1, box[3] >= image_shape[0] - 1


def _vehicle(blob: Blob, box: Box, image_shape: tuple[int, ...], sizes: VehicleSizes) -> Vehicle:
    fill = _fill(blob)
    cut_off = touches_border(box, image_shape)
    sound = fill > CONVEX_FILL
    similarity = CONVEX_SIMILARITY
    if sizes.knows(box) and not cut_off:
        misfit = size_misfit(box, fill, sizes)
        similarity = float(np.exp(-misfit))
        if sound and misfit < MOST_MISFIT:
            similarity = max(similarity, CONVEX_SIMILARITY)
    return Vehicle(box, sound and not cut_off, fill, similarity)


def _fill(blob: Blob) -> float:
    """Share of the convex hull of all pieces that the largest one fills."""
    outlines, _ = cv2.findContours(blob.pixels, cv2.RETR_EXTERNAL, cv2.CHAIN_APPROX_NONE)
    largest = max(outlines, key=cv2.contourArea)
    hull = cv2.contourArea(cv2.convexHull(np.concatenate(outlines)))
    return cv2.contourArea(largest) / max(hull, 1.0)


def _closed(blob: Blob, sizes: VehicleSizes) -> Blob:
    """The blob with gaps closed that are small relative to a car."""
    height, width = blob.pixels.shape
    bottom = np.array([float(blob.top + height)])
    car = sizes.at(np.array([blob.left + 0.5 * width]), bottom)[0, 1]
    radius = int(np.clip(RADIUS_SHARE * car, 1.0, MAX_RADIUS_PX))
    kernel = cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (2 * radius + 1, 2 * radius + 1))
    closed = cv2.morphologyEx(blob.pixels, cv2.MORPH_CLOSE, kernel)
    return Blob(np.asarray(closed, dtype=np.uint8), blob.left, blob.top)


def size_misfit(box: Box, fill: float, sizes: VehicleSizes) -> float:
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
        car += min(log if log > 0.0 else -SMALLER_COST * log, MAX_SIDE_COST)
        truck += max(log - math.log(most), 0.0) + max(math.log(least) - log, 0.0)
    truck += TRUCK_COST + DENTED_COST * max(CONVEX - fill, 0.0)
    return min(car, truck)
