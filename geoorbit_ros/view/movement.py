"""From the motions of single looks to a state: steady, shaking, or moved."""

from __future__ import annotations

import math
from collections import deque
from dataclasses import dataclass

import numpy as np

from geoorbit_ros.view.looks import ViewState
from geoorbit_ros.view.picture import Matrix, displacement, size_of_move

MOVED_PX = 2.0
"""A view that lies farther away has been moved, in pixels of an image 1280 px wide. Chosen: larger
misses a bump of three pixels, smaller tells of what sun and wind do every day."""
BACK_SHARE = 0.7
"""It is back from this share of that on, so that the state does not change to and fro."""
SHAKING_PX, CALM_PX = 0.8, 0.5
"""Sway (1-sigma) from which a camera shakes, and below which it does so no more, at that width.
Chosen: looks differ by 0.1 to 0.2 px of a steady camera."""
SWAY_S = 3.0
"""Time over which sway is measured: six swings of 2 Hz. Chosen: longer reacts to wind later."""
LATEST = 4
"""Looks whose middle says where the view lies: one second. Chosen: more notice a bump later."""
SHAKEN_S = 4.0
"""The same of a camera that shakes, as time: eight swings of 2 Hz, and a bump is noticed after half
of it. Chosen: longer notices it later, shorter takes slow wind for a bump."""
QUIET_PX = 0.6
"""Looks that differ by less than this are averaged, at that width. Chosen: larger blurs a sway,
smaller uses single looks."""
DEAD_PX = 0.35
"""A view that lies nearer, at that width, is taken as where it was. Chosen: the mean of looks by
references of other light differs by so much; a lane at 100 m by 0.03 m."""


@dataclass(frozen=True, slots=True)
class Seen:
    """What is known after a look; see `ViewLook`."""

    state: ViewState
    motion: Matrix
    sigma_px: float
    sway_px: float
    moved_px: float
    since_ns: int


class Movement:
    """Follows one view's motion.

    Attributes:
        shaking: Whether the camera shakes.
    """

    def __init__(self) -> None:
        self.shaking = self._moved = False
        self._looks: deque[tuple[int, Matrix, float]] = deque()
        self._state = ViewState.UNKNOWN
        self._since_ns = 0

    def restart(self, *, kept: bool) -> None:
        """Another view, or the same after it was lost: what was measured before says nothing."""
        self._looks.clear()
        self.shaking, self._state = False, ViewState.UNKNOWN
        if not kept:
            self._moved = False

    def add(self, stamp_ns: int, motion: Matrix, sigma_px: float, size: tuple[int, int]) -> Seen:
        """Take the motion of a look, in pixels of images of a size."""
        unit = size[0] / 1280.0
        if self._looks and stamp_ns <= self._looks[-1][0]:
            self._looks.clear()
        self._looks.append((stamp_ns, motion, sigma_px))
        while len(self._looks) > 2 * LATEST and stamp_ns - self._looks[0][0] > SHAKEN_S * 1e9:
            self._looks.popleft()
        place = np.array([displacement(m, size).mean(axis=0) for _, m, _ in self._looks])
        stamps = np.array([stamp for stamp, _, _ in self._looks])
        sway_px = self._sway(place[stamps >= stamp_ns - SWAY_S * 1e9])
        self.shaking = sway_px >= (CALM_PX if self.shaking else SHAKING_PX) * unit
        moved_px, began = self._away(size, sway_px, unit)
        before = self._state
        self._state = ViewState.STEADY
        if self._moved:
            self._state = ViewState.MOVED
        elif self.shaking:
            self._state = ViewState.SHAKING
        if self._state is not before:
            self._since_ns = began if self._moved else stamp_ns
        known, sigma = self._motion(size, unit)
        return Seen(self._state, known, sigma, sway_px, moved_px, self._since_ns)

    @staticmethod
    def _sway(place: np.ndarray[tuple[int, int], np.dtype[np.float64]]) -> float:
        """1-sigma of the movement to and fro; a step to another place is none.

        By the differences of looks that follow one another: those of a step are one large and
        many small ones, those of a sway are all alike.
        """
        if len(place) < LATEST:
            return 0.0
        step = np.hypot(*np.diff(place, axis=0).T)
        # Median of |difference| of two independent normals in two dimensions: 1.67 sigma.
        return float(np.median(step)) / 1.67 if len(step) else 0.0

    def _away(self, size: tuple[int, int], sway_px: float, unit: float) -> tuple[float, int]:
        """By how many pixels the view lies away, and since when it does; sets `_moved`."""
        latest = list(self._looks) if self.shaking else list(self._looks)[-LATEST:]
        # The middle of a sway is its mean; of a steady camera a single wrong look has no weight.
        middle = (np.mean if self.shaking else np.median)([m for _, m, _ in latest], axis=0)
        moved_px = size_of_move(middle, size)
        # Twice the error of the middle of so many looks of a sway.
        margin_px = 2.5 * sway_px / math.sqrt(len(latest)) if self.shaking else 0.0
        limit_px = (BACK_SHARE if self._moved else 1.0) * MOVED_PX * unit + margin_px
        enough = len(latest) >= LATEST
        if self.shaking:
            enough = latest[-1][0] - latest[0][0] >= 0.7 * SHAKEN_S * 1e9
        self._moved = moved_px > limit_px if enough else self._moved
        began = latest[-1][0]
        for stamp_ns, motion, _ in reversed(self._looks):
            if size_of_move(motion, size) < 0.5 * moved_px:
                break
            began = stamp_ns
        return moved_px, began

    def _motion(self, size: tuple[int, int], unit: float) -> tuple[Matrix, float]:
        """The motion to be used now: the mean of looks that agree, else the last one."""
        _, newest, sigma_px = self._looks[-1]
        mean, count = newest, 1
        latest = list(self._looks)[-2 * LATEST :]
        for k in range(len(latest) - 2, -1, -1):
            step = newest @ np.linalg.inv(latest[k][1])
            if self.shaking or size_of_move(step, size) > QUIET_PX * unit:
                break
            mean, count = mean + latest[k][1], count + 1
        mean = mean / count
        sigma_px = max(sigma_px / math.sqrt(count), 0.05 * unit)
        if count > 2 and size_of_move(mean, size) < DEAD_PX * unit:
            # What is left out is uncertain by itself.
            return np.eye(3), math.hypot(sigma_px, 0.5 * size_of_move(mean, size))
        return mean, sigma_px
