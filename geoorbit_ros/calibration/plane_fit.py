"""Fits the road plane to control points of which some may be wrong, behind a known lens."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import scipy
from numpy.typing import NDArray

from geoorbit_ros.calibration.control_points import MIN_POINTS, ControlPoints
from geoorbit_ros.calibration.lens import Lens
from geoorbit_ros.calibration.plane import ControlResidual, Homography
from geoorbit_ros.calibration.robust import (
    best_subset,
    dlt,
    error_covariance,
    normalising,
    transfer,
    whitened_square,
)
from geoorbit_ros.core.errors import CalibrationError

Matrix = NDArray[np.float64]

PIXEL_SIGMA = 1.5
"""1-sigma of a clicked pixel. Marks on a road are about three pixels wide."""
GROUND_SIGMA_M = 0.15
"""1-sigma of a position read off aerial imagery of 0.1 to 0.3 m per pixel."""
OUTLIER_SQUARE = 13.8
"""Squared error beyond which a point is rejected: chi-square, 2 degrees of freedom, 99.9 %."""
MAX_SPREAD = 20.0
"""A median error of twenty times the expected one is no plane at all, but mixed-up rows. Chosen:
larger accepts wrong calibrations, smaller refuses sloppy ones."""
PRIOR_POINTS = 4.0
"""How many degrees of freedom the expected noise counts for beside the observed residuals. Chosen:
more hides bad control points, fewer makes the error of four points a guess."""
MEDIAN_SQUARE = 1.386
"""Median of the chi-square distribution with 2 degrees of freedom: 2 ln 2."""


@dataclass(frozen=True, slots=True)
class _Cloud:
    """Control points as the fit needs them: normalised, in an order that the file doesn't change.

    Attributes:
        ground: (N, 2) positions.
        pixel: (N, 2) ideal pixels.
        variance: (N,) of each coordinate of `ground`.
        covariance: (N, 2, 2) of `pixel`.
    """

    ground: Matrix
    pixel: Matrix
    variance: Matrix
    covariance: Matrix

    def __len__(self) -> int:
        return len(self.ground)

    def take(self, which: NDArray[np.bool_]) -> _Cloud:
        """Some of the points."""
        return _Cloud(
            *(a[which] for a in (self.ground, self.pixel, self.variance, self.covariance))
        )

    def square(self, matrix: Matrix) -> Matrix:
        """(N,) squared errors in units of their own sigma."""
        return whitened_square(matrix, self.ground, self.pixel, self.variance, self.covariance)


@dataclass(frozen=True, slots=True)
class PlaneFit:
    """The road plane through control points behind one lens.

    Attributes:
        homography: It.
        cost: Sum of the points' squared errors in their own sigma, each up to `OUTLIER_SQUARE`.
        design: (2U, 8) slopes of the used points' errors in their own sigma with the plane.
        error: (2U,) these errors.
        whiten: (U, 2, 2) from ideal pixels to these units.
        used: (U,) rows of the points, in the order of the former.
    """

    homography: Homography
    cost: float
    design: Matrix
    error: Matrix
    whiten: Matrix
    used: NDArray[np.intp]


def fit_plane(
    points: ControlPoints,
    lens: Lens | None,
    pixel_sigma: float = PIXEL_SIGMA,
    ground_sigma_m: float = GROUND_SIGMA_M,
    *,
    k1_fitted: bool = False,
) -> PlaneFit:
    """Fit the road plane in local metres, float64, behind a lens.

    Least quantile of squares finds the points that agree, Levenberg-Marquardt then minimises the
    reprojection error of those (Hartley and Zisserman, section 4.5), each weighed by its own
    covariance: near the camera the surveyed position limits a point, far away the clicked pixel.
    A single wrong point can be told from six points on, never from four or five.

    Args:
        points: At least four, in any order; the result does not depend on it.
        lens: What the pixels were seen through; None: a pinhole.
        pixel_sigma: Expected 1-sigma of a clicked pixel, where the points don't say it.
        ground_sigma_m: Expected 1-sigma of a surveyed position, likewise.
        k1_fitted: Whether the lens' k1 is that at which the points agree best, so that its error
            and the plane's go together; else the lens is exact.

    Raises:
        CalibrationError: The points fix no plane, don't agree on one, or show it mirrored, which
            is what swapped columns do.
    """
    ideal = points.pixel if lens is None else lens.undistort(points.pixel)
    order = np.lexsort(points.pixel.T)
    order = order[np.isfinite(ideal[order]).all(axis=1)]
    if len(order) < MIN_POINTS:
        found = f"{len(order)} control points that the lens can show"
        raise CalibrationError(points.place, found, f"at least {MIN_POINTS}")
    sigmas = _sigmas(points, pixel_sigma, ground_sigma_m)
    cloud, to_unit_ground, to_unit_pixel = _normalised(points, ideal, order, lens, sigmas)
    matrix, inlier = _refine(cloud, _agreeing(cloud, points), points)
    used = cloud.take(inlier)
    whiten = _whitener(matrix, used)
    design = _design(matrix, used.ground, whiten)
    error = np.einsum("nij,nj->ni", whiten, used.pixel - transfer(matrix, used.ground)).ravel()
    square = np.minimum(cloud.square(matrix), OUTLIER_SQUARE)
    cost = float(square.sum()) + OUTLIER_SQUARE * (len(points) - len(cloud))

    row, own = order[inlier], whiten * to_unit_pixel[0, 0]
    every = design
    if lens is not None and k1_fitted:
        every = np.column_stack((design, k1_column(lens, ideal[row], own)))
    unit_spread, k1_spread = _spread(every, error)
    to_pixel = np.linalg.inv(to_unit_pixel) @ matrix @ to_unit_ground
    spread_pixel = np.linalg.inv(to_unit_pixel) @ unit_spread @ to_unit_ground
    plane = _on_ground(to_pixel, spread_pixel, k1_spread, points, ideal, row, lens)
    return PlaneFit(plane, cost, design, error, own, row)


def _agreeing(cloud: _Cloud, points: ControlPoints) -> NDArray[np.bool_]:
    """(N,) points that agree best on one plane."""
    start = best_subset(cloud.ground, cloud.pixel, cloud.variance, cloud.covariance)
    if not len(start):
        raise CalibrationError(
            points.place,
            "no four points of which three aren't on one line",
            "points spread over the road in both directions",
        )
    agreeing = np.zeros(len(cloud), dtype=bool)
    agreeing[start] = True
    return agreeing


def _normalised(
    points: ControlPoints,
    ideal: Matrix,
    order: NDArray[np.intp],
    lens: Lens | None,
    sigmas: tuple[Matrix, Matrix],
) -> tuple[_Cloud, Matrix, Matrix]:
    """The points in an order, and the similarities that normalised ground and pixels."""
    to_unit_ground, to_unit_pixel = normalising(points.local_m[order]), normalising(ideal[order])
    sigma_px, sigma_m = sigmas
    cloud = _Cloud(
        transfer(to_unit_ground, points.local_m[order]),
        transfer(to_unit_pixel, ideal[order]),
        (sigma_m[order] * to_unit_ground[0, 0]) ** 2,
        (sigma_px[order] * to_unit_pixel[0, 0])[:, None, None] ** 2 * _stretch(lens, ideal[order]),
    )
    return cloud, to_unit_ground, to_unit_pixel


def _on_ground(
    to_pixel: Matrix,
    spread_pixel: Matrix,
    k1_spread: Matrix,
    points: ControlPoints,
    ideal: Matrix,
    row: NDArray[np.intp],
    lens: Lens | None,
) -> Homography:
    """The plane from pixels to metres, of that from metres to pixels, its spread and used rows."""
    to_ground = np.asarray(np.linalg.inv(to_pixel))
    # d(G^-1) = -G^-1 dG G^-1
    spread = -to_ground @ spread_pixel @ to_ground
    depth = (ideal @ to_ground[2, :2] + to_ground[2, 2])[row]
    to_ground, spread, depth = (a / depth.mean() for a in (to_ground, spread, depth))
    _check_orientation(to_ground, depth, points)
    used = np.zeros(len(points), dtype=bool)
    used[row] = True
    spread = _with_common_scale(to_ground, spread, points, used)
    by_k1 = None
    if k1_spread.any():
        by_k1 = np.append(k1_spread, np.zeros(len(spread) - len(k1_spread)))
    residual = _residual(to_ground, lens, points, ideal, used)
    return Homography(to_ground, spread, points, residual, lens=lens, k1_spread=by_k1)


def k1_column(lens: Lens, ideal: Matrix, whiten: Matrix) -> Matrix:
    """(2N,) slopes with k1 of what the points miss, in their own sigma; see `PlaneFit.design`.

    A larger k1 brings the ideal pixels (N, 2) of the same real ones nearer to the axis.
    """
    moved = np.linalg.solve(lens.slope(ideal), lens.slope_of_k1(ideal)[:, :, None])
    return np.asarray((whiten @ moved).ravel())


def _sigmas(
    points: ControlPoints, pixel_sigma: float, ground_sigma_m: float
) -> tuple[Matrix, Matrix]:
    """(N,) 1-sigma of each point in the image and on the ground, as the file or as usual."""
    found = []
    for said, usual in ((points.sigma_px, pixel_sigma), (points.sigma_m, ground_sigma_m)):
        own = np.full(len(points), np.nan) if said is None else said
        found.append(np.where(np.isfinite(own), own, usual))
    return found[0], found[1]


def _stretch(lens: Lens | None, ideal: Matrix) -> Matrix:
    """Covariance (N, 2, 2) in ideal pixels of a real pixel's error of one in each direction."""
    if lens is None:
        return np.broadcast_to(np.eye(2), (len(ideal), 2, 2))
    by_real = np.linalg.inv(lens.slope(ideal))
    return np.asarray(by_real @ np.swapaxes(by_real, 1, 2))


