"""Sample images, and the most usual value of each pixel in them: the road between vehicles."""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache

import cv2
import numpy as np
from numpy.typing import NDArray

from geoorbit_ros.detection.detector import Image

SHARE = 0.35
"""Share of the images in which the road must be free for it to be the most usual value. Chosen:
larger shows vehicles on roads that are hidden more than half of the time, smaller is noisier."""
MIN_IMAGES = 3
"""Images in the interval at least: with fewer there is no middle one."""


def most_usual(images: list[Image]) -> Image:
    """Pixel by pixel and channel by channel, the middle of the shortest interval with a `SHARE`.

    Where vehicles hide the road more than half of the time, the median shows them; but they differ
    from each other while the road stays the same (half-sample mode, Bickel and Frühwirth 2006, one
    step). Works on whole images by minima and maxima: milliseconds, where sorting each pixel
    takes seconds.
    """
    stack = list(images)
    for a, b in _network(len(stack)):
        low, high = cv2.min(stack[a], stack[b]), cv2.max(stack[a], stack[b])
        stack[a], stack[b] = np.asarray(low, np.uint8), np.asarray(high, np.uint8)
    span = min(max(round(SHARE * len(stack)), MIN_IMAGES), len(stack)) - 1
    middle = span // 2
    shortest = cv2.subtract(stack[span], stack[0])
    found = stack[middle].copy()
    for k in range(1, len(stack) - span):
        width = cv2.subtract(stack[k + span], stack[k])
        shorter = np.asarray(cv2.compare(width, shortest, cv2.CMP_LT), np.uint8)
        shortest = cv2.min(shortest, width)
        # Channel by channel: one view with a channel per column.
        cv2.copyTo(_flat(stack[k + middle]), _flat(shorter), _flat(found))
    return found


def _flat(image: NDArray[np.uint8]) -> NDArray[np.uint8]:
    return image.reshape(image.shape[0], -1)


@lru_cache(maxsize=64)
def _network(count: int) -> tuple[tuple[int, int], ...]:
    """Comparisons that sort `count` values: Batcher's odd-even merge sort (1968)."""
    pairs = []
    p = 1
    while p < count:
        k = p
        while k >= 1:
            for j in range(k % p, count - k, 2 * k):
                for i in range(min(k, count - j - k)):
                    if (i + j) // (2 * p) == (i + j + k) // (2 * p):
                        pairs.append((i + j, i + j + k))
            k //= 2
        p *= 2
    return tuple(pairs)


SAMPLES = 31
"""Images from which the most usual value is found. Chosen: more take memory (2.8 MB each at
1280x720) and time, fewer are noisier."""
FIRST_SPACING_S = 0.2
"""Time between the first images. Chosen: with `MIN_SAMPLES` the road is known after a second."""
LAST_SPACING_S = 3.2
"""Time between images after 100 s. With `SAMPLES` they then span 100 s. Chosen: a vehicle that
stands still for a third of that becomes part of the road; shorter would let queues become road."""
MIN_SAMPLES = 5
"""Images with which the road is first known. Chosen: more give no boxes for longer, fewer take slow
vehicles for road."""
CELL_PX = 16
"""The image is worked on in square cells of so many pixels each way. Chosen: larger cells work on
pixels where nothing moves, smaller ones cost more calls."""
WORK_SHARE = 0.8
"""Share of the time between two images in which the most usual values are found, a part in each
frame, so that no frame takes long. Chosen below 1: the work is done when the next image is kept."""
MIN_CELLS = 48
"""Cells worked on in one frame at least. Chosen: fewer cost more in calls than in work."""


@dataclass(frozen=True, slots=True)
class UsualCells:
    """Most usual values of some cells.

    Attributes:
        row: (N,) of the cells.
        column: (N,) of the cells.
        values: (N, CELL_PX, CELL_PX, 3) uint8, in the light of the samples.
    """

    row: NDArray[np.intp]
    column: NDArray[np.intp]
    values: Image


