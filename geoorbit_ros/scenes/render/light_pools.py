"""Headlights at dusk and night: pools of light on the road."""

from __future__ import annotations

import cv2
import numpy as np
from numpy.typing import NDArray

from geoorbit_ros.scenes.camera import PinholeCamera
from geoorbit_ros.scenes.render.lamps import WARM
from geoorbit_ros.scenes.render.painter import Body

COARSE = 4
"""Pixels per pixel of the light on the ground: it has no sharp edges."""
POOL_M = (1.0, 46.0)
"""A low beam reaches from here to there ahead of the bumper."""
HALF_WIDTH_M = 8.0
_SHARES = np.array([1.0, 0.6, 0.3])
"""What would reach behind the camera is left out: the longest of these that does not."""
_NEAR_M = 2.0


class LightPools:
    """Adds the light of the vehicles' own lamps to the ground.

    Args:
        camera: The camera.
        albedo: (H, W, 3) colours of the ground without light, 0 to 1.
        strength: Brightness of the lamps, 0 to 1.
    """

    def __init__(self, camera: PinholeCamera, albedo: NDArray[np.float32], strength: float) -> None:
        width, height = camera.image_size
        self._camera = camera
        self._size = -(-width // COARSE), -(-height // COARSE)
        tinted = 255.0 * np.clip(albedo * (0.95 * strength * WARM), 0.0, 1.0)
        self._albedo = np.asarray(np.rint(tinted), dtype=np.uint8)
        self._pool = _pool_texture()

    def light_road(self, picture: NDArray[np.uint8], bodies: list[Body]) -> None:
        """Add the pools of light ahead of the vehicles to a picture (H, W, 3)."""
        if not bodies:
            return
        width, height = self._size
        pools = np.zeros((height, width), np.uint8)
        pixel, depth = self._camera.project(_pool_corners(bodies))
        clear = depth.min(axis=2) > _NEAR_M
        for k in np.flatnonzero(clear.any(axis=1)).tolist():
            chosen = int(np.argmax(clear[k]))
            self._add_pool(pools, pixel[k, chosen], float(_SHARES[chosen]))
        rows = np.flatnonzero(pools.any(axis=1))
        if not len(rows):
            return
        top, bottom = max(int(rows[0]) - 2, 0), min(int(rows[-1]) + 3, height)
        size = width * COARSE, (bottom - top) * COARSE
        bright = cv2.resize(pools[top:bottom], size, interpolation=cv2.INTER_LINEAR)
        part = picture[top * COARSE : bottom * COARSE]
        bright = bright[: part.shape[0], : part.shape[1]]
        albedo = self._albedo[top * COARSE : bottom * COARSE]
        cv2.add(part, cv2.multiply(albedo, cv2.merge([bright] * 3), scale=1.0 / 255.0), dst=part)

    def _add_pool(
        self, pools: NDArray[np.uint8], corners: NDArray[np.float64], share: float
    ) -> None:
        """Add the nearer `share` of a pool whose corners (4, 2) lie at these pixels."""
        quad = (corners / COARSE - 0.5).astype(np.float32)
        (left, top), (right, bottom) = quad.min(axis=0).tolist(), quad.max(axis=0).tolist()
        height, width = pools.shape
        left, top = max(int(left), 0), max(int(top), 0)
        right, bottom = min(int(right) + 2, width), min(int(bottom) + 2, height)
        if right <= left or bottom <= top:
            return
        rows, columns = self._pool.shape
        used = max(round(rows * share), 2)
        texture = np.array(
            [[0, 0], [columns - 1, 0], [columns - 1, used - 1], [0, used - 1]], np.float32
        )
        matrix = cv2.getPerspectiveTransform(texture, quad - np.array([left, top], np.float32))
        size = right - left, bottom - top
        part = pools[top:bottom, left:right]
        cv2.add(part, cv2.warpPerspective(self._pool[:used], matrix, size), dst=part)


def _pool_corners(bodies: list[Body]) -> NDArray[np.float64]:
    """(N, shares, 4, 3) corners of the pools on the ground, by how much of them is kept."""
    heading = np.array([body.heading_rad for body in bodies])
    ahead = np.column_stack([np.cos(heading), np.sin(heading)])
    left = np.column_stack([-ahead[:, 1], ahead[:, 0]])
    bumper = np.array([0.5 * body.solid.size_m[0] for body in bodies])
    near, far = POOL_M
    ends = near + _SHARES * (far - near)
    x = np.stack([np.full_like(ends, near)] * 2 + [ends] * 2, axis=1)  # (shares, 4)
    y = HALF_WIDTH_M * np.array([1.0, -1.0, -1.0, 1.0])
    reach = bumper[:, None, None] + x
    middle = np.array([body.xy for body in bodies])
    ground = (
        middle[:, None, None]
        + reach[..., None] * ahead[:, None, None]
        + y[:, None] * left[:, None, None]
    )
    return np.concatenate([ground, np.zeros((*ground.shape[:3], 1))], axis=3)


def _pool_texture() -> NDArray[np.uint8]:
    """Light of a pair of low beams on the road: rows lead away from the car, columns to its left.

    The shape is that of a low beam's cut-off: bright from 6 to 20 m, wider further away.
    """
    x = np.linspace(*POOL_M, 90)[:, None]
    y = np.linspace(HALF_WIDTH_M, -HALF_WIDTH_M, 64)[None, :]
    spread = 0.8 + 0.10 * x
    beams = sum(np.exp(-(((y - side) / spread) ** 2)) for side in (-0.6, 0.6))
    along = (1.0 - np.exp(-((x / 5.0) ** 2))) * np.exp(-x / 15.0)
    edge = np.clip((HALF_WIDTH_M - np.abs(y)) / 2.0, 0.0, 1.0)
    end = np.clip((POOL_M[1] - x) / 10.0, 0.0, 1.0) * edge
    light = np.asarray(beams * along * end)
    return np.asarray(np.rint(235.0 * light / light.max()), dtype=np.uint8)
