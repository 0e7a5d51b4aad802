"""How the motion detector notices that its image has moved against the road that it has learnt."""

from __future__ import annotations

from collections import deque
from functools import lru_cache

import cv2
import numpy as np
from numpy.typing import NDArray

from geoorbit_ros.detection.detector import Image

PERIOD_S = 0.4
"""Time between two comparisons. Chosen: with `TIMES` it takes 1.2 s to notice a bump; shorter
periods take more time and agree within one sway."""
WIDTH_PX = 320
"""Images are compared at about this width. Chosen: wider takes more time, narrower sees less."""
MIN_SHIFT = 0.6
"""Smaller shifts, in pixels at that width, are sway, which the road's contrast allows for. Chosen:
larger leaves a small bump unnoticed, smaller learns the road anew in the wind."""
TIMES = 3
"""So many comparisons in a row must agree, because sway swings back. Chosen: more lose time."""
AGREEMENT = 0.5
"""Shifts that agree differ by less than this, in pixels at that width. Chosen: larger accepts sway,
smaller rejects a bump seen with noise."""
MIN_RESPONSE = 0.15
"""Least peak of the correlation, 1 for identical images. Chosen: larger misses bumps of poor
images, smaller finds shifts in images that have nothing in common."""
SWAY_SHARE = 0.75
"""The image sways by as much as this share of the latest shifts. Chosen: larger takes one wrong
shift for sway, smaller underrates it: most of a swing is spent near its ends."""
SWAY_LOOKS = 12
"""Shifts that tell the sway, of some five seconds. Chosen: more react to wind later."""


class RoadShift:
    """Measures how far the image has moved against the road, a few times a second.

    Attributes:
        sway_px: By how many pixels the image moves to and fro.
    """

    def __init__(self) -> None:
        self.sway_px = 0.0
        self._latest: deque[float] = deque(maxlen=SWAY_LOOKS)
        self._looked_ns: int | None = None
        self._shifts: list[NDArray[np.float64]] = []

    def shift(self, stamp_ns: int, image: Image, road: Image) -> NDArray[np.float64] | None:
        """(2,) pixels right and down by which the camera's image has moved for good, if it has.

        Args:
            stamp_ns: Capture time.
            image: (H, W, 3).
            road: The same view without vehicles, as known.
        """
        last = self._looked_ns
        if last is not None and 0 <= stamp_ns - last < PERIOD_S * 1e9:
            return None
        self._looked_ns = stamp_ns
        step = max(image.shape[1] // WIDTH_PX, 1)
        found, response = _shift(_small(image, step), _small(road, step))
        if response >= MIN_RESPONSE:
            self._latest.append(float(np.hypot(*found)) * step)
            self.sway_px = float(np.quantile(self._latest, SWAY_SHARE))
        if response < MIN_RESPONSE or np.hypot(*found) < MIN_SHIFT:
            self._shifts.clear()
            return None
        self._shifts.append(found)
        recent = np.array(self._shifts[-TIMES:])
        if len(recent) < TIMES or np.ptp(recent, axis=0).max() > AGREEMENT:
            return None
        self._shifts.clear()
        return np.asarray(recent.mean(axis=0) * step)


def _shift(
    now: NDArray[np.float32], then: NDArray[np.float32]
) -> tuple[NDArray[np.float64], float]:
    """(2,) pixels right and down from one image to the other, and how much they are alike."""
    offset, response = cv2.phaseCorrelate(then, now, _window(now.shape[1], now.shape[0]))
    return np.array(offset, dtype=np.float64), response


@lru_cache(maxsize=4)
def _window(width: int, height: int) -> NDArray[np.float32]:
    return np.asarray(cv2.createHanningWindow((width, height), cv2.CV_32F), np.float32)


def _small(image: Image, step: int) -> NDArray[np.float32]:
    """The image in grey, each pixel the mean of `step` x `step`."""
    size = (image.shape[1] // step, image.shape[0] // step)
    smaller = cv2.resize(image, size, interpolation=cv2.INTER_AREA)
    grey = cv2.cvtColor(smaller, cv2.COLOR_BGR2GRAY)
    return np.asarray(grey, dtype=np.float32)
