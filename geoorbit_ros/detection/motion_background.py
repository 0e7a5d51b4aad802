"""The empty road of a fixed camera, learnt while traffic passes."""

from __future__ import annotations

from itertools import pairwise

import cv2
import numpy as np
from numpy.typing import NDArray

from geoorbit_ros.detection.detector import Image
from geoorbit_ros.detection.motion_mode import most_usual
from geoorbit_ros.detection.motion_pixels import scaled

SAMPLES = 31
"""Pictures behind the most usual value."""
FIRST_SPACING_S, LAST_SPACING_S = 0.2, 3.2
"""Time between them at first and after 100 s, which then is their window: a vehicle that stands
still for a third of it becomes part of the road."""
MIN_SAMPLES = 5
FIRST_STRIPS, LAST_STRIPS = 2, 24
"""The picture is worked on in so many parts, one per frame, so that no frame takes long."""
FOLLOW_TIME_S = 2.0
"""How fast free road follows the light."""
NOISE_FACTOR = 5.0
"""Contrast needed, in mean absolute deviations of the pixel."""
MIN_CONTRAST, MAX_CONTRAST = np.uint8(14), np.uint8(36)
"""Grey levels that a vehicle differs by at least (compression alone makes ten), and at most."""
FIRST_DEVIATION = 2.0
_GRID = 8
"""Every so manieth pixel each way tells the brightness of the picture."""
_MIN_GAIN_STEP = 0.02


