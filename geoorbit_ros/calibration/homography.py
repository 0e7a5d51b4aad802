"""Fits the road plane to control points of which some may be wrong."""

from __future__ import annotations

import numpy as np
import scipy
from numpy.typing import NDArray

from geoorbit_ros.calibration.control_points import ControlPoints, check_points
from geoorbit_ros.calibration.plane import ControlResidual, Homography
from geoorbit_ros.calibration.robust import (
    best_subset,
    dlt,
    jacobian,
    normalising,
    transfer,
    whitened_square,
)
from geoorbit_ros.core.errors import CalibrationError

__all__ = ["ControlResidual", "Homography", "fit_homography"]

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


def fit_homography(
    points: ControlPoints,
    pixel_sigma: float = PIXEL_SIGMA,
    ground_sigma_m: float = GROUND_SIGMA_M,
) -> Homography:
    """Fit the road plane in local metres, float64.

    Least quantile of squares finds the points that agree, Levenberg-Marquardt then minimises the
    reprojection error of those (Hartley and Zisserman, section 4.5), each weighed by its own
    covariance: near the camera the surveyed position limits a point, far away the clicked pixel.
    A single wrong point can be told from six points on, never from four or five.

    Args:
        points: At least four, in any order; the result does not depend on it.
        pixel_sigma: Expected 1-sigma of a clicked pixel.
        ground_sigma_m: Expected 1-sigma of a surveyed position.

    Raises:
        CalibrationError: The points fix no plane, don't agree on one, or show it mirrored, which
            is what swapped columns do.
    """
    check_points(points)
    order = np.lexsort(points.pixel.T)
    local_m, pixel = points.local_m[order], points.pixel[order]
    to_unit_ground, to_unit_pixel = normalising(local_m), normalising(pixel)
    ground, pixel = transfer(to_unit_ground, local_m), transfer(to_unit_pixel, pixel)
    noise = (ground_sigma_m * to_unit_ground[0, 0], pixel_sigma * to_unit_pixel[0, 0])

    start = best_subset(ground, pixel, *noise)
    if not len(start):
        raise CalibrationError(
            points.place,
            "no four points of which three aren't on one line",
            "points spread over the road in both directions",
        )
    inlier = np.zeros(len(points), dtype=bool)
    inlier[start] = True
    matrix, inlier = _refine(ground, pixel, inlier, noise, points)
    unit_spread = _spread(matrix, ground[inlier], pixel[inlier], noise)

    to_pixel = np.linalg.inv(to_unit_pixel) @ matrix @ to_unit_ground
    to_ground = np.linalg.inv(to_pixel)
    # d(G^-1) = -G^-1 dG G^-1
    spread_pixel = np.linalg.inv(to_unit_pixel) @ unit_spread @ to_unit_ground
    spread = -to_ground @ spread_pixel @ to_ground
    depth = (points.pixel @ to_ground[2, :2] + to_ground[2, 2])[order][inlier]
    to_ground, spread, depth = (a / depth.mean() for a in (to_ground, spread, depth))
    _check_orientation(to_ground, depth, points)

    used = np.zeros(len(points), dtype=bool)
    used[order] = inlier
    with np.errstate(divide="ignore", invalid="ignore"):
        residual = ControlResidual(
            np.hypot(*(transfer(np.linalg.inv(to_ground), points.local_m) - points.pixel).T),
            np.hypot(*(transfer(to_ground, points.pixel) - points.local_m).T),
            used,
        )
    return Homography(to_ground, spread, points, residual)


def _refine(
    ground: Matrix,
    pixel: Matrix,
    inlier: NDArray[np.bool_],
    noise: tuple[float, float],
    points: ControlPoints,
) -> tuple[Matrix, NDArray[np.bool_]]:
    """Alternate between fitting the inliers and choosing them, at most ten times."""
    matrix = _scaled(dlt(ground[inlier], pixel[inlier]), points)
    for _ in range(10):
        matrix = _minimise(matrix, ground[inlier], pixel[inlier], noise)
        square = whitened_square(matrix, ground, pixel, *noise)
        median = float(np.median(square[inlier])) / MEDIAN_SQUARE
        if median > MAX_SPREAD**2:
            error = np.hypot(*(transfer(matrix, ground) - pixel).T)[inlier]
            raise CalibrationError(
                points.place,
                f"control points that miss their common plane by "
                f"{np.median(error) / normalising(points.pixel)[0, 0]:.0f} px in the middle",
                "rows whose pixel and position belong together, on a flat road",
            )
        square = _square_with_fit(matrix, ground, pixel, inlier, noise)
        chosen = square <= OUTLIER_SQUARE * max(1.0, median)
        if np.array_equal(chosen, inlier) or chosen.sum() < len(ground) // 2 + 1:
            break
        inlier = chosen
    return matrix, inlier


