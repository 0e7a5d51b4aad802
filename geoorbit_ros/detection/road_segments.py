"""Where in the image vehicles drive: a heat map of detections, and its contours.

The paper's road segment generation (section 4, knowledge-based lane detection): detections of the
observation period are counted per cell; the outlines of cells with many are the road segments.
"""

from __future__ import annotations

import cv2
import numpy as np
from numpy.typing import NDArray

CELL_PX = 8
"""Side of a cell of the heat map. Chosen: larger blurs the road's edge, smaller needs more
detections."""
MIN_FRAMES = 3.0
"""Detections that must have covered a cell of the road, faded ones counting less. Chosen: more miss
quiet roads, fewer take false boxes for road."""
MIN_SHARE = 0.02
"""The same as a share of the busiest cells (95th percentile): false alarms are rare in comparison.
Chosen: larger misses quiet lanes beside busy ones."""
MEMORY_S = 3600.0
"""Time after which a detection counts 37 %. Chosen: longer keeps old roads after the camera turned,
shorter forgets quiet roads."""
UPDATE_S = 5.0
"""Time between two drawings of the contours. Chosen: shorter takes more time."""
LEARNING_S = 30.0
"""Time before which nothing is outside. Chosen: shorter leaves lanes out that no vehicle used
yet."""
MIN_CELLS = 12
"""Least area of a road segment in cells. Chosen: larger misses far roads, smaller finds false
boxes."""
FOOT = 0.5
"""Share of a box, from below, that is taken to stand on the road; the rest hides what is behind it.
Chosen: larger adds what is behind the road, smaller finds less of it."""
_SMOOTH_CELLS = 3
"""Gaps of so many cells are closed, and segments widened by one cell. Chosen: larger joins
roads."""
_MAX_ERROR_PX = 4.0
"""Contours are simplified by at most this. Chosen: half a cell; smaller gives longer messages."""

Contour = NDArray[np.float32]
"""(K, 2) pixels, closed, in the order of cv2.findContours."""


class RoadSegments:
    """Learns the road segments of one camera from its detections.

    Args:
        image_size: Width and height.

    Attributes:
        contours: The segments, the largest first; empty until enough was seen.
        outside: Detections so far whose foot was on no segment.
    """

    def __init__(self, image_size: tuple[int, int]) -> None:
        self.image_size = image_size
        width, height = (-(-side // CELL_PX) for side in image_size)
        self._heat = np.zeros((height, width), dtype=np.float32)
        self._mask = np.zeros((height, width), dtype=np.uint8)
        self._first_ns: int | None = None
        self._drawn_ns = 0
        self.contours: tuple[Contour, ...] = ()
        self.outside = 0

    @property
    def heat(self) -> NDArray[np.float32]:
        """(H, W) faded number of detections that covered each cell."""
        return self._heat

    def add(self, stamp_ns: int, rows: NDArray[np.void]) -> NDArray[np.bool_]:
        """Learn from one frame.

        Args:
            stamp_ns: Capture time.
            rows: (N,) `DETECTION_DTYPE`.

        Returns:
            (N,) whether each detection stands on a segment; all do until there are any.
        """
        if self._first_ns is None or stamp_ns < self._drawn_ns:
            self._first_ns = self._drawn_ns = stamp_ns
        left, top, right, bottom = self._feet(rows)
        for a, b, c, d in zip(left, top, right, bottom, strict=True):
            self._heat[b:d, a:c] += 1.0
        if stamp_ns - self._drawn_ns >= UPDATE_S * 1e9:
            self._draw(stamp_ns)
        if not self.contours:
            return np.ones(len(rows), dtype=bool)
        x, y = (left + right) // 2, np.maximum(bottom - 1, 0)
        inside = self._mask[y, np.minimum(x, self._mask.shape[1] - 1)] > 0
        self.outside += int(np.count_nonzero(~inside))
        return np.asarray(inside)

    def _feet(self, rows: NDArray[np.void]) -> tuple[NDArray[np.int64], ...]:
        """Cells (N,) of the lower part of each box: left, top, right, bottom, at least one cell."""
        half = 0.5 * rows["width"]
        low = rows["y"] + 0.5 * rows["height"]
        height, width = self._heat.shape
        edges = (rows["x"] - half, low - FOOT * rows["height"], rows["x"] + half, low)
        a, b, c, d = (np.floor(edge / CELL_PX).astype(np.int64) for edge in edges)
        a, b = np.clip(a, 0, width - 1), np.clip(b, 0, height - 1)
        return a, b, np.clip(c + 1, a + 1, width), np.clip(d + 1, b + 1, height)

    def _draw(self, stamp_ns: int) -> None:
        first_ns = self._first_ns if self._first_ns is not None else stamp_ns
        self._heat *= np.exp(-(stamp_ns - self._drawn_ns) / 1e9 / MEMORY_S)
        self._drawn_ns = stamp_ns
        busy = self._heat[self._heat > 0.0]
        if stamp_ns - first_ns < LEARNING_S * 1e9 or not len(busy):
            return
        level = max(MIN_FRAMES, MIN_SHARE * float(np.percentile(busy, 95.0)))
        mask = (self._heat >= level).astype(np.uint8)
        kernel = cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (_SMOOTH_CELLS, _SMOOTH_CELLS))
        mask = np.asarray(cv2.dilate(cv2.morphologyEx(mask, cv2.MORPH_CLOSE, kernel), kernel))
        outlines, _ = cv2.findContours(mask, cv2.RETR_EXTERNAL, cv2.CHAIN_APPROX_SIMPLE)
        self._mask[:] = 0
        found = []
        for outline in sorted(outlines, key=cv2.contourArea, reverse=True):
            if cv2.contourArea(outline) < MIN_CELLS:
                continue
            cv2.drawContours(self._mask, [outline], -1, 1, cv2.FILLED)
            short = cv2.approxPolyDP(outline, _MAX_ERROR_PX / CELL_PX, True).reshape(-1, 2)
            pixels = (short.astype(np.float32) + 0.5) * CELL_PX
            found.append(np.clip(pixels, 0.0, np.array(self.image_size, dtype=np.float32)))
        self.contours = tuple(found)
