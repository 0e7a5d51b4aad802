"""From pixels that move to one box per vehicle."""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from geoorbit_ros.detection.motion_cut import CONVEX, best_cut, unlikeness
from geoorbit_ros.detection.motion_sizes import Box, VehicleSizes

Mask = NDArray[np.uint8]

MIN_SIDE_PX = 5
MIN_VEHICLE_SHARE = 0.10
"""Of a moving patch, less than this that is no shadow: the shadow of something out of view."""
FIRST_RADIUS_PX, RADIUS_SHARE, MAX_RADIUS_PX = 2.5, 0.10, 16.0
"""Gaps in a vehicle that are closed: pixels at first, then a share of a car's height."""
ONE_WIDTH, ONE_HEIGHT = 1.4, 1.5
"""A patch up to so many cars wide and high is one vehicle."""
MIN_PART = 0.3
"""Parts smaller than this, by height or by area, of a car are no vehicle."""
SOUND_FILL = 0.8
"""A patch by itself that fills this much of its convex hull is a vehicle, of whatever size; cars'
sizes are learnt from such."""
SOUND_LIKENESS = 0.6
MAX_CUTS = 4


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


def find_blobs(moving: Mask, vehicle: Mask, sizes: VehicleSizes) -> list[Blob]:
    """Vehicles among the pixels that move.

    Args:
        moving: (H, W) 255 where the picture differs from the empty road.
        vehicle: (H, W) the same without shadows.
        sizes: How large a car is at each place.
    """
    joined = np.asarray(cv2.morphologyEx(moving, cv2.MORPH_CLOSE, np.ones((3, 3), np.uint8)))
    count, label, stats, _ = cv2.connectedComponentsWithStats(joined, connectivity=8)
    found: list[Blob] = []
    for k in range(1, count):
        left, top, width, height, area = stats[k].tolist()
        if width < MIN_SIDE_PX or height < MIN_SIDE_PX:
            continue
        window = (slice(top, top + height), slice(left, left + width))
        whole = (label[window] == k).astype(np.uint8)
        solid = stand_up(whole, whole & (vehicle[window] > 0))
        if np.count_nonzero(solid) < max(MIN_VEHICLE_SHARE * area, 8):
            continue
        found += _vehicles(_Patch(solid, left, top), moving.shape, sizes)
    return found


def stand_up(whole: Mask, seen: Mask) -> Mask:
    """Pixels of `whole` (H, W) that are `seen`, or above one that is, without a gap between.

    Shadows lie on the road: what has the colour of a shadow above a part of a vehicle is glass or
    dark paint.
    """
    below = np.cumsum(seen[::-1], axis=0, dtype=np.int32)
    run_start = np.maximum.accumulate(np.where(whole[::-1] == 0, below, 0), axis=0)
    return np.asarray(((below > run_start)[::-1] & (whole > 0)).astype(np.uint8))


def _vehicles(patch: _Patch, image: tuple[int, ...], sizes: VehicleSizes) -> list[Blob]:
    """The vehicles in one patch of moving pixels."""
    box = _extent(patch)
    if box is None:
        return []
    if not sizes.known or _is_one(box, sizes):
        blob = _blob(patch, box, image, sizes, alone=True)
        sound = blob.fill > SOUND_FILL
        return [blob] if sound or _large_enough(blob, sizes, image) else []
    whole = _blob(patch, box, image, sizes, alone=True)
    if whole.fill > CONVEX:
        return [whole]
    parts = []
    for part in _pieces(_closed(patch, sizes), 4):
        parts += _cut(part, sizes, MAX_CUTS)
    blobs = []
    for part in parts:
        extent = _extent(part)
        if extent is not None:
            blobs.append(_blob(part, extent, image, sizes, alone=False))
    return [blob for blob in blobs if _large_enough(blob, sizes, image)]


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
    return box[0] <= 1 or box[1] <= 1 or box[2] >= image[1] - 1 or box[3] >= image[0] - 1


def _blob(
    patch: _Patch, box: Box, image: tuple[int, ...], sizes: VehicleSizes, *, alone: bool
) -> Blob:
    _, _, fill = _outline(patch)
    cut_off = _touches_border(box, image)
    sound = alone and fill > SOUND_FILL
    likeness = SOUND_LIKENESS
    if sizes.known and not cut_off:
        likeness = float(np.exp(-unlikeness(box, fill, sizes)))
    if sound:
        likeness = max(likeness, SOUND_LIKENESS)
    return Blob(box, sound and not cut_off, fill, likeness)


def _outline(patch: _Patch) -> tuple[NDArray[np.int32], NDArray[np.int32], float]:
    """Outline (K, 2) of the largest piece, indices of its hull, share of the hull that it fills."""
    outlines, _ = cv2.findContours(patch.pixels, cv2.RETR_EXTERNAL, cv2.CHAIN_APPROX_NONE)
    outline = max(outlines, key=cv2.contourArea).reshape(-1, 2).astype(np.int32)
    hull = cv2.convexHull(outline, returnPoints=False).reshape(-1).astype(np.int32)
    area = cv2.contourArea(outline[np.sort(hull)])
    return outline, hull, cv2.contourArea(outline) / max(area, 1.0)


def _closed(patch: _Patch, sizes: VehicleSizes) -> _Patch:
    """Gaps closed that are small beside a car."""
    height, width = patch.pixels.shape
    bottom = np.array([float(patch.top + height)])
    car = sizes.at(np.array([patch.left + 0.5 * width]), bottom)[0, 1]
    radius = int(np.clip(RADIUS_SHARE * car, 1.0, MAX_RADIUS_PX))
    kernel = cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (2 * radius + 1, 2 * radius + 1))
    closed = cv2.morphologyEx(patch.pixels, cv2.MORPH_CLOSE, kernel)
    return _Patch(np.asarray(closed, dtype=np.uint8), patch.left, patch.top)


def _pieces(patch: _Patch, connectivity: int) -> list[_Patch]:
    """Each connected piece of a patch, the largest first."""
    count, label, stats, _ = cv2.connectedComponentsWithStats(
        patch.pixels, connectivity=connectivity
    )
    order = sorted(range(1, count), key=lambda k: -int(stats[k, cv2.CC_STAT_AREA]))
    pieces = []
    for k in order:
        left, top, width, height = stats[k, :4].tolist()
        own = (label[top : top + height, left : left + width] == k).astype(np.uint8)
        pieces.append(_Patch(own, patch.left + left, patch.top + top))
    return pieces


def _cut(patch: _Patch, sizes: VehicleSizes, cuts: int) -> list[_Patch]:
    """The patch, or its parts where it is several vehicles: cut where it is narrow."""
    box = _extent(patch)
    if box is None:
        return []
    outline, hull, fill = _outline(patch)
    if cuts == 0 or fill > CONVEX or _is_one(box, sizes):
        return [patch]
    width, height = sizes.car(box)
    ends = best_cut(outline, hull, (patch.left, patch.top), sizes)
    if ends is None:
        return [patch]
    pixels = patch.pixels.copy()
    cv2.line(pixels, ends[0], ends[1], 0, 1, cv2.LINE_4)
    parts = _pieces(_Patch(pixels, patch.left, patch.top), 4)
    parts = [p for p in parts if np.count_nonzero(p.pixels) > 0.15 * width * height]
    if len(parts) < 2:
        return [patch]
    return [end for part in parts for end in _cut(part, sizes, cuts - 1)]
