"""What happens to the image on its way: rain before the lens, drifting light, blur, noise, sway."""

from __future__ import annotations

import cv2
import numpy as np
from numpy.typing import NDArray

from geoorbit_ros.rendering.conditions import Conditions, Light

RAIN_MARGIN_PX = 96
"""The layer of streaks is this much larger than the image, so that it can start anywhere. Chosen:
more takes memory, less repeats sooner."""
_TILES = 4
"""Different layers of streaks. Chosen: as `RAIN_MARGIN_PX`."""
_BRIGHTNESS: dict[Light, tuple[int, int]] = {"day": (6, 20), "dusk": (5, 15), "night": (3, 10)}
"""Least and most brightness of a streak, grey levels. Chosen by appearance."""
_VEIL: dict[Light, tuple[float, float]] = {
    "day": (0.86, 22.0),
    "dusk": (0.90, 10.0),
    "night": (0.95, 4.0),
}
"""Contrast that rain leaves, and the grey that it adds. Chosen by appearance."""


class Rain:
    """Streaks that are elsewhere in every frame, and a grey veil over the image.

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
            _streaks((width + RAIN_MARGIN_PX, height + RAIN_MARGIN_PX), _BRIGHTNESS[light], random)
            for _ in range(_TILES)
        ]

    def fall(self, image: NDArray[np.uint8], time_s: float) -> NDArray[np.uint8]:
        """The image (H, W, 3) behind rain."""
        contrast, grey = self._veil
        height, width = image.shape[:2]
        random = np.random.default_rng([self._seed, 27, max(round(time_s * 1e6), 0)])
        tile = self._tiles[int(random.integers(_TILES))]
        row, column = random.integers(0, RAIN_MARGIN_PX, 2)
        veiled = cv2.convertScaleAbs(image, alpha=contrast, beta=grey)
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


NOISE_MARGIN_PX = 128
"""The noise is this much larger than the image, so that it can start anywhere. Chosen: more takes
memory, less repeats sooner."""
_PERIODS_S = (211.0, 83.0, 37.0)
"""Periods of the drift of light by clouds. Chosen without a common multiple; slower than
vehicles."""
_SWAY_HZ = (0.43, 0.71, 1.3)
"""Frequencies of a pole's sway in the wind. Chosen without a common multiple; about every two
seconds, as `Conditions.shake_px` says."""


class Sensor:
    """Turns light into the image that a camera sends.

    Args:
        image_size: Width and height in pixels.
        conditions: How much the light drifts and the camera sways.
        noise: 1-sigma of the noise in grey levels.
        seed: The same one gives the same drift, sway and noise.
    """

    def __init__(
        self, image_size: tuple[int, int], conditions: Conditions, noise: float, seed: int
    ) -> None:
        width, height = image_size
        random = np.random.default_rng([seed, 24])
        self._phase = random.uniform(0.0, 2.0 * np.pi, (3, len(_PERIODS_S)))
        self._conditions = conditions
        self._seed = seed
        shape = height + NOISE_MARGIN_PX, width + NOISE_MARGIN_PX
        # Brightness noise is finer and stronger than colour noise, as after a Bayer filter.
        grain = random.standard_normal((*shape, 1)).astype(np.float32)
        colour = random.standard_normal((*shape, 3)).astype(np.float32)
        total = np.float32(noise) * (0.85 * grain + 0.75 * cv2.GaussianBlur(colour, (0, 0), 0.8))
        self._brighter = np.rint(np.maximum(total, 0.0)).astype(np.uint8)
        self._darker = np.rint(np.maximum(-total, 0.0)).astype(np.uint8)

    def sunshine(self, time_s: float) -> float:
        """How much the sun is out, 0 to 1; it drifts with the clouds."""
        clouds = self._conditions.clouds
        return float(np.clip(1.0 + 3.0 * clouds * (self._wave(0, time_s) - 0.3), 0.35, 1.0))

    def exposure(self, time_s: float) -> float:
        """Brightness of the image relative to its mean."""
        return 1.0 + self._conditions.clouds * self._wave(0, time_s)

    def sway_px(self, time_s: float) -> tuple[float, float]:
        """Where the image is shifted to, right and down."""
        sigma = self._conditions.shake_px
        if sigma == 0.0:
            return 0.0, 0.0
        angle = 2.0 * np.pi * np.array(_SWAY_HZ) * time_s
        scale = sigma * np.sqrt(2.0 / len(_SWAY_HZ))
        x, y = (
            scale * np.sin(angle + self._phase[1]).sum(),
            scale * np.sin(angle + self._phase[2]).sum(),
        )
        return float(x), float(0.6 * y)

    def expose(self, image: NDArray[np.uint8], time_s: float) -> NDArray[np.uint8]:
        """The image (H, W, 3) as the camera sends it at `time_s`."""
        x, y = self.sway_px(time_s)
        if x or y:
            shift = np.array([[1.0, 0.0, x], [0.0, 1.0, y]])
            size = image.shape[1], image.shape[0]
            moved = cv2.warpAffine(image, shift, size, borderMode=cv2.BORDER_REPLICATE)
            image = np.asarray(moved, dtype=np.uint8)
        blurred = cv2.GaussianBlur(image, (3, 3), 0.55)
        exposed = cv2.convertScaleAbs(blurred, alpha=self.exposure(time_s))
        height, width = exposed.shape[:2]
        # Microseconds name the frame: the same time gives the same noise.
        random = np.random.default_rng([self._seed, 25, max(round(time_s * 1e6), 0)])
        row, column = random.integers(0, NOISE_MARGIN_PX, 2)
        at = slice(row, row + height), slice(column, column + width)
        cv2.add(exposed, self._brighter[at], dst=exposed)
        cv2.subtract(exposed, self._darker[at], dst=exposed)
        return np.asarray(exposed, dtype=np.uint8)

    def _wave(self, row: int, time_s: float) -> float:
        angle = 2.0 * np.pi * time_s / np.array(_PERIODS_S) + self._phase[row]
        return float(np.sin(angle) @ np.array([0.5, 0.3, 0.2]))
