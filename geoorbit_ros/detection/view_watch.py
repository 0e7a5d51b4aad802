"""Notices that a camera was bumped, or shows another view: the whole image has moved or changed."""

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
OTHER_LOOKS = 5
"""So many images in a row must show another view, two seconds. Chosen: a lorry that fills the image
for a moment is none; more tell it later."""
MIN_BUMP = 1.0
"""Least shift for good, in pixels at `WIDTH_PX`. Chosen: larger misses bumps; images of one view
differ by 0.6 in wind and noise."""
ALIGNED_RESPONSE = 0.1
"""Peak of the correlation, at no shift, from which it is the same view however much traffic hides.
Chosen: unrelated images have up to 0.05, and peaks anywhere."""
USUAL_SHARE = 0.4
"""Another view has less than this share of the blocks in common that images of one view have.
Chosen: larger takes a jam for another view, smaller misses views that are alike."""
MOST_ALIKE = 0.35
"""Other views have at most this share of blocks in common. Of 4,830 pairs of images from 70 real
cameras 95 % had less than 0.16; images of one view have 0.3 to 1, in dense traffic 0.16 to 0.3."""
USUAL_LOOKS = 20
"""Looks over which that is usual, eight seconds."""
BLOCK_PX = 16
"""Side of a block at `WIDTH_PX`. Chosen: larger ones hold vehicles, smaller ones no pattern."""
MIN_PATTERN = 5.0
"""Grey levels, 1-sigma, of a block with a pattern. Chosen: noise has two."""
SAME_PATTERN = 0.5
"""Correlation of blocks that show the same. Chosen: unrelated ones exceed it in one of fifty."""
MIN_BLOCKS = 12
"""With fewer patterned blocks nothing is said: fog, night, a white wall."""
RENEW_S = 2.0
"""Time between the images of which the view without vehicles is the median."""
MEDIAN_OF = 9
"""So many of them. Chosen: more follow the light later, fewer show queues."""
LEAST_SAMPLES = 3
"""With fewer of them nothing is said: what vehicles hide is not told from the view."""
SOFT_PX = 1.0
"""1-sigma by which compared images are blurred: sway changes fine patterns."""


class ViewWatch:
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


