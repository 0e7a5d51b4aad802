"""Lamps as the lens sees them at dusk and night: glare, and streaks on a wet road."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

import cv2
import numpy as np
from numpy.typing import NDArray

from geoorbit_ros.scenes.camera import PinholeCamera
from geoorbit_ros.scenes.render.painter import Body

WARM = np.array([0.72, 0.90, 1.0])
"""Blue, green, red of a head light."""
RED = np.array([0.16, 0.14, 1.0])
_LEVELS = 12
"""Steps of a sprite's brightness that are kept ready."""
_MAX_RADIUS_PX = 80
_MIRRORED = 0.55
"""Share of a lamp's light that a wet road mirrors."""
_FACING = 0.05
"""Cosine below which a lamp is seen from the side, and does not dazzle."""

Kind = Literal["head", "tail"]


@dataclass(frozen=True, slots=True)
class Glare:
    """One lamp in the picture.

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

    def draw(self, picture: NDArray[np.uint8], glares: list[Glare]) -> None:
        """Add lamps to a picture (H, W, 3)."""
        height, width = picture.shape[:2]
        for glare in glares:
            sprite = self._sprite(glare)
            rows, columns = sprite.shape[:2]
            left, top = round(glare.x) - columns // 2, round(glare.y) - rows // 2
            first, last = max(top, 0), min(top + rows, height)
            start, end = max(left, 0), min(left + columns, width)
            if first < last and start < end:
                part = picture[first:last, start:end]
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