def _with_common_scale(
    to_ground: Matrix, spread: Matrix, points: ControlPoints, used: NDArray[np.bool_]
) -> Matrix:
    """The spread and, where all distances may be wrong by one factor, that change as well."""
    if points.facts.scale_sigma <= 0.0:
        return spread
    east, north = points.local_m[used].mean(axis=0)
    about = np.array([[1.0, 0.0, -east], [0.0, 1.0, -north], [0.0, 0.0, 0.0]])
    return np.concatenate((spread, points.facts.scale_sigma * (about @ to_ground)[None]))


def _residual(
    to_ground: Matrix,
    lens: Lens | None,
    points: ControlPoints,
    ideal: Matrix,
    used: NDArray[np.bool_],
) -> ControlResidual:
    with np.errstate(divide="ignore", invalid="ignore"):
        expected = transfer(np.asarray(np.linalg.inv(to_ground)), points.local_m)
        off = expected - ideal
        if lens is not None:
            real = lens.distort(expected) - points.pixel
            off = np.where(np.isfinite(real), real, off)
        ground = transfer(to_ground, ideal) - points.local_m
        return ControlResidual(np.hypot(*off.T), np.hypot(*ground.T), used)


def _refine(
    cloud: _Cloud, inlier: NDArray[np.bool_], points: ControlPoints
) -> tuple[Matrix, NDArray[np.bool_]]:
    """Alternate between fitting the inliers and choosing them, at most ten times."""
    matrix = _scaled(dlt(cloud.ground[inlier], cloud.pixel[inlier]), points)
    for _ in range(10):
        matrix = _minimise(matrix, cloud.take(inlier))
        median = float(np.median(cloud.square(matrix)[inlier])) / MEDIAN_SQUARE
        if median > MAX_SPREAD**2:
            error = np.hypot(*(transfer(matrix, cloud.ground) - cloud.pixel).T)[inlier]
            raise CalibrationError(
                points.place,
                f"control points that miss their common plane by "
                f"{np.median(error) / normalising(points.pixel)[0, 0]:.0f} px in the middle",
                "rows whose pixel and position belong together, on a flat road",
            )
        chosen = _square_with_fit(matrix, cloud, inlier) <= OUTLIER_SQUARE * max(1.0, median)
        if np.array_equal(chosen, inlier) or chosen.sum() < len(cloud) // 2 + 1:
            break
        inlier = chosen
    return matrix, inlier


