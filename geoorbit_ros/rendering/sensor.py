"""What happens to the picture in the camera: drifting light, blur, noise, sway."""

from __future__ import annotations

import cv2
import numpy as np
from numpy.typing import NDArray

from geoorbit_ros.rendering.conditions import Conditions

MARGIN = 128
"""The noise picture is this much larger than the image, so that it can start anywhere."""
_PERIODS_S = (211.0, 83.0, 37.0)
"""Clouds: periods of the drift of light."""
_SWAY_HZ = (0.43, 0.71, 1.3)
"""A pole in the wind: frequencies of its sway."""


class Sensor:
    """Turns light into the picture that a camera sends.

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
        shape = height + MARGIN, width + MARGIN
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
        """Brightness of the picture relative to its mean."""
        return 1.0 + self._conditions.clouds * self._wave(0, time_s)

    def sway_px(self, time_s: float) -> tuple[float, float]:
        """Where the picture is shifted to, right and down."""
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

    def expose(self, picture: NDArray[np.uint8], time_s: float) -> NDArray[np.uint8]:
        """The picture (H, W, 3) as the camera sends it at `time_s`."""
        x, y = self.sway_px(time_s)
        if x or y:
            shift = np.array([[1.0, 0.0, x], [0.0, 1.0, y]])
            size = picture.shape[1], picture.shape[0]
            moved = cv2.warpAffine(picture, shift, size, borderMode=cv2.BORDER_REPLICATE)
            picture = np.asarray(moved, dtype=np.uint8)
        blurred = cv2.GaussianBlur(picture, (3, 3), 0.55)
        exposed = cv2.convertScaleAbs(blurred, alpha=self.exposure(time_s))
        height, width = exposed.shape[:2]
        # Microseconds name the frame: the same time gives the same noise.
        random = np.random.default_rng([self._seed, 25, max(round(time_s * 1e6), 0)])
        row, column = random.integers(0, MARGIN, 2)
        at = slice(row, row + height), slice(column, column + width)
        cv2.add(exposed, self._brighter[at], dst=exposed)
        cv2.subtract(exposed, self._darker[at], dst=exposed)
        return np.asarray(exposed, dtype=np.uint8)

    def _wave(self, row: int, time_s: float) -> float:
        angle = 2.0 * np.pi * time_s / np.array(_PERIODS_S) + self._phase[row]
        return float(np.sin(angle) @ np.array([0.5, 0.3, 0.2]))
