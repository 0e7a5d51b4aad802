"""Falling rain before the lens."""

from __future__ import annotations

import cv2
import numpy as np
from numpy.typing import NDArray

from geoorbit_ros.rendering.conditions import Light

MARGIN = 96
_TILES = 4
_BRIGHTNESS: dict[Light, tuple[int, int]] = {"day": (6, 20), "dusk": (5, 15), "night": (3, 10)}
_VEIL: dict[Light, tuple[float, float]] = {
    # Contrast that is left, and the grey that is added.
    "day": (0.86, 22.0),
    "dusk": (0.90, 10.0),
    "night": (0.95, 4.0),
}


class Rain:
    """Streaks that are elsewhere in every frame, and a veil over the picture.

    Args:
        image_size: Width and height in pixels.
        light: Brightness of the drops.
        seed: The same one gives the same streaks.
    """

    def __init__(self, image_size: tuple[int, int], light: Light, seed: int) -> None:
        width, height = image_size
        random = np.random.default_rng([seed, 26])
        self._seed = seed
        self._veil = _VEIL[light]
        self._tiles = [
            _streaks((width + MARGIN, height + MARGIN), _BRIGHTNESS[light], random)
            for _ in range(_TILES)
        ]

    def fall(self, picture: NDArray[np.uint8], time_s: float) -> NDArray[np.uint8]:
        """The picture (H, W, 3) behind rain."""
        contrast, grey = self._veil
        height, width = picture.shape[:2]
        random = np.random.default_rng([self._seed, 27, max(round(time_s * 1e6), 0)])
        tile = self._tiles[int(random.integers(_TILES))]
        row, column = random.integers(0, MARGIN, 2)
        veiled = cv2.convertScaleAbs(picture, alpha=contrast, beta=grey)
        return np.asarray(
            cv2.add(veiled, tile[row : row + height, column : column + width]), dtype=np.uint8
        )


def _streaks(
    size: tuple[int, int], brightness: tuple[int, int], random: np.random.Generator
) -> NDArray[np.uint8]:
    """(H, W, 3) drops drawn out by their fall during the exposure."""
    width, height = size
    layer = np.zeros((height, width), np.uint8)
    unit = height / 720.0
    slant = 0.10
    for _ in range(round(0.0011 * width * height)):
        x, y = random.uniform(0, width), random.uniform(-60, height)
        near = random.uniform() ** 2
        length = unit * (6.0 + 30.0 * near)
        level = int(random.integers(*brightness))
        end = round(x + slant * length), round(y + length)
        cv2.line(layer, (round(x), round(y)), end, level, 1, cv2.LINE_AA)
    return np.asarray(cv2.merge([cv2.GaussianBlur(layer, (3, 3), 0.6)] * 3), dtype=np.uint8)
