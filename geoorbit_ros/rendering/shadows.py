"""Shadows of vehicles on the ground: soft, cast by the sun, and the darkness beneath them."""

from __future__ import annotations

from itertools import pairwise

import cv2
import numpy as np
from numpy.typing import NDArray

from geoorbit_ros.rendering.conditions import Illumination
from geoorbit_ros.rendering.painter import Body
from geoorbit_ros.scenes.camera import PinholeCamera

COARSE = 2
"""Pixels per shadow pixel: shadows have soft edges. Chosen: 1 takes more time."""
_SHIFT = 4
"""Fractional bits of OpenCV's polygon corners."""
_SOFT = 0.6
"""Blur in shadow pixels. The sun's penumbra is centimetres wide: more would put a dark halo, large
beside a far vehicle, where a camera shows none. Chosen by appearance."""
_FAR_PX = 20000.0
"""OpenCV's polygons take no larger coordinates."""
_LOW_M = 0.6
"""Corners below this make the outline of what touches the ground. Chosen: the height of a sill."""
_BENEATH = 0.62
"""Share of light that is missing beneath a vehicle. Chosen by appearance."""
_MIRROR = 0.30
"""Share of the light from a wet road that the mirrored vehicle takes away. Chosen by appearance."""


class Shadows:
    """Darkens the ground about vehicles.

    Args:
        camera: The camera.
        light: Where the sun stands.
        wet: Whether the road mirrors the vehicles.
    """

    def __init__(self, camera: PinholeCamera, light: Illumination, wet: bool) -> None:
        width, height = camera.image_size
        self._camera = camera
        self._size = -(-width // COARSE), -(-height // COARSE)
        self._wet = wet
        sun = np.array(light.sun) * max(light.sun_direction[2], 0.0)
        shade = np.array(light.ambient)
        # What is left of each colour in the shadow of the sun, for every density of shadow.
        missing = sun / np.maximum(shade + sun, 1e-6)
        density = np.linspace(0.0, 1.0, 256)[:, None]
        self._left = np.rint(255.0 * (1.0 - missing * density)).astype(np.uint8)[:, None]
        self._cast = light.sun_direction[:2] / max(light.sun_direction[2], 0.1)
        self._sunny = bool(missing.max() > 0.15)

    def darken(self, image: NDArray[np.uint8], bodies: list[Body], sunshine: float) -> None:
        """Darken the ground in an image (H, W, 3); `sunshine` 0 to 1: how much the sun is out."""
        if not bodies:
            return
        width, height = self._size
        beneath = np.zeros((height, width), np.uint8)
        cast = np.zeros((height, width), np.uint8)
        outlines = np.concatenate([body.outline_m for body in bodies])
        start = np.append(0, np.cumsum([len(body.outline_m) for body in bodies]))
        flat = outlines[:, 2:] * 0.0
        if self._sunny:
            ground = np.hstack([outlines[:, :2] - outlines[:, 2:] * self._cast, flat])
            self._fill(cast, ground, start, round(255 * sunshine))
        if self._wet:
            mirrored = outlines * (1.0, 1.0, -1.0)
            self._fill(beneath, mirrored, start, round(255 * _MIRROR))
        low = outlines[:, 2] < _LOW_M
        ground = np.hstack([outlines[:, :2], flat])[low]
        self._fill(beneath, ground, np.append(0, np.cumsum(low))[start], round(255 * _BENEATH))
        rows = np.flatnonzero((cast | beneath).any(axis=1))
        if not len(rows):
            return
        top, bottom = max(rows[0] - 3, 0), min(rows[-1] + 4, height)
        soft = cv2.GaussianBlur(cast[top:bottom], (3, 3), _SOFT)
        below = cv2.GaussianBlur(255 - beneath[top:bottom], (3, 3), _SOFT)
        left = cv2.LUT(cv2.merge([soft] * 3), self._left.reshape(1, 256, 3))
        left = cv2.multiply(left, cv2.merge([below] * 3), scale=1.0 / 255.0)
        part = image[top * COARSE : bottom * COARSE]
        left = cv2.resize(
            left, (width * COARSE, (bottom - top) * COARSE), interpolation=cv2.INTER_LINEAR
        )[: part.shape[0], : part.shape[1]]
        cv2.multiply(part, left, dst=part, scale=1.0 / 255.0)

    def _fill(
        self,
        mask: NDArray[np.uint8],
        points_m: NDArray[np.float64],
        start: NDArray[np.int64],
        level: int,
    ) -> None:
        """Fill the convex hulls of points (N, 3); those of hull k are from `start[k]` on."""
        pixel, depth = self._camera.project(points_m)
        coarse = (pixel / COARSE - 0.5).astype(np.float32)
        for a, b in pairwise(start.tolist()):
            if b - a < 3 or depth[a:b].min() <= 1.0:
                continue
            hull = cv2.convexHull(coarse[a:b])
            if np.abs(hull).max() < _FAR_PX:
                corners = np.rint(hull * (1 << _SHIFT)).astype(np.int32)
                cv2.fillConvexPoly(mask, corners, level, cv2.LINE_AA, _SHIFT)
