"""What outline vehicles have at each place of the image, learnt from those that stand alone."""

from __future__ import annotations

import cv2
import numpy as np
from numpy.typing import NDArray

from geoorbit_ros.detection.motion_sizes import Box

SIDE = 16
"""Outlines are kept in a grid of so many cells each way, stretched to the vehicle's box."""
MEMORY = 600
NEAREST = 25
"""So many outlines of vehicles nearest to a place are averaged."""
SHARPNESS = 2.0
FIRST_EXPONENT = 3.0
"""Before there are any: between an ellipse (2) and a box."""


class Silhouettes:
    """Remembers outlines of single vehicles, and tells the usual one of a place.

    All vehicles of a road stand the same way at one place of it, whatever their size.
    """

    def __init__(self) -> None:
        self._shapes = np.empty((MEMORY, SIDE, SIDE), dtype=np.float32)
        self._places = np.empty((MEMORY, 2))
        self._count = 0
        at = np.abs((np.arange(SIDE) + 0.5) * (2.0 / SIDE) - 1.0) ** FIRST_EXPONENT
        self._first = (at[:, None] + at[None, :] < 1.0).astype(np.float32)

    def add(self, pixels: NDArray[np.uint8], box: Box, corner: tuple[int, int]) -> None:
        """Remember one vehicle: its pixels (H, W) 0 or 1, its box, where the pixels begin."""
        x, y = corner
        inside = pixels[box[1] - y : box[3] - y, box[0] - x : box[2] - x].astype(np.float32)
        k = self._count % MEMORY
        self._shapes[k] = cv2.resize(inside, (SIDE, SIDE), interpolation=cv2.INTER_AREA)
        self._places[k] = 0.5 * (box[0] + box[2]), box[3]
        self._count += 1

    def at(self, x: float, bottom: float) -> NDArray[np.float32]:
        """(SIDE, SIDE) share of vehicles there that cover each part of their box."""
        known = min(self._count, MEMORY)
        if known < NEAREST:
            return np.asarray(self._first, dtype=np.float32)
        off = np.abs(self._places[:known] - (x, bottom)).sum(axis=1)
        near = np.argpartition(off, NEAREST - 1)[:NEAREST]
        mean: NDArray[np.float32] = self._shapes[near].mean(axis=0)
        return np.asarray(np.clip(SHARPNESS * (mean - 0.5) + 0.5, 0.0, 1.0), dtype=np.float32)
