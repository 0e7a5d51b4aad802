"""Ground shapes as pixel masks, with the coverage of every pixel."""

from __future__ import annotations

from collections.abc import Iterable

import cv2
import numpy as np
from numpy.typing import NDArray

from geoorbit_ros.rendering.surface import Strip
from geoorbit_ros.scenes.camera import PinholeCamera

SAMPLES = 4
"""Subpixels per pixel and axis."""
_SHIFT = 4
"""Fractional bits of OpenCV's polygon corners."""
NEAR_M = 0.5


def coverage(camera: PinholeCamera, strips: Iterable[Strip]) -> NDArray[np.float32]:
    """(H, W) share of each pixel that the strips cover.

    A band thinner than a subpixel is drawn one subpixel wide and as much fainter.
    """
    width, height = camera.image_size
    mask = np.zeros((height * SAMPLES, width * SAMPLES), np.uint8)
    quads = [strip.quads() for strip in strips]
    if not quads:
        return np.zeros((height, width), np.float32)
    ground = np.concatenate(quads)
    pixel, depth = camera.project(np.concatenate([ground, np.zeros((*ground.shape[:2], 1))], 2))
    low, high = pixel.min(axis=1), pixel.max(axis=1)
    limit = 3.0 * max(width, height)
    with np.errstate(invalid="ignore"):
        shown = (depth.min(axis=1) > NEAR_M) & np.all(high > 0.0, axis=1)
        shown &= np.all(low < [width, height], axis=1)
        shown &= np.all(high < limit, axis=1) & np.all(low > -limit, axis=1)
    # Coordinates of pixel centres: a subpixel's middle lies half a subpixel inside.
    fine = pixel[shown] * SAMPLES - 0.5
    thin = _thickness(fine)
    levels = np.where(thin > 8.0, 255, np.rint(255 * thin / (thin + 1.0))).astype(np.int64)
    corners = np.rint(fine * (1 << _SHIFT)).astype(np.int32)
    # The brightest last: none darkens another.
    for k in np.argsort(levels, kind="stable").tolist():
        cv2.fillConvexPoly(mask, corners[k], int(levels[k]), cv2.LINE_8, _SHIFT)
    small = cv2.resize(mask, (width, height), interpolation=cv2.INTER_AREA)
    return small.astype(np.float32) / np.float32(255.0)


def _thickness(quads: NDArray[np.float64]) -> NDArray[np.float64]:
    """(N,) the smaller extent of quadrilaterals (N, 4, 2): area over longest side."""
    following = np.roll(quads, -1, axis=1)
    cross = quads[..., 0] * following[..., 1] - quads[..., 1] * following[..., 0]
    longest = np.hypot(*np.moveaxis(quads - following, 2, 0)).max(axis=1)
    return np.asarray(0.5 * np.abs(cross.sum(axis=1)) / np.maximum(longest, 1e-9))
