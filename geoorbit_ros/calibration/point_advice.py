"""What a person needs to know while choosing control points: which is wrong, where one is missing.

All of it follows from the fit's covariance (`RoadPlane.fit_shifts`), without fitting again: fast
enough to be shown while a point is being moved.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from geoorbit_ros.calibration.homography import GROUND_SIGMA_M, PIXEL_SIGMA
from geoorbit_ros.calibration.plane import Homography
from geoorbit_ros.core.errors import CalibrationError
from geoorbit_ros.core.input_report import Remark, Treatment

Array = NDArray[np.float64]

WRONG_SQUARE = 13.8
"""Squared error, in its own 1-sigma, from which a point is wrong: chi-square, 2 degrees of freedom,
99.9 %. As `homography.OUTLIER_SQUARE`."""
MISFIT = 1.5
"""Errors that are larger than expected by this are told. Chosen: chance makes 1.4 of 6 points."""
MIN_TOLD = 6
"""Points from which on a single wrong one can be told: of five, each may be the wrong one."""
LEVEL_PRIOR = 4.0
"""Degrees of freedom that the expected noise counts for; as `homography.PRIOR_POINTS`."""
ALONE = 0.01
"""What is left of a point's own noise in a direction, as a share, where it alone fixes the plane.
Chosen: smaller takes rounding for errors."""
GRID = (16, 10)
"""Places in the image, right and down, where a further point is tried. Chosen: more cost time."""
MARGIN = 0.02
"""No point is asked for nearer to the image's border, as a share of its side."""
MAX_PIXEL_M = 0.5
"""Nor where a pixel is longer than this on the road, in its shorter direction: nobody clicks it
exactly. Where one is longer than `ROAD_PIXEL_M` the road is not judged, either."""
ROAD_PIXEL_M = 0.3
UNSURE_M = 0.5
"""Where the road in view is known less exactly, it is told. Chosen: a seventh of a lane; larger is
told too late to keep lanes apart, smaller of every file with four points."""


@dataclass(frozen=True, slots=True)
class PointAdvice:
    """How good control points are, and what would make them better.

    Attributes:
        sigma_m: Median 1-sigma ground error of the plane over the road in view, metres.
        misfit: Error of the points in their expected 1-sigma, 1 where all is as expected.
        sigmas: (N,) error of each point against the others, in its own 1-sigma.
        wrong: (N,) whether it disagrees with them.
        told: Whether there are enough points to say which one is wrong.
        next_pixel: (2,) where in the image a further point would help most.
        next_sigma_m: What `sigma_m` would be with it.
    """

    sigma_m: float
    misfit: float
    sigmas: Array
    wrong: NDArray[np.bool_]
    told: bool
    next_pixel: Array
    next_sigma_m: float

    def sentences(self, line_number: NDArray[np.int64]) -> list[str]:
        """The same for a person; `line_number` (N,) names the points."""
        said = [f"the road in view is known to ± {self.sigma_m:.2f} m"]
        if self.misfit > MISFIT:
            said.append(self._misfit_sentence())
        if self.wrong.any() and self.told:
            worst = np.flatnonzero(self.wrong)[np.argsort(-self.sigmas[self.wrong])]
            named = ", ".join(f"{line_number[k]} ({self.sigmas[k]:.0f}σ)" for k in worst[:5])
            said.append(f"wrong against the others: line {named}")
        elif self.wrong.any():
            said.append(
                f"the points disagree; which one is wrong can be told from {MIN_TOLD} points on"
            )
        said.append(self.next_sentence())
        return said

    def next_sentence(self) -> str:
        """Where one more point helps most."""
        u, v = self.next_pixel
        return (
            f"a further point near pixel ({u:.0f}, {v:.0f}) would help most: ± "
            f"{self.next_sigma_m:.2f} m"
        )

    def _misfit_sentence(self) -> str:
        return f"the points are off by {self.misfit:.1f} times what is expected of them"

    def remarks(self, homography: Homography) -> list[Remark]:
        """What a person should be told who did not ask; empty where the points are good.

        Points that the fit left out are not named: they are told with the fit.
        """
        said = []
        number = homography.points.line_number
        pulled = np.flatnonzero(self.wrong & homography.residual.inlier)
        if len(pulled) and self.told:
            worst = pulled[np.argsort(-self.sigmas[pulled])][:5]
            named = ", ".join(f"line {number[k]} by {self.sigmas[k]:.0f}σ" for k in worst)
            said.append(f"used, but off against all others: {named}")
        elif self.misfit > MISFIT:
            more = f"; which one is wrong can be told from {MIN_TOLD} points on"
            said.append(self._misfit_sentence() + ("" if self.told else more))
        if said or self.sigma_m > UNSURE_M:
            said.append(f"the road in view is known to ± {self.sigma_m:.2f} m")
            said.append(self.next_sentence())
        return [Remark(Treatment.NOTED, 0, "; ".join(said))] if said else []


def point_remarks(homography: Homography, image_size: tuple[int, int]) -> list[Remark]:
    """What is to be said about points that a person clicked; nothing where they are good.

    Points that were computed from traffic are nobody's clicks: their file says how sure it is.
    """
    if homography.points.facts.scale_sigma > 0.0:
        return []
    try:
        advice = advise(homography, image_size)
    except CalibrationError:
        return []  # they show no road near the camera: no place for another point is known
    return advice.remarks(homography)


