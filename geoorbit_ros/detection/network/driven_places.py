"""Where vehicles drive, and boxes that stand where nothing ever drove."""

from __future__ import annotations

import cv2
import numpy as np
from numpy.typing import NDArray

from geoorbit_ros.detection.network.boxes import Boxes

CELL_PX = 8
"""Side of a cell. Chosen: larger takes the verge for the road, smaller needs more vehicles."""
MOVED_CONTRAST = 20
"""Grey levels by which a pixel differs from the past where something moves. Chosen: above the noise
of a compressed film; larger misses grey vehicles on grey roads."""
MOVED_SHARE = 0.12
"""Share of a box that differs from the past where a vehicle drives. Chosen: of a slow vehicle only
the ends differ; larger misses those, smaller takes leaves before a sign for driving."""
DRIVES = 3
"""So many boxes must have driven over a cell. Chosen: more need more vehicles, one would be
noise."""
PATIENCE_S = 5.0
"""A box may stand so long where nothing drove. Chosen: half of the ten seconds that no false box
shall live; shorter loses queues that a camera sees first."""
SURE_SCORE = 0.6
"""Boxes that score this stay for ever: parked vehicles. Chosen: larger loses queues of the first
image, smaller keeps signs and rails."""


class DrivenPlaces:
    """Knows for each cell of the image whether vehicles drove there, and how long a box stands.

    Args:
        size: Width and height of the images.
    """

    def __init__(self, size: tuple[int, int]) -> None:
        shape = -(-size[1] // CELL_PX), -(-size[0] // CELL_PX)
        self._driven = np.zeros(shape, dtype=np.uint16)
        self._stood_s = np.zeros(shape, dtype=np.float32)
        self._last_ns: int | None = None

    def plausible(self, stamp_ns: int, boxes: Boxes, moved: NDArray[np.uint8]) -> NDArray[np.bool_]:
        """(N,) which boxes are no clutter; learns from them.

        Args:
            stamp_ns: Capture time.
            boxes: All boxes of the image.
            moved: (H, W) difference from an image shortly before.
        """
        last_ns, self._last_ns = self._last_ns, stamp_ns
        elapsed_s = min(max(stamp_ns - last_ns, 0) / 1e9, 1.0) if last_ns is not None else 0.0
        sums = cv2.integral((moved > MOVED_CONTRAST).astype(np.uint8))
        height, width = moved.shape
        corners = np.clip(np.rint(boxes.corners), 0, [width, height, width, height]).astype(int)
        standing = np.zeros_like(self._stood_s, dtype=bool)
        kept = np.ones(len(corners), dtype=bool)
        for k, (left, top, right, bottom) in enumerate(corners.tolist()):
            inside = sums[bottom, right] - sums[top, right] - sums[bottom, left] + sums[top, left]
            share = inside / max((right - left) * (bottom - top), 1)
            foot = slice((top + bottom) // 2 // CELL_PX, -(-bottom // CELL_PX))
            place = foot, slice(left // CELL_PX, -(-right // CELL_PX))
            if share >= MOVED_SHARE:
                self._driven[place] = np.minimum(self._driven[place] + 1, DRIVES)
            elif not (self._driven[place] >= DRIVES).any():
                standing[place] = True
                stood_s = self._stood_s[place].max(initial=0.0)
                kept[k] = stood_s < PATIENCE_S or boxes.score[k] >= SURE_SCORE
        # A place that is free for a while begins anew; a box missing from one image is no such.
        self._stood_s = np.where(
            standing, self._stood_s + elapsed_s, np.maximum(self._stood_s - 0.25 * elapsed_s, 0.0)
        ).astype(np.float32)
        np.minimum(self._stood_s, 2.0 * PATIENCE_S, out=self._stood_s)
        return kept
