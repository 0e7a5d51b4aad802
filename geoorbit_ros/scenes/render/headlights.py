"""Lamps at dusk and night: pools of light on the road, glare in the lens, streaks on a wet road."""

from __future__ import annotations

import cv2
import numpy as np
from numpy.typing import NDArray

from geoorbit_ros.scenes.camera import PinholeCamera
from geoorbit_ros.scenes.render.painter import Body

COARSE = 4
"""Pixels per pixel of the light on the ground."""
POOL_M = (1.0, 46.0)
"""A low beam reaches from here to there ahead of the bumper."""
POOL_HALF_WIDTH_M = 8.0
_WARM = np.array([0.72, 0.90, 1.0])
_RED = np.array([0.16, 0.14, 1.0])
_LEVELS = 12
"""Steps of a sprite's brightness that are kept ready."""
_MAX_SPRITE_PX = 80


class Headlights:
    """Adds the light of the vehicles' own lamps.

    Args:
        camera: The camera.
        albedo: (H, W, 3) colours of the ground without light, 0 to 1.
        strength: Brightness of the lamps, 0 to 1.
        wet: Whether the road mirrors them.
    """

    def __init__(
        self, camera: PinholeCamera, albedo: NDArray[np.float32], strength: float, wet: bool
    ) -> None:
        width, height = camera.image_size
        self._camera = camera
        self._strength, self._wet = strength, wet
        self._size = -(-width // COARSE), -(-height // COARSE)
        tinted = 255.0 * np.clip(albedo * (0.95 * strength * _WARM), 0.0, 1.0)
        self._albedo = np.rint(tinted).astype(np.uint8)
        self._pool = _pool_texture()
        self._unit = height / 720.0
        self._sprites: dict[tuple[str, int, int], NDArray[np.uint8]] = {}

    def light_road(self, picture: NDArray[np.uint8], bodies: list[Body]) -> None:
        """Add the pools of light ahead of the vehicles to a picture (H, W, 3)."""
        width, height = self._size
        pools = np.zeros((height, width), np.uint8)
        for body in bodies:
            self._add_pool(pools, body)
        rows = np.flatnonzero(pools.any(axis=1))
        if not len(rows):
            return
        top, bottom = max(rows[0] - 2, 0), min(rows[-1] + 3, height)
        size = width * COARSE, (bottom - top) * COARSE
        bright = cv2.resize(pools[top:bottom], size, interpolation=cv2.INTER_LINEAR)
        part = picture[top * COARSE : bottom * COARSE]
        bright = bright[: part.shape[0], : part.shape[1]]
        albedo = self._albedo[top * COARSE : bottom * COARSE]
        cv2.add(part, cv2.multiply(albedo, cv2.merge([bright] * 3), scale=1.0 / 255.0), dst=part)

    def _add_pool(self, pools: NDArray[np.uint8], body: Body) -> None:
        ahead = np.array([np.cos(body.heading_rad), np.sin(body.heading_rad)])
        left = np.array([-ahead[1], ahead[0]])
        bumper = float(body.solid.corners[:, 0].max())
        rows, columns = self._pool.shape
        near, far = POOL_M
        for share in (1.0, 0.6, 0.3):  # what would reach behind the camera is left out
            end = near + share * (far - near)
            corners = np.array(
                [
                    body.xy + (bumper + x) * ahead + y * left
                    for x, y in (
                        (near, POOL_HALF_WIDTH_M),
                        (near, -POOL_HALF_WIDTH_M),
                        (end, -POOL_HALF_WIDTH_M),
                        (end, POOL_HALF_WIDTH_M),
                    )
                ]
            )
            pixel, depth = self._camera.project(np.column_stack([corners, np.zeros(4)]))
            if depth.min() > 2.0:
                break
        else:
            return
        quad = (pixel / COARSE - 0.5).astype(np.float32)
        low = np.maximum(np.floor(quad.min(axis=0)).astype(int), 0)
        high = np.minimum(np.ceil(quad.max(axis=0)).astype(int) + 1, pools.shape[::-1])
        if np.any(high - low < 1):
            return
        used = max(round(rows * share), 2)
        texture = np.array(
            [[0, 0], [columns - 1, 0], [columns - 1, used - 1], [0, used - 1]], np.float32
        )
        matrix = cv2.getPerspectiveTransform(texture, quad - low.astype(np.float32))
        size = int(high[0] - low[0]), int(high[1] - low[1])
        part = pools[low[1] : high[1], low[0] : high[0]]
        lit = cv2.warpPerspective(self._pool[:used], matrix, size, flags=cv2.INTER_LINEAR)
        cv2.add(part, lit, dst=part)

    def add_glare(self, picture: NDArray[np.uint8], body: Body) -> None:
        """Add the lamps of a vehicle that has just been drawn."""
        lamps = body.solid.lamps
        half = len(lamps) // 2
        cos, sin = np.cos(body.heading_rad), np.sin(body.heading_rad)
        turn = np.array([[cos, sin, 0.0], [-sin, cos, 0.0], [0.0, 0.0, 1.0]])
        world = lamps @ turn + np.append(body.xy, 0.0)
        pixel, _ = self._camera.project(world)
        mirrored, _ = self._camera.project(world * [1.0, 1.0, -1.0])
        for k, lamp in enumerate(lamps):
            towards = body.camera - lamp
            distance = float(np.linalg.norm(towards))
            front = k < half
            facing = float(towards[0]) / distance * (1.0 if front else -1.0)
            if facing <= 0.05:
                continue
            kind = "head" if front else "tail"
            if front:
                level = self._strength * min(1.0, 0.25 + 0.9 * facing**2)
                radius = self._unit * float(np.clip(2400.0 / distance, 10.0, 64.0)) * level
            else:
                level = self._strength * min(1.0, 0.35 + 0.6 * facing)
                radius = self._unit * float(np.clip(620.0 / distance, 4.5, 20.0)) * level
            self._add_sprite(picture, kind, pixel[k], radius, level)
            if self._wet:
                # Ripples draw the mirrored lamp out, towards the camera.
                below = mirrored[k] + [0.0, 2.5 * radius]
                self._add_sprite(picture, kind + "_wet", below, radius, 0.55 * level)

    def _add_sprite(
        self,
        picture: NDArray[np.uint8],
        kind: str,
        at: NDArray[np.float64],
        radius: float,
        level: float,
    ) -> None:
        size = int(np.clip(round(radius), 2, _MAX_SPRITE_PX))
        step = max(round(_LEVELS * min(level, 1.0)), 1)
        sprite = self._sprites.get((kind, size, step))
        if sprite is None:
            sprite = _sprite(kind, size, step / _LEVELS)
            self._sprites[kind, size, step] = sprite
        height, width = picture.shape[:2]
        rows, columns = sprite.shape[:2]
        left, top = round(float(at[0])) - columns // 2, round(float(at[1])) - rows // 2
        low = max(left, 0), max(top, 0)
        high = min(left + columns, width), min(top + rows, height)
        if low[0] >= high[0] or low[1] >= high[1]:
            return
        part = picture[low[1] : high[1], low[0] : high[0]]
        cut = sprite[low[1] - top : high[1] - top, low[0] - left : high[0] - left]
        cv2.add(part, cut, dst=part)


def _pool_texture() -> NDArray[np.uint8]:
    """Light of a pair of low beams on the road: rows lead away from the car, columns to its left.

    The shape is that of a low beam's cut-off: bright from 6 to 20 m, wider further away.
    """
    x = np.linspace(*POOL_M, 90)[:, None]
    y = np.linspace(POOL_HALF_WIDTH_M, -POOL_HALF_WIDTH_M, 64)[None, :]
    spread = 0.8 + 0.10 * x
    beams = sum(np.exp(-(((y - side) / spread) ** 2)) for side in (-0.6, 0.6))
    along = (1.0 - np.exp(-((x / 5.0) ** 2))) * np.exp(-x / 15.0)
    end = np.clip((POOL_M[1] - x) / 10.0, 0.0, 1.0) * np.clip((8.0 - np.abs(y)) / 2.0, 0.0, 1.0)
    light = np.asarray(beams * along * end)
    return np.asarray(np.rint(235.0 * light / light.max()), dtype=np.uint8)


def _sprite(kind: str, radius: int, level: float) -> NDArray[np.uint8]:
    """A lamp with its halo; on a wet road a streak."""
    wet = kind.endswith("_wet")
    tall = 4 if wet else 1
    y, x = np.mgrid[-tall * radius : tall * radius + 1, -radius : radius + 1].astype(np.float64)
    r = np.hypot(x, y / tall) / radius
    edge = np.clip(1.0 - r, 0.0, 1.0)
    halo = 0.55 * edge**3
    core = np.exp(-((r / 0.16) ** 2)) * (0.0 if wet else 1.25)
    colour = _WARM if kind.startswith("head") else _RED
    glow = halo[..., None] * colour + core[..., None] * (0.5 * colour + 0.5 * (colour > 0.5))
    return np.asarray(np.rint(255.0 * np.clip(level * glow, 0.0, 1.0)), dtype=np.uint8)
