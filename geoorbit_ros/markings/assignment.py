"""Which painted line bounds which lane.

One sum of squared errors over all lanes of a road, smallest over all choices (dynamic programming
across the road): lanes are about as wide as lanes are, drivers keep about to the middle, neighbours
share a line or have two close together, and what is clearly painted counts more than what may be a
seam or a tyre track. "No line" is a choice, too.
"""

from __future__ import annotations

from collections.abc import Sequence
from itertools import pairwise

import numpy as np
from numpy.typing import NDArray

from geoorbit_ros.markings.lines import PaintedLine

Array = NDArray[np.float64]

LANE_WIDTH_M, LANE_WIDTH_SIGMA_M = 3.5, 0.6
"""Width of lanes and its 1-sigma: 2.75 m in towns to 4.25 m (AASHTO Green Book 2018: 2.7 to 3.6 m;
RAA, Germany: 3.25 to 3.75 m; older roads and curves more), and calibrations that are off by a tenth
and more."""
DRIVER_SIGMA_M = 0.50
"""1-sigma of how far the median driver is from the lane's middle. Measured on real motorway
cameras: 0.24 m towards the neighbouring lane in edge lanes, up to 0.56 m; points on the ground that
a camera beside the road sees are up to 0.9 m off."""
LINE_WORTH = 6.0
"""What a clear line speaks for itself, as a sum of squared errors. Chosen: a line that makes a lane
2.4 sigma too wide is another line."""
CLEAR_CONTRAST = 4.5
"""Contrast of a clear line where there is paint, in units of noise; tyre tracks have about 2.5."""
WORTHLESS_CONTRAST = 2.4
"""Contrast that says nothing. Measured on the same cameras: tyre tracks and seams."""
CLEAR_SCORE, WORTHLESS_SCORE = 1.7, 0.9
"""The same of the contrast averaged over a line's whole length. Dashes of a quarter of the length
(MUTCD: 3 m of 12 m), clear ones, have 1.7; what shows up here and there along a road less."""
NEAREST_M, FARTHEST_M = 0.8, 3.0
"""Distance of a lane's boundary from where its drivers are. Half of the narrowest lane (2.5 m) less
the largest offset of drivers, and half of the widest (4.5 m) and that offset."""
BUFFER_M = 1.3
"""Most between two neighbours' own lines: the two of a buffered lane are 0.6 to 1.2 m apart
(MUTCD 3D.02)."""
BUFFER_COST = 2.0
"""What speaks against two lines between two lanes. Chosen: one is the rule."""
ONCOMING_COST = 0.0
"""The same between two directions: each of them often has a line of its own."""
BUFFER_WORTH, BUFFER_SHARE = 0.6, 0.7
"""Both are this clear, as a share of the road's clearest line, and accompany this share of a lane.
Chosen: beside a lane line there often is a seam or a tyre track."""
ALONE_COST = 3.0
"""What speaks against a line that bounds one of two neighbours and not the other. Chosen: true only
beside a false lane, or an island."""
NEIGHBOUR_M = 5.5
"""Lanes farther apart have no boundary in common. Chosen: larger takes a painted island for paint
between two lanes."""
LEAST_SHARE = 0.3
"""A line that accompanies less of a lane is no boundary of it. Chosen."""
ONE_LANE_M, BUNDLES_M = (2.5, 4.3), 2.0
"""Distance of two lines with one lane between them, and the most between two bundles of traffic in
it: no lane is narrower than 2.5 m, so that the middles of two are farther apart (guidelines
above)."""
ALONG_SHARE = 0.8
"""Two bundles in one lane are side by side along this share of both. Chosen: one that ends where
the other begins is another lane."""


Choice = tuple[int | None, int | None]
"""Numbers of the lines right and left of a lane; None for no line."""


def choose_lines(
    lines: Sequence[PaintedLine], centre_m: Array, oncoming: Sequence[bool] = ()
) -> list[Choice]:
    """The lines that bound each lane.

    Args:
        lines: Along the road.
        centre_m: (N, S) offsets of the lanes' centrelines by the traffic, from right to left; NaN
            beside a lane's ends.
        oncoming: For each lane but the last whether the next leads the other way; default: none.
    """
    return _Choosing(lines, centre_m, oncoming).cheapest()


def in_one_painted_lane(lines: Sequence[PaintedLine], centre_m: Array) -> list[bool]:
    """Which neighbours are two bundles of traffic in one painted lane: no two lanes fit there.

    Args:
        lines: Along the road.
        centre_m: (N, S) as in `choose_lines`.

    Returns:
        For each lane but the last whether it and the next are between two clear lines that are one
        lane's width apart, without paint between them.
    """
    choosing = _Choosing(lines, centre_m)
    return [choosing.is_one_lane(k) for k in range(len(centre_m) - 1)]