class RoadBackground:
    """What each pixel shows when no vehicle is there, and how much it wavers.

    A running mean where the road is free; corrected wherever it disagrees with the most usual value
    in pictures of the last minutes, so that a vehicle of the first picture doesn't stay as a ghost.

    Attributes:
        mean: (H, W, 3) float32; the picture of the empty road.
        contrast: (H, W) uint8; differences above it are no noise.
    """

    def __init__(self) -> None:
        self._samples: list[Image] = []
        self._sampled_ns: list[int] = []
        self._reference = np.empty((0, 3), dtype=np.float32)
        self._followed_ns: int | None = None
        self._strips: list[slice] = []
        self.mean = np.empty((0, 0, 3), dtype=np.float32)
        self._deviation = np.empty((0, 0), dtype=np.float32)
        self.contrast = np.empty((0, 0), dtype=np.uint8)

    @property
    def ready(self) -> bool:
        """Whether enough pictures were seen to know the road."""
        return len(self.mean) > 0

    def sample(self, stamp_ns: int, picture: Image) -> None:
        """Keep this picture for the most usual value if it's time to, and work on that."""
        stamps = self._sampled_ns
        if not stamps or not 0 <= stamp_ns - stamps[-1] < self._spacing_s() * 1e9:
            self._keep(stamp_ns, picture)
        if len(self._samples) < MIN_SAMPLES:
            return
        if not self.ready:
            self.restart(most_usual(self._samples))
        elif self._strips:
            rows = self._strips.pop()
            self._correct(rows, most_usual([sample[rows] for sample in self._samples]))

    def rewind(self) -> None:
        """Take the next stamp as it comes, be it earlier than the last; the road stays known."""
        if self._sampled_ns:
            back_ns = self._sampled_ns[-1]
            self._sampled_ns = [stamp_ns - back_ns for stamp_ns in self._sampled_ns]
        self._followed_ns = None

    def move(self, shift_px: NDArray[np.float64]) -> None:
        """Move the known road (2,) pixels right and down, and learn it anew from there."""
        matrix = np.array([[1.0, 0.0, shift_px[0]], [0.0, 1.0, shift_px[1]]])
        size = (self.mean.shape[1], self.mean.shape[0])
        moved = cv2.warpAffine(self.mean, matrix, size, borderMode=cv2.BORDER_REPLICATE)
        self.restart(np.asarray(moved))
        self._samples.clear()
        self._sampled_ns.clear()
        self._strips.clear()

    def restart(self, road: NDArray[np.generic]) -> None:
        """Begin with this picture of the empty road."""
        self.mean = road.astype(np.float32)
        self._deviation = np.full(road.shape[:2], FIRST_DEVIATION, dtype=np.float32)
        self.contrast = np.full(road.shape[:2], MIN_CONTRAST)
        self._reference = _grid(self.mean)

    def difference(self, picture: Image) -> tuple[NDArray[np.uint8], Image]:
        """(H, W) largest difference of any channel from the road; the road as it looks now."""
        gain = self._gain(picture)
        if np.abs(gain - 1.0).max() > _MIN_GAIN_STEP:
            self.mean = np.minimum(self.mean * gain, np.float32(255.0))
        road = np.asarray(cv2.convertScaleAbs(self.mean), dtype=np.uint8)
        blue, green, red = cv2.split(cv2.absdiff(picture, road))
        return np.asarray(cv2.max(cv2.max(blue, green), red), dtype=np.uint8), road

    def follow(
        self,
        stamp_ns: int,
        picture: Image,
        difference: NDArray[np.uint8],
        free: NDArray[np.uint8],
    ) -> None:
        """Let the road follow the light where it is free (255), not where vehicles are (0)."""
        last = self._followed_ns
        elapsed_s = 0.04 if last is None else min(max(stamp_ns - last, 0) / 1e9, 1.0)
        self._followed_ns = stamp_ns
        share = 1.0 - float(np.exp(-elapsed_s / FOLLOW_TIME_S))
        cv2.accumulateWeighted(picture, self.mean, share, free)
        # What differs more is a vehicle that was missed, not noise.
        noise = np.minimum(difference, MIN_CONTRAST)
        cv2.accumulateWeighted(noise, self._deviation, share, free)
        wanted = cv2.convertScaleAbs(self._deviation, alpha=NOISE_FACTOR)
        self.contrast = np.clip(np.asarray(wanted, np.uint8), MIN_CONTRAST, MAX_CONTRAST)

    def _gain(self, picture: Image) -> NDArray[np.float32]:
        """(3,) how much brighter the picture is than the road, by channel."""
        return _ratio(_grid(picture), _grid(self.mean))

    def _spacing_s(self) -> float:
        window_s = (self._sampled_ns[-1] - self._sampled_ns[0]) / 1e9
        return float(np.clip(window_s / SAMPLES, FIRST_SPACING_S, LAST_SPACING_S))

    def _keep(self, stamp_ns: int, picture: Image) -> None:
        stamps = self._sampled_ns
        if stamps and stamp_ns < stamps[-1]:  # a source that started again
            stamps[:] = [stamp - stamps[-1] + stamp_ns - 1 for stamp in stamps]
        if len(stamps) == SAMPLES:
            gaps = np.diff(stamps)
            # Thinned where they are closest, until the window is long enough to move on.
            drop = int(np.argmin(gaps)) + 1 if gaps.min() < 0.9e9 * LAST_SPACING_S else 0
            del stamps[drop], self._samples[drop]
        # All in the same light, so that clouds don't make two roads of one.
        light = _ratio(_grid(picture), self._reference) if self.ready else np.ones(3)
        self._samples.append(scaled(picture, 1.0 / light))
        stamps.append(stamp_ns)
        if self._strips:
            return
        strips = FIRST_STRIPS if self._spacing_s() < 1.0 else LAST_STRIPS
        edges = np.linspace(0, len(picture), strips + 1).astype(int).tolist()
        self._strips = [slice(a, b) for a, b in pairwise(edges)]

    def _correct(self, rows: slice, usual: Image) -> None:
        light = _ratio(_grid(self.mean), self._reference)
        seen = usual.astype(np.float32) * light
        apart = np.abs(seen - self.mean[rows]).max(axis=2) > MIN_CONTRAST
        self.mean[rows][apart] = seen[apart]
        self._deviation[rows][apart] = FIRST_DEVIATION


def _grid(picture: NDArray[np.generic]) -> NDArray[np.float32]:
    """(N, 3) pixels on a grid, enough to tell how bright the picture is."""
    return picture[::_GRID, ::_GRID].reshape(-1, 3).astype(np.float32)


def _ratio(now: NDArray[np.float32], then: NDArray[np.float32]) -> NDArray[np.float32]:
    """(3,) usual ratio of two grids, channel by channel."""
    return np.asarray(np.median((now + 1.0) / (then + 1.0), axis=0), dtype=np.float32)
