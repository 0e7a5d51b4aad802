"""The empty road of a fixed camera, learnt while traffic passes."""

from __future__ import annotations

import math
from itertools import pairwise

import cv2
import numpy as np
from numpy.typing import NDArray

from geoorbit_ros.detection.detector import Image
from geoorbit_ros.detection.motion.background_samples import RoadSamples, UsualCells, cells, padded

FOLLOW_TIME_S = 2.0
"""Time constant by which free road follows the light. Chosen: longer lags behind clouds, shorter
learns slow vehicles."""
FOLLOW_PERIOD_S = 0.3
"""Every pixel follows the light once in so much time. Chosen: shorter takes more time."""
STRIPS = 8
"""The image follows in so many strips, one after the other, so that no frame takes long. Chosen:
more cost more calls."""
NOISE_FACTOR = 5.0
"""Contrast that a vehicle needs, in mean absolute deviations of the pixel. Chosen: larger misses
dark vehicles, smaller finds noise."""
MIN_CONTRAST = np.uint8(14)
"""Least contrast of a vehicle in grey levels. Chosen: video compression alone makes ten."""
MAX_CONTRAST = np.uint8(36)
"""Most contrast that is asked for, in grey levels. Chosen: larger misses vehicles before moving
trees, smaller finds the trees."""
SURROUNDINGS = np.ones((5, 5), dtype=np.uint8)
"""The road is not learnt this close to a vehicle: edges are blurred by two pixels. Chosen: wider
learns less road between vehicles."""
SWAY_FACTOR = 1.5
"""The road is known where it was at one moment of the sway, not in the middle of it. Chosen: at
most 2; larger hides small vehicles before a pattern."""
MAX_SWAY_PX = 4
"""A pixel is compared with the road as close to it as the camera sways, up to so many pixels and at
least one: the edges of paint differ by all of their contrast. Chosen: farther hides small vehicles
before a pattern."""
NOISE = 5
"""Grey levels by which noise exceeds that. Chosen: larger hides vehicles before a pattern, smaller
finds the edges of paint in a noisy image."""
FIRST_DEVIATION = 2.0
"""Mean absolute deviation, grey levels, of a pixel that is newly learnt: that of a camera by day.
Chosen: smaller finds noise at first, larger misses dark vehicles at first."""
_GRID = 16
"""Every 16th pixel each way shows how bright the image is. Chosen: fewer let one vehicle change the
median, more take time."""
_MIN_GAIN_STEP = 0.02
"""Smaller changes of brightness are left to `FOLLOW_TIME_S`. Chosen: 2 % of 255 is a third of the
least contrast; smaller takes time in every frame."""