class _Choosing:
    """The costs of choices, as sums of squared errors."""

    def __init__(
        self, lines: Sequence[PaintedLine], centre_m: Array, oncoming: Sequence[bool] = ()
    ) -> None:
        self._lines, self._centre = lines, centre_m
        self._oncoming = list(oncoming) or [False] * len(centre_m)
        self._lanes = len(centre_m)
        self._worth = [worth(line) for line in lines]
        # (N, L) how far left of each lane's centre each line is, and the share of the lane that it
        # accompanies.
        self._side = np.full((self._lanes, len(lines)), np.nan)
        self._share = np.zeros(self._side.shape)
        for k, centre in enumerate(centre_m):
            for i, line in enumerate(lines):
                apart = line.offset_m - centre
                share = np.isfinite(apart).sum() / max(int(np.isfinite(centre).sum()), 1)
                self._share[k, i] = share
                self._side[k, i] = _median(apart) if share >= LEAST_SHARE else np.nan
        gaps = [_median(b - a) for a, b in pairwise(centre_m)]
        self._joined = [gap < NEIGHBOUR_M for gap in gaps]

    def cheapest(self) -> list[Choice]:
        """From right to left, the best way to each choice of a lane's left line is kept."""
        best: dict[int | None, tuple[float, list[Choice]]] = {}
        for k in range(self._lanes):
            following: dict[int | None, tuple[float, list[Choice]]] = {}
            for right in self._options(k, -1.0):
                before = [
                    (cost + self._between(last, right, k - 1), chosen)
                    for last, (cost, chosen) in best.items()
                ] or [(0.0, [])]
                cost, chosen = min(before, key=lambda value: value[0])
                cost -= self._speaks(right)
                for left in self._options(k, 1.0):
                    total = cost + self._own(k, right, left) - self._speaks(left)
                    if total < following.get(left, (np.inf, []))[0]:
                        following[left] = (total, [*chosen, (right, left)])
            best = following
        return min(best.values(), key=lambda value: value[0])[1]

    def is_one_lane(self, k: int) -> bool:
        """See `in_one_painted_lane`."""
        here, there = self._centre[k : k + 2]
        both, either = (
            np.count_nonzero(joined(np.isfinite(here), np.isfinite(there)))
            for joined in (np.logical_and, np.logical_or)
        )
        if both < ALONG_SHARE * either or not 0.0 < _median(there - here) < BUNDLES_M:
            return False
        clear = np.array(self._worth) >= BUFFER_WORTH * LINE_WORTH
        with np.errstate(invalid="ignore"):
            near = (np.abs(self._side) > NEAREST_M) & (np.abs(self._side) < FARTHEST_M)
            near &= (self._share >= BUFFER_SHARE) & clear
            right = near[k] & near[k + 1] & (self._side[k] < 0.0) & (self._side[k + 1] < 0.0)
            left = near[k] & near[k + 1] & (self._side[k] > 0.0) & (self._side[k + 1] > 0.0)
        if not right.any() or not left.any() or self._is_paint_between(here, there):
            return False
        low, high = self._side[k, right].max(), self._side[k, left].min()
        narrowest, widest = ONE_LANE_M
        return bool(narrowest <= high - low <= widest)

    def _is_paint_between(self, right_m: Array, left_m: Array) -> bool:
        """Whether a line that is no seam lies between two lanes, were it for a short way."""
        with np.errstate(invalid="ignore"):
            return any(
                worth > 0.0 and bool(((line.offset_m > right_m) & (line.offset_m < left_m)).any())
                for line, worth in zip(self._lines, self._worth, strict=True)
            )

    def _options(self, k: int, sign: float) -> list[int | None]:
        """Lines that may bound lane `k` on one side: 1 for the left."""
        with np.errstate(invalid="ignore"):
            distance = sign * self._side[k]
            near = (distance > NEAREST_M) & (distance < FARTHEST_M)
        return [None, *(int(i) for i in np.flatnonzero(near) if self._worth[i] > 0.0)]

    def _speaks(self, line: int | None) -> float:
        return 0.0 if line is None else self._worth[line]

    def _own(self, k: int, right: int | None, left: int | None) -> float:
        """How badly two boundaries fit a lane."""
        low = None if right is None else float(self._side[k, right])
        high = None if left is None else float(self._side[k, left])
        if low is not None and high is not None:
            wide = (high - low - LANE_WIDTH_M) / LANE_WIDTH_SIGMA_M
            return wide**2 + (0.5 * (low + high) / DRIVER_SIGMA_M) ** 2
        one = high if low is None else -low
        if one is None:
            return 0.0
        sigma = float(np.hypot(0.5 * LANE_WIDTH_SIGMA_M, DRIVER_SIGMA_M))
        return ((one - 0.5 * LANE_WIDTH_M) / sigma) ** 2

    def _between(self, left: int | None, right: int | None, k: int) -> float:
        """How badly the left line of lane `k` and the right one of the next fit each other."""
        if not self._joined[k]:
            return 0.0
        if left is None or right is None:
            return 0.0 if left is right else ALONE_COST
        if left == right:
            return self._worth[left]  # it speaks once
        apart = _median(self._lines[right].offset_m - self._lines[left].offset_m)
        beside = 0.0 < apart < BUFFER_M
        worths = self._worth[left], self._worth[right]
        # The two lines between two directions are alike; in shadow neither is as clear as others.
        clearest = max(worths if self._oncoming[k] else self._worth)
        clear = min(worths) >= BUFFER_WORTH * clearest
        lasting = min(self._share[k, left], self._share[k, right]) >= BUFFER_SHARE
        cost = ONCOMING_COST if self._oncoming[k] else BUFFER_COST
        return cost if beside and clear and lasting else np.inf


def _median(values: Array) -> float:
    """Of the known values; NaN without any."""
    known = np.isfinite(values)
    return float(np.median(values[known])) if known.any() else float("nan")


def is_clear(line: PaintedLine) -> bool:
    """Whether a line is paint, and nothing else, by itself."""
    return worth(line) >= BUFFER_WORTH * LINE_WORTH


def worth(line: PaintedLine) -> float:
    """What the line speaks for itself: 0 for a seam, `LINE_WORTH` for clear paint."""
    clear = (line.contrast - WORTHLESS_CONTRAST) / (CLEAR_CONTRAST - WORTHLESS_CONTRAST)
    steady = (line.score - WORTHLESS_SCORE) / (CLEAR_SCORE - WORTHLESS_SCORE)
    return LINE_WORTH * min(max(clear, 0.0), 1.0) * min(max(steady, 0.0), 1.0)
