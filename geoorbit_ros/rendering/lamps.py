"""Lamps at dusk and night: glare in the lens, streaks on a wet road, pools of light on the road."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

import cv2
import numpy as np
from numpy.typing import NDArray

from geoorbit_ros.rendering.painter import Body
from geoorbit_ros.scenes.camera import PinholeCamera

WARM = np.array([0.72, 0.90, 1.0])
"""Blue, green, red of a headlight. Chosen by appearance."""
RED = np.array([0.16, 0.14, 1.0])
"""Blue, green, red of a tail light. Chosen by appearance."""
_LEVELS = 12
"""Steps of a sprite's brightness that are kept ready. Chosen: more take memory, fewer flicker."""
_MAX_RADIUS_PX = 80
"""Largest halo. Chosen: larger takes more time."""
_MIRRORED = 0.55
"""Share of a lamp's light that a wet road mirrors. Chosen by appearance."""
_FACING = 0.05
"""Cosine below which a lamp is seen from the side, and does not dazzle. Chosen by appearance."""

Kind = Literal["head", "tail"]


@dataclass(frozen=True, slots=True)
class Glare:
    """One lamp in the image.

    Attributes:
        kind: Of the lamp.
        wet: It is the mirrored image on the road.
        x: Column of its middle.
        y: Row of its middle.
        radius: Of its halo, pixels.
        level: Brightness, 0 to 1.
    """

    kind: Kind
    wet: bool
    x: float
    y: float
    radius: int
    level: float


class Lamps:
    """Draws lamps.

    Args:
        camera: The camera.
        strength: Brightness of the lamps, 0 to 1.
        wet: Whether the road mirrors them.
    """

    def __init__(self, camera: PinholeCamera, strength: float, wet: bool) -> None:
        self._camera = camera
        self._strength, self._wet = strength, wet
        self._unit = camera.image_size[1] / 720.0
        self._sprites: dict[tuple[Kind, bool, int, int], NDArray[np.uint8]] = {}

    def glares(self, bodies: list[Body]) -> list[list[Glare]]:
        """The lamps of each body that shine at the camera."""
        found: list[list[Glare]] = [[] for _ in bodies]
        counts = [len(body.solid.lamps) for body in bodies]
        if not sum(counts):
            return found
        owner = np.repeat(np.arange(len(bodies)), counts)
        local = np.concatenate([body.solid.lamps for body in bodies])
        front = np.concatenate([np.arange(count) < count // 2 for count in counts])
        heading = np.array([body.heading_rad for body in bodies])[owner]
        cos, sin = np.cos(heading), np.sin(heading)
        world = np.column_stack([cos * local[:, 0] - sin * local[:, 1], sin * local[:, 0]])
        world[:, 1] += cos * local[:, 1]
        world = np.column_stack([world + np.array([b.xy for b in bodies])[owner], local[:, 2]])
        towards = np.array([body.camera for body in bodies])[owner] - local
        distance = np.linalg.norm(towards, axis=1)
        facing = np.where(front, 1.0, -1.0) * towards[:, 0] / distance
        level = np.where(front, 0.25 + 0.9 * facing**2, 0.35 + 0.6 * facing)
        level = self._strength * np.minimum(level, 1.0)
        head = np.clip(2400.0 / distance, 10.0, 64.0)
        tail = np.clip(620.0 / distance, 4.5, 20.0)
        radius = np.clip(self._unit * np.where(front, head, tail) * level, 2.0, _MAX_RADIUS_PX)
        pixel, depth = self._camera.project(world)
        mirrored, _ = self._camera.project(world * (1.0, 1.0, -1.0))
        for k in np.flatnonzero((facing > _FACING) & (depth > 1.0)).tolist():
            kind: Kind = "head" if front[k] else "tail"
            size, bright = round(float(radius[k])), float(level[k])
            x, y = pixel[k].tolist()
            found[owner[k]].append(Glare(kind, False, x, y, size, bright))
            if self._wet:
                # Ripples draw the mirrored lamp out, towards the camera.
                x, y = mirrored[k].tolist()
                narrow = max(size // 2, 2)
                streak = Glare(kind, True, x, y + 2 * narrow, narrow, _MIRRORED * bright)
                found[owner[k]].append(streak)
        return found

    def draw(self, image: NDArray[np.uint8], glares: list[Glare]) -> None:
        """Add lamps to an image (H, W, 3)."""
        height, width = image.shape[:2]
        for glare in glares:
            sprite = self._sprite(glare)
            rows, columns = sprite.shape[:2]
            left, top = round(glare.x) - columns // 2, round(glare.y) - rows // 2
            first, last = max(top, 0), min(top + rows, height)
            start, end = max(left, 0), min(left + columns, width)
            if first < last and start < end:
                part = image[first:last, start:end]
                cut = sprite[first - top : last - top, start - left : end - left]
                cv2.add(part, cut, dst=part)

    def _sprite(self, glare: Glare) -> NDArray[np.uint8]:
        step = max(round(_LEVELS * glare.level), 1)
        key = glare.kind, glare.wet, glare.radius, step
        sprite = self._sprites.get(key)
        if sprite is None:
            sprite = _sprite(glare.kind, glare.wet, glare.radius, step / _LEVELS)
            self._sprites[key] = sprite
        return sprite


def _sprite(kind: Kind, wet: bool, radius: int, level: float) -> NDArray[np.uint8]:
    """A lamp with its halo; on a wet road a streak without a core."""
    tall = 5 if wet else 1
    y, x = np.mgrid[-tall * radius : tall * radius + 1, -radius : radius + 1].astype(np.float64)
    r = np.hypot(x, y / tall) / radius
    halo = 0.55 * np.clip(1.0 - r, 0.0, 1.0) ** 3
    core = np.exp(-((r / 0.16) ** 2)) * (0.0 if wet else 1.25)
    colour = WARM if kind == "head" else RED
    glow = halo[..., None] * colour + core[..., None] * (0.5 * colour + 0.5 * (colour > 0.5))
    return np.asarray(np.rint(255.0 * np.clip(level * glow, 0.0, 1.0)), dtype=np.uint8)


COARSE = 4
"""Pixels per pixel of the light on the ground: it has no sharp edges. Chosen: smaller takes more
time."""
POOL_M = (1.0, 46.0)
"""A low beam reaches from here to there ahead of the bumper. Chosen by appearance."""
HALF_WIDTH_M = 8.0
"""Width of a low beam on the road, to either side. Chosen by appearance: two lanes."""
_SHARES = np.array([1.0, 0.6, 0.3])
"""Shares of a beam that are tried: the longest that does not reach behind the camera is drawn."""
_NEAR_M = 2.0
"""What reaches nearer to the camera counts as behind it. Chosen: the projection is unbounded
there."""


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

    def light_road(self, image: NDArray[np.uint8], bodies: list[Body]) -> None:
        """Add the pools of light ahead of the vehicles to an image (H, W, 3)."""
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
        part = image[top * COARSE : bottom * COARSE]
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