def _square_with_fit(matrix: Matrix, cloud: _Cloud, inlier: NDArray[np.bool_]) -> Matrix:
    """Squared errors (N,) in their own sigma, which for points left out has that of the fit too."""
    whiten = _whitener(matrix, cloud)
    design = _design(matrix, cloud.ground, whiten).reshape(-1, 2, 8)
    used = design[inlier].reshape(-1, 8)
    leverage = design @ np.linalg.pinv(used.T @ used, hermitian=True) @ design.transpose(0, 2, 1)
    covariance = np.eye(2) + leverage * ~inlier[:, None, None]
    error = whiten @ (cloud.pixel - transfer(matrix, cloud.ground))[:, :, None]
    return np.asarray((error.transpose(0, 2, 1) @ np.linalg.inv(covariance) @ error)[:, 0, 0])


def _scaled(matrix: Matrix, points: ControlPoints) -> Matrix:
    """Fix the free scale by the last element, which is the depth of the points' centre."""
    if abs(matrix[2, 2]) < 1e-9 * np.abs(matrix).max():
        raise CalibrationError(
            points.place,
            "a ground plane whose horizon runs through the control points",
            "rows whose pixel and position belong together",
        )
    return np.asarray(matrix / matrix[2, 2])


def _minimise(start: Matrix, cloud: _Cloud) -> Matrix:
    """Levenberg-Marquardt on whitened pixel errors; weights follow the solution, three times."""
    matrix = start
    for _ in range(3):
        whiten = _whitener(matrix, cloud)

        def error(h: Matrix, whiten: Matrix = whiten) -> Matrix:
            mapped = transfer(np.append(h, 1.0).reshape(3, 3), cloud.ground)
            return np.asarray(np.einsum("nij,nj->ni", whiten, mapped - cloud.pixel).ravel())

        def slope(h: Matrix, whiten: Matrix = whiten) -> Matrix:
            return _design(np.append(h, 1.0).reshape(3, 3), cloud.ground, whiten)

        solution = scipy.optimize.least_squares(
            error, matrix.ravel()[:8], slope, method="lm", xtol=1e-15, ftol=1e-15, gtol=1e-15
        )
        matrix = np.append(solution.x, 1.0).reshape(3, 3)
    return matrix