def _square_with_fit(
    matrix: Matrix,
    ground: Matrix,
    pixel: Matrix,
    inlier: NDArray[np.bool_],
    noise: tuple[float, float],
) -> Matrix:
    """Squared errors (N,) in their own sigma, which for points left out has that of the fit too."""
    whiten = _whitener(matrix, ground, noise)
    design = _design(matrix, ground, whiten).reshape(-1, 2, 8)
    used = design[inlier].reshape(-1, 8)
    leverage = design @ np.linalg.pinv(used.T @ used, hermitian=True) @ design.transpose(0, 2, 1)
    covariance = np.eye(2) + leverage * ~inlier[:, None, None]
    error = whiten @ (pixel - transfer(matrix, ground))[:, :, None]
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


def _minimise(start: Matrix, ground: Matrix, pixel: Matrix, noise: tuple[float, float]) -> Matrix:
    """Levenberg-Marquardt on whitened pixel errors; weights follow the solution, three times."""
    matrix = start
    for _ in range(3):
        whiten = _whitener(matrix, ground, noise)

        def error(h: Matrix, whiten: Matrix = whiten) -> Matrix:
            mapped = transfer(np.append(h, 1.0).reshape(3, 3), ground)
            return np.asarray(np.einsum("nij,nj->ni", whiten, mapped - pixel).ravel())

        def slope(h: Matrix, whiten: Matrix = whiten) -> Matrix:
            return _design(np.append(h, 1.0).reshape(3, 3), ground, whiten)

        solution = scipy.optimize.least_squares(
            error, matrix.ravel()[:8], slope, method="lm", xtol=1e-15, ftol=1e-15, gtol=1e-15
        )
        matrix = np.append(solution.x, 1.0).reshape(3, 3)
    return matrix


def _whitener(matrix: Matrix, ground: Matrix, noise: tuple[float, float]) -> Matrix:
    j = jacobian(matrix, ground)
    cov = noise[0] ** 2 * j @ np.swapaxes(j, 1, 2) + noise[1] ** 2 * np.eye(2)
    return np.linalg.inv(np.linalg.cholesky(cov))


def _design(matrix: Matrix, ground: Matrix, whiten: Matrix) -> Matrix:
    """d(whitened pixel) / d(first eight elements of the matrix), (2N, 8)."""
    p = np.column_stack((ground, np.ones(len(ground))))
    mapped = transfer(matrix, ground)
    w = (p @ matrix[2])[:, None]
    zero = np.zeros_like(p)
    du = np.hstack((p, zero, -mapped[:, :1] * p[:, :2])) / w
    dv = np.hstack((zero, p, -mapped[:, 1:] * p[:, :2])) / w
    return np.asarray((whiten @ np.stack((du, dv), axis=1)).reshape(-1, 8))


def _spread(matrix: Matrix, ground: Matrix, pixel: Matrix, noise: tuple[float, float]) -> Matrix:
    """Eight 1-sigma changes (8, 3, 3) of the normalised matrix.

    The noise level is the mean of what was expected and what the residuals show, weighed by their
    degrees of freedom: four points fit exactly and say nothing about it.
    """
    design = _design(matrix, ground, _whitener(matrix, ground, noise))
    freedom = 2 * len(ground) - 8
    observed = float(whitened_square(matrix, ground, pixel, *noise).sum())
    level = (observed + PRIOR_POINTS) / (freedom + PRIOR_POINTS)
    _, s, vt = np.linalg.svd(design, full_matrices=False)
    changes = np.zeros((8, 9))
    changes[:, :8] = np.sqrt(level) * vt / s[:, None]
    return changes.reshape(8, 3, 3)


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