class RoadSamples:
    """Keeps a few images, farther and farther apart until they span 100 s.

    Where nothing ever moved a running mean knows the road: only cells in which something did are
    worked on.
    """

    def __init__(self) -> None:
        self._images: list[Image] = []
        self._stamps: list[int] = []
        self._busy = np.empty((0, 0), dtype=bool)
        self._waiting = np.empty((0, 2), dtype=np.intp)
        self._last_ns: int | None = None

    def due(self, stamp_ns: int) -> bool:
        """Whether it is time to keep an image."""
        last = self._stamps[-1] if self._stamps else None
        return last is None or not 0 <= stamp_ns - last < self._spacing_s() * 1e9

    def keep(self, stamp_ns: int, image: Image) -> None:
        """Keep an image (H, W, 3), in the same light as those before."""
        stamps = self._stamps
        if stamps and stamp_ns < stamps[-1]:  # a source that started again
            stamps[:] = [stamp - stamps[-1] + stamp_ns - 1 for stamp in stamps]
        if len(stamps) == SAMPLES:
            gaps = np.diff(stamps)
            # Thinned where they are closest, until the window is long enough to move on.
            drop = int(np.argmin(gaps)) + 1 if gaps.min() < 0.9e9 * LAST_SPACING_S else 0
            del stamps[drop], self._images[drop]
        self._images.append(padded(image))
        stamps.append(stamp_ns)
        if not len(self._waiting):
            self._waiting = np.argwhere(self._busy)

    def notice(self, moving: NDArray[np.uint8]) -> None:
        """Remember where something moves: (H, W) 255 there, 0 elsewhere."""
        whole = padded(moving)
        size = (whole.shape[1] // CELL_PX, whole.shape[0] // CELL_PX)
        some = cv2.resize(whole, size, interpolation=cv2.INTER_AREA) > 0
        self._busy = some if self._busy.shape != some.shape else self._busy | some

    def all(self) -> Image | None:
        """The most usual image; None while there are too few."""
        return most_usual(self._images) if len(self._images) >= MIN_SAMPLES else None

    def work(self, stamp_ns: int) -> UsualCells | None:
        """Most usual values of the next few cells, if any are due; call it once for each image."""
        last_ns, self._last_ns = self._last_ns, stamp_ns
        if not len(self._waiting) or len(self._images) < MIN_SAMPLES:
            return None
        step_ns = max(stamp_ns - last_ns, 1) if last_ns is not None else 10**9
        images = max(WORK_SHARE * self._spacing_s() * 1e9 / step_ns, 1.0)
        count = max(int(np.count_nonzero(self._busy) / images) + 1, MIN_CELLS)
        row, column = self._waiting[:count].T
        self._waiting = self._waiting[count:]
        parts = [
            np.ascontiguousarray(cells(image)[row, :, column]).reshape(-1, CELL_PX * 3)
            for image in self._images
        ]
        values = most_usual(parts).reshape(-1, CELL_PX, CELL_PX, 3)
        return UsualCells(row, column, values)

    def rewind(self) -> None:
        """Accept an earlier stamp next."""
        if self._stamps:
            back_ns = self._stamps[-1]
            self._stamps = [stamp_ns - back_ns for stamp_ns in self._stamps]
        self._last_ns = None

    def _spacing_s(self) -> float:
        window_s = (self._stamps[-1] - self._stamps[0]) / 1e9
        return float(np.clip(window_s / SAMPLES, FIRST_SPACING_S, LAST_SPACING_S))


def padded(image: NDArray[np.uint8]) -> NDArray[np.uint8]:
    """The image (H, W, …) with its last row and column repeated up to whole cells."""
    below, right = -image.shape[0] % CELL_PX, -image.shape[1] % CELL_PX
    if not below and not right:
        return image
    more = cv2.copyMakeBorder(image, 0, below, 0, right, cv2.BORDER_REPLICATE)
    return np.asarray(more, dtype=np.uint8)


def cells(image: NDArray[np.generic]) -> NDArray[np.generic]:
    """View (rows, CELL_PX, columns, CELL_PX, …) of a padded image."""
    height, width = image.shape[:2]
    shape = (height // CELL_PX, CELL_PX, width // CELL_PX, CELL_PX, *image.shape[2:])
    return image.reshape(shape)
