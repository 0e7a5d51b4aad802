"""The empty road of a fixed camera, learnt while traffic passes."""

from __future__ import annotations

from itertools import pairwise

import cv2
import numpy as np
from numpy.typing import NDArray

from geoorbit_ros.detection.detector import Image
from geoorbit_ros.detection.motion.pixels import channel_max, scaled
from geoorbit_ros.detection.motion.samples import RoadSamples, UsualCells, cells, padded

FOLLOW_TIME_S = 2.0
"""How fast free road follows the light."""
FOLLOW_PERIOD_S, STRIPS = 0.3, 8
"""Every pixel follows so often, in strips of the picture one after the other."""
NOISE_FACTOR = 5.0
"""Contrast needed, in mean absolute deviations of the pixel."""
MIN_CONTRAST, MAX_CONTRAST = np.uint8(14), np.uint8(36)
"""Grey levels that a vehicle differs by at least (compression alone makes ten), and at most."""
SURROUNDINGS = np.ones((5, 5), dtype=np.uint8)
"""The road is not learnt this close to a vehicle."""
FIRST_DEVIATION = 2.0
_GRID = 16
"""Every so manieth pixel each way tells the brightness of the picture."""
_MIN_GAIN_STEP = 0.02


class RoadBackground:
    """What each pixel shows when no vehicle is there, and how much it wavers.

    A running mean where the road is free; corrected wherever it disagrees with the most usual value
    in pictures of the last minutes, so that a vehicle of the first picture doesn't stay as a ghost.

    Attributes:
        picture: (H, W, 3) uint8; the empty road as it looks now.
    """

    def __init__(self) -> None:
        self._samples = RoadSamples()
        self._reference = np.empty((0, 3), dtype=np.float32)
        self._followed_ns: list[int | None] = [None] * STRIPS
        self._mean = np.empty((0, 0, 3), dtype=np.float32)
        self._deviation = np.empty((0, 0), dtype=np.float32)
        self._road: Image = np.empty((0, 0, 3), dtype=np.uint8)
        self.picture = self._road
        self._contrast = self._difference = self._differs = self._road

    @property
    def ready(self) -> bool:
        """Whether enough pictures were seen to know the road."""
        return len(self.picture) > 0

    def sample(self, stamp_ns: int, picture: Image) -> None:
        """Keep this picture for the most usual value if it's time to, and work on that."""
        if self._samples.due(stamp_ns):
            # All in the same light, so that clouds don't make two roads of one.
            light = _ratio(_grid(picture), self._reference) if self.ready else np.ones(3)
            even = np.abs(light - 1.0).max() < 0.5 * _MIN_GAIN_STEP
            self._samples.keep(stamp_ns, picture.copy() if even else scaled(picture, 1.0 / light))
        if self.ready:
            usual = self._samples.work(stamp_ns)
            if usual is not None:
                self._correct(usual)
            return
        first = self._samples.all()
        if first is not None:
            self.restart(first[: picture.shape[0], : picture.shape[1]])

    def rewind(self) -> None:
        """Take the next stamp as it comes, be it earlier than the last; the road stays known."""
        self._samples.rewind()
        self._followed_ns = [None] * STRIPS

    def move(self, shift_px: NDArray[np.float64]) -> None:
        """Move the known road (2,) pixels right and down, and learn it anew from there."""
        matrix = np.array([[1.0, 0.0, shift_px[0]], [0.0, 1.0, shift_px[1]]])
        size = (self.picture.shape[1], self.picture.shape[0])
        moved = cv2.warpAffine(self.picture, matrix, size, borderMode=cv2.BORDER_REPLICATE)
        self.restart(np.asarray(moved, dtype=np.uint8))
        self._samples = RoadSamples()

    def restart(self, road: Image) -> None:
        """Begin with this picture of the empty road."""
        self._resize((road.shape[0], road.shape[1]))
        self._road[:] = padded(road)
        self._mean[:] = self._road
        self._deviation[:] = FIRST_DEVIATION
        self._contrast[:] = MIN_CONTRAST
        self._reference = _grid(road)

    def moving(self, picture: Image) -> NDArray[np.uint8]:
        """(H, W) 255 where the picture differs from the road by more than noise, 0 elsewhere."""
        gain = _ratio(_grid(picture), _grid(self.picture))
        if np.abs(gain - 1.0).max() > _MIN_GAIN_STEP:
            self._mean = np.minimum(self._mean * gain, np.float32(255.0))
            self._road[:] = cv2.convertScaleAbs(self._mean)
        cv2.absdiff(picture, self.picture, dst=self._difference)
        cv2.compare(self._difference, self._contrast, cv2.CMP_GT, dst=self._differs)
        some = cv2.cvtColor(self._differs, cv2.COLOR_BGR2GRAY)
        cv2.threshold(some, 0, 255, cv2.THRESH_BINARY, dst=some)
        return np.asarray(some, dtype=np.uint8)

    def follow(self, stamp_ns: int, picture: Image, moving: NDArray[np.uint8]) -> None:
        """Let the road follow the light where nothing moves; after `moving` of this picture."""
        self._samples.notice(moving)
        edges = np.linspace(0, len(picture), STRIPS + 1).astype(int).tolist()
        for k, (a, b) in enumerate(pairwise(edges)):
            last = self._followed_ns[k]
            if last is None or stamp_ns < last:  # spread over one period
                last = stamp_ns - round(FOLLOW_PERIOD_S * 1e9 * k / STRIPS)
                self._followed_ns[k] = last
            elapsed_s = (stamp_ns - last) / 1e9
            if elapsed_s < FOLLOW_PERIOD_S:
                continue
            self._followed_ns[k] = stamp_ns
            share = 1.0 - float(np.exp(-min(elapsed_s, 1.0) / FOLLOW_TIME_S))
            self._follow_rows(slice(a, b), picture, moving, share)

    def _follow_rows(
        self, rows: slice, picture: Image, moving: NDArray[np.uint8], share: float
    ) -> None:
        columns = slice(0, picture.shape[1])
        free = cv2.bitwise_not(cv2.dilate(moving[rows], SURROUNDINGS))
        mean, deviation = self._mean[rows, columns], self._deviation[rows, columns]
        cv2.accumulateWeighted(picture[rows], mean, share, free)
        # What differs more is a vehicle that was missed, not noise.
        noise = np.minimum(channel_max(self._difference[rows]), MIN_CONTRAST)
        cv2.accumulateWeighted(noise, deviation, share, free)
        wanted = cv2.convertScaleAbs(deviation, alpha=NOISE_FACTOR)
        contrast = np.clip(np.asarray(wanted, np.uint8), MIN_CONTRAST, MAX_CONTRAST)
        cv2.merge([contrast] * 3, dst=self._contrast[rows])
        cv2.convertScaleAbs(mean, dst=self.picture[rows])

    def _correct(self, usual: UsualCells) -> None:
        light = _ratio(_grid(self.picture), self._reference)
        at = (usual.row, slice(None), usual.column)
        seen = usual.values.astype(np.float32) * light
        mean = np.asarray(cells(self._mean)[at], dtype=np.float32)
        apart = np.abs(seen - mean).max(axis=3) > MIN_CONTRAST
        mean[apart] = seen[apart]
        cells(self._mean)[at] = mean
        cells(self._road)[at] = np.minimum(np.rint(mean), 255.0).astype(np.uint8)
        deviation = cells(self._deviation)[at]
        deviation[apart] = FIRST_DEVIATION
        cells(self._deviation)[at] = deviation

    def _resize(self, size: tuple[int, int]) -> None:
        """Arrays for pictures of this height and width; some have whole cells."""
        whole = padded(np.zeros(size, np.uint8)).shape
        self._mean = np.zeros((*whole, 3), dtype=np.float32)
        self._deviation = np.zeros(whole, dtype=np.float32)
        self._road = np.zeros((*whole, 3), dtype=np.uint8)
        self.picture = self._road[: size[0], : size[1]]
        self._contrast = np.zeros((*size, 3), dtype=np.uint8)
        self._difference = np.zeros((*size, 3), dtype=np.uint8)
        self._differs = np.zeros((*size, 3), dtype=np.uint8)


def _grid(picture: NDArray[np.generic]) -> NDArray[np.float32]:
    """(N, 3) pixels on a grid, enough to tell how bright the picture is."""
    return picture[::_GRID, ::_GRID].reshape(-1, 3).astype(np.float32)


def _ratio(now: NDArray[np.float32], then: NDArray[np.float32]) -> NDArray[np.float32]:
    """(3,) usual ratio of two grids, channel by channel."""
    return np.asarray(np.median((now + 1.0) / (then + 1.0), axis=0), dtype=np.float32)