def advise(
    homography: Homography,
    image_size: tuple[int, int],
    where: Array | None = None,
    pixel_sigma: float = PIXEL_SIGMA,
    ground_sigma_m: float = GROUND_SIGMA_M,
) -> PointAdvice:
    """Judge the points behind a road plane.

    Args:
        homography: Fitted to them.
        image_size: (width, height) of the image in pixels.
        where: (M, 2) pixels of the road that matter, such as where vehicles drive; default: all of
            the image in which a pixel is short enough on the ground.
        pixel_sigma: 1-sigma of a clicked pixel.
        ground_sigma_m: 1-sigma of a surveyed position.

    Raises:
        CalibrationError: No part of the image shows road near enough.
    """
    points = homography.points
    grid = _grid(image_size)
    short = _short_side_m(homography, grid)
    road = grid[short <= ROAD_PIXEL_M] if where is None else np.asarray(where, dtype=np.float64)
    road = road[homography.visible(road)]
    tried = grid[short <= MAX_PIXEL_M]
    if not len(road) or not len(tried):
        found = "control points that show no road near the camera"
        raise CalibrationError(points.place, found, "points of which some are near the camera")
    noise = _noise(homography, points.pixel, pixel_sigma, ground_sigma_m)
    error = homography.to_ground(points.pixel) - points.local_m
    inlier = homography.residual.inlier
    square = np.einsum("ni,nij,nj->n", error, np.linalg.inv(noise), error)[inlier].sum()
    freedom = 2 * int(inlier.sum()) - 8
    level = (float(square) + LEVEL_PRIOR) / (freedom + LEVEL_PRIOR)
    sigmas = _sigmas(homography, noise, error, level)
    gain, next_pixel = _best_next(homography, road, tried, level, pixel_sigma, ground_sigma_m)
    return PointAdvice(
        sigma_m=float(np.median(_size(homography.fit_covariance(road)))),
        misfit=float(np.sqrt(square / freedom)) if freedom > 0 else 0.0,
        sigmas=sigmas,
        wrong=(sigmas**2 > WRONG_SQUARE) | ~inlier,
        told=len(points) >= MIN_TOLD,
        next_pixel=next_pixel,
        next_sigma_m=gain,
    )


def _grid(image_size: tuple[int, int]) -> Array:
    """(N, 2) pixels all over the image."""
    sides = [
        np.linspace(MARGIN * side, (1.0 - MARGIN) * side, count)
        for side, count in zip(image_size, GRID, strict=True)
    ]
    return np.stack(np.meshgrid(*sides), axis=-1).reshape(-1, 2)


def _short_side_m(homography: Homography, pixel: Array) -> Array:
    """(N,) metres of a pixel on the road in its shorter direction; infinite above the horizon."""
    with np.errstate(divide="ignore", invalid="ignore", over="ignore"):
        short = np.linalg.svd(
            np.nan_to_num(homography.jacobian(pixel), posinf=1e9, neginf=1e9), compute_uv=False
        )[:, -1]
    return np.where(homography.visible(pixel), short, np.inf)


def _noise(homography: Homography, pixel: Array, pixel_sigma: float, sigma_m: float) -> Array:
    """(N, 2, 2) in m²: what is expected of clicked pixels and surveyed positions."""
    j = homography.jacobian(pixel)
    return np.asarray(pixel_sigma**2 * j @ np.swapaxes(j, 1, 2) + sigma_m**2 * np.eye(2))


def _sigmas(homography: Homography, noise: Array, error: Array, level: float) -> Array:
    """(N,) errors against the fit without the point (Cook and Weisberg 1982, section 2.2.1).

    A point that took part pulled the fit to itself: its error's covariance is that of its noise
    less that of the fit. A point that was left out did not: the sum of both.
    """
    points, inlier = homography.points, homography.residual.inlier
    whiten = np.linalg.inv(np.linalg.cholesky(noise))
    fit = whiten @ (homography.fit_covariance(points.pixel) / level) @ np.swapaxes(whiten, 1, 2)
    left = np.eye(2) + np.where(inlier[:, None, None], -fit, fit)
    values, axes = np.linalg.eigh(left)
    part = np.einsum("nij,njk,nk->ni", np.swapaxes(axes, 1, 2), whiten, error) ** 2
    # A point that alone fixes a direction fits there, whatever it says.
    known = values > ALONE
    square = np.where(known, part / np.maximum(values, ALONE), 0.0).sum(axis=1)
    return np.asarray(np.sqrt(square / level))


def _best_next(
    homography: Homography,
    road: Array,
    tried: Array,
    level: float,
    pixel_sigma: float,
    ground_sigma_m: float,
) -> tuple[float, Array]:
    """Median ground error with the best further point, and its pixel (2,).

    The covariance after one more observation is that of a Kalman filter's update.
    """
    at_road, at_tried = homography.fit_shifts(road), homography.fit_shifts(tried)
    covariance = homography.fit_covariance(road)
    noise = level * _noise(homography, tried, pixel_sigma, ground_sigma_m)
    weight = np.linalg.inv(homography.fit_covariance(tried) + noise)
    shared = np.einsum("rki,ckj->crij", at_road, at_tried)
    less = np.einsum("crij,cjk,crlk->cril", shared, weight, shared)
    after = np.median(_size(covariance[None] - less), axis=1)
    best = int(np.argmin(after))
    return float(after[best]), tried[best]


def _size(covariance: Array) -> Array:
    """1-sigma (...) of a position with covariances (..., 2, 2), in any direction on average."""
    total = np.trace(covariance, axis1=-2, axis2=-1)
    return np.asarray(np.sqrt(np.maximum(total, 0.0) / 2.0))
