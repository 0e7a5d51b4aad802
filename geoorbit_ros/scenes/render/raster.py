"""Ground shapes as pixel masks, with the coverage of every pixel."""

from __future__ import annotations

from collections.abc import Iterable

import cv2
import numpy as np
from numpy.typing import NDArray

from geoorbit_ros.scenes.camera import PinholeCamera
from geoorbit_ros.scenes.render.surface import Strip

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
    limit = 3.0 * max(width, height)
    for strip in strips:
        quads = strip.quads()
        if not len(quads):
            continue
        corners = np.concatenate([quads, np.zeros((*quads.shape[:2], 1))], axis=2)
        pixel, depth = camera.project(corners)
        low, high = pixel.min(axis=1), pixel.max(axis=1)
        with np.errstate(invalid="ignore"):
            shown = (depth.min(axis=1) > NEAR_M) & np.all(high > 0.0, axis=1)
            shown &= np.all(low < [width, height], axis=1) & np.all(np.abs(high) < limit, axis=1)
            shown &= np.all(np.abs(low) < limit, axis=1)
        for quad in pixel[shown]:
            # Coordinates of pixel centres: a subpixel's middle lies half a subpixel inside.
            fine = quad * SAMPLES - 0.5
            thickness = _thickness(fine)
            level = 255 if thickness > 8.0 else round(255 * thickness / (thickness + 1.0))
            points = np.rint(fine * (1 << _SHIFT)).astype(np.int32)
            if level == 255:
                cv2.fillConvexPoly(mask, points, 255, cv2.LINE_8, _SHIFT)
            else:
                _fill_brighter(mask, points, level)
    small = cv2.resize(mask, (width, height), interpolation=cv2.INTER_AREA)
    return small.astype(np.float32) / np.float32(255.0)


def _thickness(quad: NDArray[np.float64]) -> float:
    """The smaller extent of a quadrilateral: area over its longest side."""
    x, y = quad.T
    area = 0.5 * abs(np.dot(x, np.roll(y, -1)) - np.dot(y, np.roll(x, -1)))
    longest = np.hypot(*(quad - np.roll(quad, -1, axis=0)).T).max()
    return float(area / max(longest, 1e-9))


def _fill_brighter(mask: NDArray[np.uint8], points: NDArray[np.int32], level: int) -> None:
    """Fill with a level, but darken nothing."""
    low = np.maximum((points.min(axis=0) >> _SHIFT) - 1, 0)
    high = np.minimum((points.max(axis=0) >> _SHIFT) + 2, mask.shape[::-1])
    if np.any(high <= low):
        return
    part = mask[low[1] : high[1], low[0] : high[0]]
    drawn = np.zeros_like(part)
    cv2.fillConvexPoly(drawn, points - (low << _SHIFT), level, cv2.LINE_8, _SHIFT)
    np.maximum(part, drawn, out=part)