class RoadBackground:
    """What each pixel shows when no vehicle is there, and how much it varies.

    A running mean where the road is free; corrected wherever it disagrees with the most usual value
    in images of the last minutes, so that a vehicle of the first image leaves
    no false vehicle where it stood.

    Attributes:
        image: (H, W, 3) uint8; the empty road as it looks now.
    """

    def __init__(self) -> None:
        self._samples = RoadSamples()
        self._sway = np.ones((3, 3), dtype=np.uint8)
        self._reference = np.empty((0, 3), dtype=np.float32)
        self._followed_ns: list[int | None] = [None] * STRIPS
        self._mean = np.empty((0, 0, 3), dtype=np.float32)
        self._deviation = np.empty((0, 0), dtype=np.float32)
        self._road: Image = np.empty((0, 0, 3), dtype=np.uint8)
        self.image = self._road
        self._contrast = self._darkest = self._lightest = self._road

    @property
    def ready(self) -> bool:
        """Whether enough images were seen for the road to be known."""
        return len(self.image) > 0

    def sample(self, stamp_ns: int, image: Image) -> None:
        """Keep this image as a sample if one is due, and do a part of the work on the samples."""
        if self._samples.due(stamp_ns):
            # All in the same light, so that clouds don't make two roads of one.
            light = _ratio(_grid(image), self._reference) if self.ready else np.ones(3)
            even = np.abs(light - 1.0).max() < 0.5 * _MIN_GAIN_STEP
            self._samples.keep(stamp_ns, image.copy() if even else _scaled(image, 1.0 / light))
        if self.ready:
            usual = self._samples.work(stamp_ns)
            if usual is not None:
                self._correct(usual)
            return
        first = self._samples.all()
        if first is not None:
            self.restart(first[: image.shape[0], : image.shape[1]])

    def rewind(self) -> None:
        """Accept an earlier stamp next; the road stays known."""
        self._samples.rewind()
        self._followed_ns = [None] * STRIPS

    def move(self, shift_px: NDArray[np.float64]) -> None:
        """Move the known road (2,) pixels right and down, and learn it anew from there."""
        matrix = np.array([[1.0, 0.0, shift_px[0]], [0.0, 1.0, shift_px[1]]])
        size = (self.image.shape[1], self.image.shape[0])
        moved = cv2.warpAffine(self.image, matrix, size, borderMode=cv2.BORDER_REPLICATE)
        self.restart(np.asarray(moved, dtype=np.uint8))
        self._samples = RoadSamples()

    def restart(self, road: Image) -> None:
        """Begin with this image of the empty road."""
        self._resize((road.shape[0], road.shape[1]))
        self._road[:] = padded(road)
        self._mean[:] = self._road
        self._deviation[:] = FIRST_DEVIATION
        self._contrast[:] = MIN_CONTRAST
        self._reference = _grid(road)
        self._spread(slice(0, len(self.image)))

    def allow_sway(self, sway_px: float) -> None:
        """Expect the camera to sway by so many pixels from now on."""
        side = 2 * min(max(math.ceil(SWAY_FACTOR * sway_px), 1), MAX_SWAY_PX) + 1
        if side != len(self._sway):
            self._sway = np.ones((side, side), dtype=np.uint8)
            self._spread(slice(0, len(self.image)))

    def moving(self, image: Image) -> NDArray[np.uint8]:
        """(H, W) 255 where the image differs from the road by more than noise, 0 elsewhere."""
        gain = _ratio(_grid(image), _grid(self.image))
        if np.abs(gain - 1.0).max() > _MIN_GAIN_STEP:
            self._mean = np.minimum(self._mean * gain, np.float32(255.0))
            self._road[:] = cv2.convertScaleAbs(self._mean)
            self._spread(slice(0, len(self.image)))
        like_road = cv2.inRange(image, self._darkest, self._lightest)
        return np.asarray(cv2.bitwise_not(like_road), dtype=np.uint8)

    def follow(self, stamp_ns: int, image: Image, moving: NDArray[np.uint8]) -> None:
        """Let the road follow the light where nothing moves; call `moving` before this."""
        self._samples.notice(moving)
        edges = np.linspace(0, len(image), STRIPS + 1).astype(int).tolist()
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
            self._follow_rows(slice(a, b), image, moving, share)

    def _follow_rows(
        self, rows: slice, image: Image, moving: NDArray[np.uint8], share: float
    ) -> None:
        columns = slice(0, image.shape[1])
        free = cv2.bitwise_not(cv2.dilate(moving[rows], SURROUNDINGS))
        mean, deviation = self._mean[rows, columns], self._deviation[rows, columns]
        cv2.accumulateWeighted(image[rows], mean, share, free)
        # What differs more is a vehicle that was missed, not noise.
        difference = np.asarray(cv2.absdiff(image[rows], self.image[rows]), dtype=np.uint8)
        noise = np.minimum(_channel_max(difference), MIN_CONTRAST)
        cv2.accumulateWeighted(noise, deviation, share, free)
        wanted = cv2.convertScaleAbs(deviation, alpha=NOISE_FACTOR)
        contrast = np.clip(np.asarray(wanted, np.uint8), MIN_CONTRAST, MAX_CONTRAST)
        cv2.merge([contrast] * 3, dst=self._contrast[rows])
        cv2.convertScaleAbs(mean, dst=self.image[rows])
        self._spread(rows)

    def _spread(self, rows: slice) -> None:
        """The darkest and the lightest that some rows of the road may look without a vehicle."""
        beyond = len(self._sway) // 2
        first, last = max(rows.start - beyond, 0), rows.stop + beyond
        inner = slice(rows.start - first, rows.stop - first)
        around, contrast = self.image[first:last], self._contrast[first:last]
        noise = np.full_like(around, NOISE)
        swayed_dark = cv2.subtract(cv2.erode(around, self._sway), noise)
        swayed_light = cv2.add(cv2.dilate(around, self._sway), noise)
        darkest = cv2.min(cv2.subtract(around, contrast), swayed_dark)
        lightest = cv2.max(cv2.add(around, contrast), swayed_light)
        self._darkest[rows], self._lightest[rows] = darkest[inner], lightest[inner]

    def _correct(self, usual: UsualCells) -> None:
        light = _ratio(_grid(self.image), self._reference)
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
        """Arrays for images of this height and width; some have whole cells."""
        whole = padded(np.zeros(size, np.uint8)).shape
        self._mean = np.zeros((*whole, 3), dtype=np.float32)
        self._deviation = np.zeros(whole, dtype=np.float32)
        self._road = np.zeros((*whole, 3), dtype=np.uint8)
        self.image = self._road[: size[0], : size[1]]
        self._contrast = np.zeros((*size, 3), dtype=np.uint8)
        self._darkest, self._lightest = np.zeros_like(self._contrast), self._contrast.copy()


def _grid(image: NDArray[np.generic]) -> NDArray[np.float32]:
    """(N, 3) pixels on a grid, enough to tell how bright the image is."""
    return image[::_GRID, ::_GRID].reshape(-1, 3).astype(np.float32)


def _ratio(now: NDArray[np.float32], then: NDArray[np.float32]) -> NDArray[np.float32]:
    """(3,) usual ratio of two grids, channel by channel."""
    return np.asarray(np.median((now + 1.0) / (then + 1.0), axis=0), dtype=np.float32)


def _scaled(image: Image, ratio: NDArray[np.floating]) -> Image:
    """The image with blue, green and red times `ratio` (3,), rounded, at most 255."""
    table = np.rint(np.arange(256)[:, None] * ratio.astype(np.float64))
    table = np.clip(table, 0, 255).astype(np.uint8).reshape(1, 256, 3)
    return np.asarray(cv2.LUT(image, table), dtype=np.uint8)


def _channel_max(image: Image) -> NDArray[np.uint8]:
    """(H, W) the largest of the three channels."""
    blue, green, red = cv2.split(image)
    return np.asarray(cv2.max(cv2.max(blue, green), red), dtype=np.uint8)
