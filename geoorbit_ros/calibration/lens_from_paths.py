"""A lens from the paths of vehicles: the distortion without which neighbouring lanes are parallel.

In the image of a pinhole, a path on a flat road is `u = m w + g(w)`: w is the distance below the
horizon, in pixels, m says how far to the side of the camera the vehicle drives, and g, common to
all who follow the road, how it bends: `c + q/w` for a bend of one radius, `c` alone for a straight
road. A lens bends paths left and right of its axis in opposite ways, which no road does. So a bend
is not taken for a lens: where the paths can't tell one from the other, the error of k1 is large. A
crest or sag is not modelled, and may be taken for a weak lens.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import scipy
from numpy.typing import NDArray

from geoorbit_ros.calibration.lens import LensEstimate, unit_lens

Array = NDArray[np.float64]

MIN_PATHS = 30
"""Fewer paths show too little of the road. Chosen: a minute of ordinary traffic has more; from the
fifteen of a night scene k1 came out 40 % too small."""
MAX_PATHS = 240
"""The longest are taken. Chosen: more take time and say little more."""
FIRST_PATHS = 24
"""Paths with which the search begins, from several places. Chosen: enough for lanes on both sides
of the axis; more take time."""
STARTS = [np.array([k1, np.log(share), 0.0]) for k1 in (-0.3, -0.05, 0.15) for share in (0.05, 0.3)]
"""Where it begins: k1, log of the highest place's distance below the horizon over the image's
height, roll."""
STEPS = 20
"""Of each search, at most: it ends earlier where it has arrived."""
SAMPLES = 16
"""Places of each path, its means over equal parts of its way. Chosen: more follow the noise of
boxes, fewer blur the bend."""
MIN_LENGTH = 0.12
"""Least way of a path in the image, as a share of its width. Chosen: the bend grows with the square
of the way; shorter ones show noise."""
CLEAR_PX = 4.0
"""Paths end so far below the horizon, at least. Chosen: beyond, a pixel is hundreds of metres."""
ORDERS = (2, 3, 4)
"""Common terms of all paths: 2 for a bend of one radius, 3 where the radius changes evenly, 4 in an
S-bend. The middle one is used; what the others find differently is part of the error."""
ROLL_SIGMA_RAD = 0.05
"""1-sigma of a camera's roll, 3 degrees. Chosen: poles and mounts are about level."""
SIGMAS = 3.0
"""A k1 of fewer sigma is none. Chosen: 0.3 % of cameras without distortion get one."""
BIAS, MODEL_SIGMA = -0.02, 0.02
"""Mean and 1-sigma of k1, in units of the image's width, from what the form leaves out: the middle
of a box is no fixed place on a vehicle that comes near. Measured in scenes without distortion:
+0.01 to -0.05, and -0.00 to -0.02 from the paths of fixed places. The mean is taken off."""
TELLING = 0.06
"""A k1 less certain than this, in units of the image's width, is not known. Chosen: at the border
of an image of 1920, a plane through control points takes up most of the 14 px that it means."""
MISFIT_PX = 6.0
"""Paths that miss their common form by more, in the median, follow no common road: junctions."""
HUBER = 2.0
"""Sigma beyond which a place counts less. Chosen: larger lets lane changes bend the road, smaller
ignores good paths."""
MAX_K1 = 0.9
"""Of k1 in units of the image's width; see `lens_from_points.GRID`."""
FOLD = 4.0 / 27.0
"""A k1 below -`FOLD` / r^2 shows nothing at a radius r: there, r + k1 r^3 has its largest value."""
NO_LENS = "the vehicles' paths can't tell the lens"