class ViewChanges:
    """Notices in the images alone, whatever finds vehicles, that they show another view for good.

    Attributes:
        found: Stamp of the first image of each other view, and a sentence about it.
    """

    def __init__(self) -> None:
        self.found: list[tuple[int, str]] = []
        self._looked_ns: int | None = None
        self._renewed_ns = 0
        self._samples: list[NDArray[np.float32]] = []
        self._usual: deque[float] = deque(maxlen=USUAL_LOOKS)
        self._reference = np.empty((0, 0), dtype=np.float32)
        self._other: list[tuple[int, NDArray[np.float64]]] = []

    def look(self, stamp_ns: int, image: Image) -> None:
        """Compare an image, a few times a second, with what was seen before."""
        last = self._looked_ns
        if last is not None and 0 <= stamp_ns - last < PERIOD_S * 1e9:
            return
        self._looked_ns = stamp_ns
        step = max(image.shape[1] // WIDTH_PX, 1)
        now = np.asarray(cv2.GaussianBlur(_small(image, step), (0, 0), SOFT_PX), np.float32)
        if self._reference.shape != now.shape:
            self._begin(stamp_ns, now)
            return
        other = self._other_view(now)
        if other is None:
            self._other.clear()
            self._keep(stamp_ns, now)
            return
        self._other.append((stamp_ns, other * step))
        recent = self._other[-OTHER_LOOKS:]
        if len(recent) == OTHER_LOOKS and _agree([shift for _, shift in recent], step):
            self.found.append((recent[0][0], _sentence(recent[-1][1])))
            self._begin(stamp_ns, now)

    def _other_view(self, now: NDArray[np.float32]) -> NDArray[np.float64] | None:
        """(2,) shift of an image that has moved, NaN where it shows something else, else None."""
        likeness = _likeness(now, self._reference)
        if len(self._samples) >= LEAST_SAMPLES:  # before, traffic is not told from the view
            shift, response = _shift(now, self._reference)
            moved = _likeness(_moved(now, -shift), self._reference)
            alike = response >= MIN_RESPONSE and moved > max(likeness, MOST_ALIKE)
            if alike and np.hypot(*shift) >= MIN_BUMP:
                return shift
            aligned = response >= ALIGNED_RESPONSE and np.hypot(*shift) < MIN_BUMP
            unlike = likeness < min(USUAL_SHARE * float(np.median(self._usual)), MOST_ALIKE)
            if unlike and not aligned:
                return np.full(2, np.nan)
        self._usual.append(likeness)
        return None

    def _keep(self, stamp_ns: int, now: NDArray[np.float32]) -> None:
        """Let the view without vehicles follow the light."""
        if stamp_ns - self._renewed_ns >= RENEW_S * 1e9:
            self._renewed_ns = stamp_ns
            self._samples = [*self._samples[-MEDIAN_OF + 1 :], now]
            self._reference = np.median(self._samples, axis=0).astype(np.float32)

    def _begin(self, stamp_ns: int, now: NDArray[np.float32]) -> None:
        self._samples, self._reference, self._renewed_ns = [now], now, stamp_ns
        self._other.clear()
        self._usual.clear()


def _agree(shifts: list[NDArray[np.float64]], step: int) -> bool:
    """Whether all say the same: something else, or the same shift, which no sway has."""
    lost = np.isnan(shifts).any(axis=1)
    return bool(lost.all() or (~lost.any() and np.ptp(shifts, axis=0).max() <= AGREEMENT * step))


def _sentence(shift: NDArray[np.float64]) -> str:
    if np.isnan(shift).any():
        return "the camera shows another view"
    across, down = (round(float(x)) for x in shift)
    sideways = f"{abs(across)} px to the {'right' if across > 0 else 'left'}"
    return f"the image has moved by {sideways} and {abs(down)} px {'down' if down > 0 else 'up'}"


def _shift(
    now: NDArray[np.float32], then: NDArray[np.float32]
) -> tuple[NDArray[np.float64], float]:
    """(2,) pixels right and down from one image to the other, and how much they are alike."""
    offset, response = cv2.phaseCorrelate(then, now, _window(now.shape[1], now.shape[0]))
    return np.array(offset, dtype=np.float64), response


def _likeness(now: NDArray[np.float32], then: NDArray[np.float32]) -> float:
    """Share of the blocks with a pattern that show the same one; 1 where hardly any has one.

    Vehicles hide some blocks; in another view hardly any block shows the same.
    """
    a, b = _blocks(now), _blocks(then)
    covariance, spread = (a * b).mean(axis=1), a.std(axis=1) * b.std(axis=1)
    patterned = b.std(axis=1) >= MIN_PATTERN
    if np.count_nonzero(patterned) < MIN_BLOCKS:
        return 1.0
    same = covariance[patterned] > SAME_PATTERN * np.maximum(spread[patterned], 1e-6)
    return float(same.mean())


def _blocks(image: NDArray[np.float32]) -> NDArray[np.float32]:
    """(N, BLOCK_PX²) the pixels of each whole block, less their mean."""
    rows, columns = (side // BLOCK_PX for side in image.shape)
    whole = image[: rows * BLOCK_PX, : columns * BLOCK_PX]
    blocks = whole.reshape(rows, BLOCK_PX, columns, BLOCK_PX).swapaxes(1, 2)
    flat = blocks.reshape(rows * columns, -1)
    return np.asarray(flat - flat.mean(axis=1, keepdims=True))


def _moved(image: NDArray[np.float32], shift: NDArray[np.float64]) -> NDArray[np.float32]:
    matrix = np.array([[1.0, 0.0, shift[0]], [0.0, 1.0, shift[1]]])
    size = (image.shape[1], image.shape[0])
    moved = cv2.warpAffine(image, matrix, size, borderMode=cv2.BORDER_REPLICATE)
    return np.asarray(moved, np.float32)


@lru_cache(maxsize=4)
def _window(width: int, height: int) -> NDArray[np.float32]:
    return np.asarray(cv2.createHanningWindow((width, height), cv2.CV_32F), np.float32)


def _small(image: Image, step: int) -> NDArray[np.float32]:
    """The image in grey, each pixel the mean of `step` x `step`."""
    size = (image.shape[1] // step, image.shape[0] // step)
    smaller = cv2.resize(image, size, interpolation=cv2.INTER_AREA)
    grey = cv2.cvtColor(smaller, cv2.COLOR_BGR2GRAY)
    return np.asarray(grey, dtype=np.float32)
