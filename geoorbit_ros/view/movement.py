"""From the motions of single looks to a state: steady, shaking, or moved."""

from __future__ import annotations

import math
from collections import deque
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

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
NOISE_SIGMAS = 4.0
"""And in errors of a single look. Chosen: images 350 px wide with dense traffic look as if they
shook else; larger misses a sway where few patches are found."""
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


TREND_SIGMAS = 4.0
"""A view drifts where its looks follow a line in time whose slope is so many times its error.
Chosen: smaller takes noise for a drift, larger lags behind one by half the time of the looks."""


@dataclass(frozen=True, slots=True)
class Seen:
    """What is known after a look; see `ViewLook`."""

    state: ViewState
    motion: Matrix
    sigma_px: float
    sway_px: float
    moved_px: float
    since_ns: int


@dataclass(frozen=True, slots=True)
class _Look:
    """One look.

    Attributes:
        stamp_ns: Of the image.
        motion: In its pixels.
        sigma_px: Of the motion.
        off_px: (5, 2) `displacement`.
    """

    stamp_ns: int
    motion: Matrix
    sigma_px: float
    off_px: NDArray[np.float64]


class Movement:
    """Follows one view's motion.

    Attributes:
        shaking: Whether the camera shakes.
    """

    def __init__(self) -> None:
        self.shaking = self._moved = False
        self._looks: deque[_Look] = deque()
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
        if self._looks and stamp_ns <= self._looks[-1].stamp_ns:
            self._looks.clear()
        self._looks.append(_Look(stamp_ns, motion, sigma_px, displacement(motion, size)))
        while len(self._looks) > 2 * LATEST and self._age_s(self._looks[0]) > SHAKEN_S:
            self._looks.popleft()
        off_px = np.stack([look.off_px for look in self._looks])
        stamps = np.array([look.stamp_ns for look in self._looks])
        place = off_px.mean(axis=1)
        sway_px = self._sway(place[stamps >= stamp_ns - SWAY_S * 1e9])
        noise_px = float(np.median([look.sigma_px for look in self._looks]))
        limit_px = (CALM_PX if self.shaking else SHAKING_PX) * unit
        self.shaking = sway_px >= max(limit_px, NOISE_SIGMAS * noise_px)
        moved_px, began = self._away(off_px, sway_px, unit)
        before = self._state
        self._state = ViewState.STEADY
        if self._moved:
            self._state = ViewState.MOVED
        elif self.shaking:
            self._state = ViewState.SHAKING
        if self._state is not before:
            self._since_ns = began if self._moved else stamp_ns
        known, sigma = self._motion(off_px, size, unit)
        return Seen(self._state, known, sigma, sway_px, moved_px, self._since_ns)

    def _age_s(self, look: _Look) -> float:
        return (self._looks[-1].stamp_ns - look.stamp_ns) / 1e9

    @staticmethod
    def _sway(place: NDArray[np.float64]) -> float:
        """1-sigma of the movement to and fro; a step to another place is none.

        By the differences of looks that follow one another: those of a step are one large and
        many small ones, those of a sway are all alike.
        """
        if len(place) < LATEST:
            return 0.0
        step = np.hypot(*np.diff(place, axis=0).T)
        # Median of |difference| of two independent normals in two dimensions: 1.67 sigma.
        return float(np.median(step)) / 1.67 if len(step) else 0.0

    def _away(self, off_px: NDArray[np.float64], sway_px: float, unit: float) -> tuple[float, int]:
        """By how many pixels the view lies away, and since when it does; sets `_moved`."""
        latest = off_px if self.shaking else off_px[-LATEST:]
        # The middle of a sway is its mean; of a steady camera a single wrong look has no weight.
        middle = latest.mean(axis=0) if self.shaking else np.median(latest, axis=0)
        moved_px = float(_size(middle))
        # Twice the error of the middle of so many looks of a sway.
        margin_px = 2.5 * sway_px / math.sqrt(len(latest)) if self.shaking else 0.0
        limit_px = (BACK_SHARE if self._moved else 1.0) * MOVED_PX * unit + margin_px
        enough = len(latest) >= LATEST
        if self.shaking:
            enough = self._age_s(self._looks[0]) >= 0.7 * SHAKEN_S
        self._moved = moved_px > limit_px if enough else self._moved
        near = np.flatnonzero(_size(off_px) < 0.5 * moved_px)
        first = min(int(near[-1]) + 1, len(off_px) - 1) if len(near) else 0
        return moved_px, self._looks[first].stamp_ns

    def _motion(
        self, off_px: NDArray[np.float64], size: tuple[int, int], unit: float
    ) -> tuple[Matrix, float]:
        """The motion to be used now: of looks that agree, else the last one."""
        newest = self._looks[-1]
        apart = _size(off_px - off_px[-1]) > QUIET_PX * unit
        apart[: -2 * LATEST] = True
        agree = len(apart) if not apart.any() else len(apart) - 1 - int(np.flatnonzero(apart)[-1])
        if self.shaking:
            agree = 1
        latest = list(self._looks)[-agree:]
        motions = np.stack([look.motion for look in latest])
        motion, error = motions.mean(axis=0), 1.0 / math.sqrt(agree)
        time_s = np.array([-self._age_s(look) for look in latest])
        drifts = _drifts(time_s, off_px[-agree:].mean(axis=1))
        if drifts:  # the line at the time of the newest
            centred = time_s - time_s.mean()
            share = -float(time_s.mean()) * centred / float(centred @ centred) + 1.0 / agree
            motion, error = np.tensordot(share, motions, axes=1), float(np.linalg.norm(share))
        sigma_px = max(newest.sigma_px * error, 0.05 * unit)
        if agree > 2 and not drifts and size_of_move(motion, size) < DEAD_PX * unit:
            # What is left out is uncertain by itself.
            return np.eye(3), math.hypot(sigma_px, 0.5 * size_of_move(motion, size))
        return motion, sigma_px


def _size(off_px: NDArray[np.float64]) -> NDArray[np.float64]:
    """Pixels by which displacements (..., 5, 2) move an image, in the mean over it."""
    return np.asarray(np.sqrt((off_px**2).sum(axis=-1).mean(axis=-1)))


def _drifts(time_s: NDArray[np.float64], place: NDArray[np.float64]) -> bool:
    """Whether places (N, 2) follow a line in time."""
    if len(place) <= LATEST:
        return False
    centred = time_s - time_s.mean()
    square = float(centred @ centred)
    slope = centred @ place / square
    rest = place - place.mean(axis=0) - np.outer(centred, slope)
    variance = float((rest**2).sum()) / (2 * len(place) - 4)
    return float(slope @ slope) > TREND_SIGMAS**2 * variance / square