def _whitener(matrix: Matrix, cloud: _Cloud) -> Matrix:
    cov = error_covariance(matrix, cloud.ground, cloud.variance, cloud.covariance)
    return np.asarray(np.linalg.inv(np.linalg.cholesky(cov)))


def _design(matrix: Matrix, ground: Matrix, whiten: Matrix) -> Matrix:
    """d(whitened pixel) / d(first eight elements of the matrix), (2N, 8)."""
    p = np.column_stack((ground, np.ones(len(ground))))
    mapped = transfer(matrix, ground)
    w = (p @ matrix[2])[:, None]
    zero = np.zeros_like(p)
    du = np.hstack((p, zero, -mapped[:, :1] * p[:, :2])) / w
    dv = np.hstack((zero, p, -mapped[:, 1:] * p[:, :2])) / w
    return np.asarray((whiten @ np.stack((du, dv), axis=1)).reshape(-1, 8))


def noise_level(square: float, freedom: int) -> float:
    """Variance of the points' errors over what was expected of them.

    The mean of what was expected and what the residuals show, weighed by their degrees of freedom:
    four points fit exactly and say nothing about it.
    """
    return (square + PRIOR_POINTS) / (freedom + PRIOR_POINTS)


def _spread(design: Matrix, error: Matrix) -> tuple[Matrix, Matrix]:
    """Independent 1-sigma changes (K, 3, 3) of the normalised matrix, and (K,) of k1 with them.

    Args:
        design: (2N, K) slopes with the matrix's first eight elements, and with k1 where K is 9.
        error: (2N,) what the points miss, in their own sigma.
    """
    level = noise_level(float(error @ error), len(error) - design.shape[1])
    _, s, vt = np.linalg.svd(design, full_matrices=False)
    changes = np.sqrt(level) * vt / s[:, None]
    matrix = np.zeros((len(changes), 9))
    matrix[:, :8] = changes[:, :8]
    return matrix.reshape(-1, 3, 3), changes[:, 8:].sum(axis=1)


def _check_orientation(matrix: Matrix, depth: Matrix, points: ControlPoints) -> None:
    """A road seen from above keeps its handedness: east-north turns one way, right-down the other.

    The determinant of d(east, north) / d(right, down) is det(matrix) / depth**3, so the matrix has
    a negative determinant for every camera above the road. Swapped columns mirror the plane.
    """
    if not np.all(depth > 0):
        raise CalibrationError(
            points.place,
            "a ground plane whose horizon runs through the control points",
            "rows whose pixel and position belong together",
        )
    if np.linalg.det(matrix) > 0:
        names = "latitude and longitude" if points.datum is not None else "x_m and y_m"
        raise CalibrationError(
            points.place,
            "a mirrored ground plane, as if the camera looked from below the road",
            f"a road seen from above: are {names}, or pixel_x and pixel_y, swapped?",
        )