def estimate_lens_from_paths(
    paths: Sequence[NDArray[np.float64]], image_size: tuple[int, int]
) -> LensEstimate:
    """The lens' k1 by the paths of vehicles in the image, however the road bends.

    Least squares of the form above over k1, the horizon's height and the camera's roll, robust
    against those who change lanes. The error is that of paths drawn anew (they differ by more than
    the noise of their boxes; Cameron and Miller (2015), A Practitioner's Guide to Cluster-Robust
    Inference), and how much k1 depends on the form of the road.

    Args:
        paths: (N, 2) real pixels of one vehicle each, in the order of time: the middle of its box.
        image_size: (width, height) in pixels.

    Returns:
        A lens in units of the image's width; see `lens.with_focal` for that of a focal length. Its
        k1 is one sigma nearer to zero than what was found: with a lens that is twice as strong as
        the true one lanes are no better than without any, with half of it they are.
    """
    width = float(image_size[0])
    places = _places(paths, width)
    if len(places) < MIN_PATHS:
        text = f"{NO_LENS}: {len(places)} long ones, and {MIN_PATHS} would be needed"
        return LensEstimate(None, np.nan, np.inf, text)
    few = _Fit(places[:: max(1, len(places) // FIRST_PATHS)], image_size, ORDERS[1], STARTS)
    best = _Fit(places, image_size, ORDERS[1], [few.x])
    fits = [best] + [_Fit(places, image_size, k, [best.x]) for k in (ORDERS[0], ORDERS[2])]
    if not best.misfit_px <= MISFIT_PX * width / 1920.0:
        text = f"{NO_LENS}: they miss any common road by {best.misfit_px:.0f} px"
        return LensEstimate(None, np.nan, np.inf, text)
    spread = max(abs(fit.k1 - best.k1) for fit in fits)
    k1, sigma = best.k1 - BIAS, float(np.linalg.norm([best.sigma, spread, MODEL_SIGMA]))
    if best.at_bound:
        text = f"{NO_LENS}: they fit no common road behind any"
        return LensEstimate(None, k1, max(sigma, TELLING), text)
    if not sigma <= TELLING:
        text = f"{NO_LENS}: k1 is known to ± {sigma:.2g} only, in units of the image's width"
        return LensEstimate(None, k1, sigma, text)
    said = f"k1 = {k1:.3f} ± {sigma:.3f} in units of the image's width"
    if abs(k1) < SIGMAS * sigma:
        return LensEstimate(None, k1, sigma, f"the vehicles' paths show no lens: {said}")
    used = float(np.copysign(abs(k1) - sigma, k1))
    text = f"the vehicles' paths are bent by a lens: {said}; used is {used:.3f}, nearer to none"
    return LensEstimate(unit_lens(image_size, used), k1, sigma, text)


def _places(paths: Sequence[NDArray[np.float64]], width: float) -> Array:
    """(P, `SAMPLES`, 2) means of the longest paths over equal parts of their way."""
    found = []
    for path in paths:
        xy = np.asarray(path, dtype=np.float64)
        xy = xy[np.isfinite(xy).all(axis=1)]
        if len(xy) < SAMPLES:
            continue
        way = xy[-1] - xy[0]
        length = float(np.hypot(*way))
        if length < MIN_LENGTH * width:
            continue
        part = np.clip(((xy - xy[0]) @ way / length**2 * SAMPLES).astype(int), 0, SAMPLES - 1)
        count = np.bincount(part, minlength=SAMPLES)
        if count.all():
            sums = [np.bincount(part, column, SAMPLES) for column in xy.T]
            found.append((length, np.column_stack(sums) / count[:, None]))
    found.sort(key=lambda known: -known[0])
    return np.array([places for _, places in found[:MAX_PATHS]]).reshape(-1, SAMPLES, 2)


class _Fit:
    """Paths fitted by their common form.

    Args:
        places: (P, `SAMPLES`, 2) real pixels.
        image_size: (width, height).
        order: Number of common terms.
        starts: Where to begin, as `STARTS`.

    Attributes:
        x: (3,) what was found, as `STARTS`.
        k1: In units of the image's width.
        sigma: Its 1-sigma error.
        at_bound: Whether it is as far from zero as it may be.
        misfit_px: Median distance of places from their path.
    """

    def __init__(
        self, places: Array, image_size: tuple[int, int], order: int, starts: Sequence[Array]
    ) -> None:
        self._size, self._order = image_size, order
        self._off = places - np.divide(image_size, 2)
        self._radius = np.hypot(self._off[..., 0], self._off[..., 1]) / image_size[0]
        self._weight = np.ones(places.shape[:2])
        lowest = max(-MAX_K1, -0.95 * FOLD / float(self._radius.max()) ** 2)
        self._low = np.array([lowest, np.log(CLEAR_PX / image_size[1]), -0.3])
        self._high = np.array([MAX_K1, np.log(5.0), 0.3])
        found = min((self._solve(start) for start in starts), key=lambda r: float(r.cost))
        for _ in range(2):
            distance = np.abs(self._distance(found.x))
            scale = 1.483 * float(np.median(distance))
            self._weight = np.sqrt(np.minimum(1.0, HUBER * scale / np.maximum(distance, 1e-9)))
            found = self._solve(found.x)
        self.x = np.asarray(found.x)
        self.k1 = float(self.x[0])
        self.at_bound = not self._low[0] + 1e-3 < self.k1 < MAX_K1 - 1e-3
        self.misfit_px = float(np.median(np.abs(self._distance(self.x))))
        self.sigma = self._error(self.x)

    def _solve(self, start: Array) -> scipy.optimize.OptimizeResult:
        low, high = self._low, self._high
        start = np.clip(start, low + 1e-6, high - 1e-6)
        return scipy.optimize.least_squares(
            self._residual, start, bounds=(low, high), max_nfev=STEPS, x_scale=[0.1, 0.5, 0.03],
            xtol=1e-6, ftol=1e-6,
        )  # fmt: skip

    def _residual(self, x: Array) -> Array:
        """Weighed distances of all places, px, and that of the roll from none."""
        distance = (self._weight * self._distance(x)).ravel()
        return np.append(distance, x[2] / ROLL_SIGMA_RAD)

    def _distance(self, x: Array) -> Array:
        """(P, `SAMPLES`) distances of places from their path, px."""
        k1, clearance, roll = x.tolist()
        height = self._size[1]
        radius = self._undistorted(k1)
        lost = ~np.isfinite(radius)
        radius = np.where(lost, 0.0, radius)
        off = self._off * (radius / np.maximum(self._radius, 1e-9))[..., None]
        # Errors count in real pixels, else a k1 that shrinks the image would explain everything.
        real = np.sqrt((1.0 + k1 * radius**2) * np.maximum(1.0 + 3.0 * k1 * radius**2, 0.0))
        u = off[..., 0] * np.cos(roll) + off[..., 1] * np.sin(roll)
        v = off[..., 1] * np.cos(roll) - off[..., 0] * np.sin(roll)
        w = (v - np.where(lost, np.inf, v).min()) / height + np.exp(clearance)
        w = np.where(lost, 1.0, np.maximum(w, 1e-3))
        weight = np.where(lost, 0.0, self._weight * real)
        common = np.stack([w**-k for k in range(self._order)])
        # Each path's own m is taken out first: what is left of u is linear in the common terms.
        gain = weight * w / np.maximum((weight * w * w * weight).sum(axis=1, keepdims=True), 1e-12)

        def rest(values: Array) -> Array:
            own = (gain * weight * values).sum(axis=-1, keepdims=True)
            return np.asarray(values - own * w)

        terms, left = rest(common), rest(u)
        design = (weight * terms).reshape(self._order, -1).T
        scale = np.maximum(np.linalg.norm(design, axis=0), 1e-12)
        answer = np.linalg.lstsq(design / scale, (weight * left).ravel(), rcond=1e-10)[0] / scale
        distance = left - np.tensordot(answer, terms, axes=1)
        # Across the path, not along the row: paths of vehicles that cross the view lie flat.
        du, dv = (np.gradient(c, axis=1) for c in (u, v))
        steep = np.abs(dv) / np.maximum(np.hypot(du, dv), 1e-9)
        return np.where(lost, MISFIT_PX * 4.0, distance * steep * real)

    def _undistorted(self, k1: float) -> Array:
        """Ideal radii (P, `SAMPLES`) of the places, in image widths; NaN beyond the fold."""
        radius = self._radius
        with np.errstate(divide="ignore", invalid="ignore", over="ignore"):
            for _ in range(8):
                missed = radius * (1.0 + k1 * radius**2) - self._radius
                radius = radius - missed / (1.0 + 3.0 * k1 * radius**2)
            missed = np.abs(radius * (1.0 + k1 * radius**2) - self._radius)
            good = (missed < 1e-4) & (1.0 + 3.0 * k1 * radius**2 > 0.0)
        return np.where(good, radius, np.nan)

    def _error(self, x: Array) -> float:
        """1-sigma of k1, with paths as what varies from one recording to the next."""
        step = np.array([1e-4, 1e-3, 1e-4])
        slopes = []
        for k in range(3):
            move = step[k] * np.eye(3)[k]
            ends = [self._weight * self._distance(x + way * move) for way in (1.0, -1.0)]
            slopes.append((ends[0] - ends[1]) / (2 * step[k]))
        slope = np.stack(slopes, axis=-1)
        error = self._weight * self._distance(x)
        level = max(float((error**2).mean()), 1e-6)
        normal = np.einsum("pni,pnj->ij", slope, slope)
        normal[2, 2] += level / ROLL_SIGMA_RAD**2
        by_path = np.einsum("pni,pn->pi", slope, error)
        bread = np.linalg.pinv(normal, hermitian=True)
        return float(np.sqrt(max((bread @ (by_path.T @ by_path) @ bread)[0, 0], 0.0)))
