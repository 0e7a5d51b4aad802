"""Which control points agree on one plane: least quantile of squares over four-point samples."""

from __future__ import annotations

from itertools import combinations
from math import comb

import numpy as np
from numpy.typing import NDArray

Matrix = NDArray[np.float64]

MAX_SAMPLES = 1000
"""With 45 % wrong points, 9 % of random fours are all good. Among 1000 there is
one, with a probability of all but e^-95."""

ALL_AGREE_SQUARE = 4.0
"""Where every point is this near the plane of all, none is wrong: half of the points, all of them
near two lines along a road, can fit a wild plane better than the true one."""


def normalising(xy: Matrix) -> Matrix:
    """Similarity (3, 3) that moves points (N, 2) to mean 0 and mean distance sqrt(2).

    Hartley (1997), In Defense of the Eight-Point Algorithm.
    """
    mean = xy.mean(axis=0)
    scale = np.sqrt(2.0) / np.hypot(*(xy - mean).T).mean()
    return np.array([[scale, 0, -scale * mean[0]], [0, scale, -scale * mean[1]], [0, 0, 1]])


def transfer(matrix: Matrix, xy: Matrix) -> Matrix:
    """Map points (N, 2) by homographies (..., 3, 3): (..., N, 2)."""
    mapped = xy @ np.swapaxes(matrix[..., :2], -1, -2) + matrix[..., None, :, 2]
    return np.asarray(mapped[..., :2] / mapped[..., 2:])


def jacobian(matrix: Matrix, xy: Matrix) -> Matrix:
    """d(mapped) / d(xy) of points (N, 2) under homographies (..., 3, 3): (..., N, 2, 2)."""
    w = xy @ matrix[..., 2, :2, None] + matrix[..., None, 2:, 2]
    mapped = transfer(matrix, xy)
    rows = matrix[..., None, :2, :2] - mapped[..., :, None] * matrix[..., None, 2:, :2]
    return np.asarray(rows / w[..., None])


def dlt(source: Matrix, target: Matrix) -> Matrix:
    """Homography (3, 3) by the direct linear transform of normalised points (N >= 4, 2).

    Hartley and Zisserman (2004), Multiple View Geometry, algorithm 4.2.
    """
    one, zero = np.ones(len(source)), np.zeros((len(source), 3))
    p = np.column_stack((source, one))
    design = np.vstack(
        (
            np.hstack((p, zero, -target[:, :1] * p)),
            np.hstack((zero, p, -target[:, 1:] * p)),
        )
    )
    return np.asarray(np.linalg.svd(design)[2][-1].reshape(3, 3))


def four_point_homographies(source: Matrix, target: Matrix) -> Matrix:
    """Exact homographies (S, 3, 3) of samples of four points (S, 4, 2), degenerate ones left out.

    Each maps the projective basis of `source` to that of `target` (Hartley and Zisserman,
    section 2.3). A sample with three points on a line fixes no homography.
    """
    (a, a_ok), (b, b_ok) = _basis(source), _basis(target)
    ok = a_ok & b_ok
    return np.asarray(b[ok] @ np.linalg.inv(a[ok]))


def _basis(points: Matrix) -> tuple[Matrix, NDArray[np.bool_]]:
    p = np.concatenate((points, np.ones((*points.shape[:2], 1))), axis=2)
    triple = np.stack(
        [np.linalg.det(p[:, list(k)]) for k in ((0, 1, 2), (3, 1, 2), (0, 3, 2), (0, 1, 3))], axis=1
    )
    weight = triple[:, 1:] / np.where(triple[:, :1] == 0, 1.0, triple[:, :1])
    return np.swapaxes(p[:, :3] * weight[:, :, None], 1, 2), np.abs(triple).min(axis=1) > 1e-3


def error_covariance(
    matrix: Matrix, source: Matrix, variance_source: Matrix, cov_target: Matrix
) -> Matrix:
    """Covariance (..., N, 2, 2) of the transfer error of points (N, 2).

    Both positions of a point are uncertain: the error in the target has its own covariance, and
    the source's isotropic variance through the homography, `variance J J^T`.
    """
    j = jacobian(matrix, source)
    return np.asarray(variance_source[:, None, None] * j @ np.swapaxes(j, -1, -2) + cov_target)


def whitened_square(
    matrix: Matrix, source: Matrix, target: Matrix, variance_source: Matrix, cov_target: Matrix
) -> Matrix:
    """Squared transfer error (..., N) in units of its own 1-sigma; see `error_covariance`."""
    error = target - transfer(matrix, source)
    cov = error_covariance(matrix, source, variance_source, cov_target)
    det = cov[..., 0, 0] * cov[..., 1, 1] - cov[..., 0, 1] ** 2
    x, y = error[..., 0], error[..., 1]
    return np.asarray(
        (cov[..., 1, 1] * x * x - 2 * cov[..., 0, 1] * x * y + cov[..., 0, 0] * y * y) / det
    )


def best_subset(
    source: Matrix, target: Matrix, variance_source: Matrix, cov_target: Matrix
) -> NDArray[np.intp]:
    """Indices of the points that agree best on one homography.

    Over samples of four points, minimises the h-th smallest squared error with
    h = floor((n + 5) / 2), the quantile with the highest breakdown point (Rousseeuw and Leroy
    (1987), Robust Regression and Outlier Detection, chapter 3). All samples are tried where
    there are at most `MAX_SAMPLES`, else a fixed random choice: the answer never varies.

    Args:
        source: (N, 2), normalised.
        target: (N, 2), normalised.
        variance_source: (N,) variance of each coordinate of `source`, in its units.
        cov_target: (N, 2, 2) covariance of `target`, in its units.

    Returns:
        (h,) indices; empty when every sample is degenerate.
    """
    n = len(source)
    h = (n + 5) // 2
    if comb(n, 4) <= MAX_SAMPLES:
        sample = np.array(list(combinations(range(n), 4)))
    else:
        random = np.random.default_rng(0)
        sample = np.argsort(random.random((MAX_SAMPLES, n)), axis=1)[:, :4]
    candidates = four_point_homographies(source[sample], target[sample])
    if not len(candidates):
        return np.empty(0, dtype=np.intp)
    every = dlt(source, target)
    depth = source @ every[2, :2] + every[2, 2]
    error = whitened_square(every, source, target, variance_source, cov_target)
    if (np.all(depth > 0) or np.all(depth < 0)) and error.max() <= ALL_AGREE_SQUARE:
        return np.arange(n)
    with np.errstate(divide="ignore", invalid="ignore", over="ignore"):
        square = whitened_square(candidates, source, target, variance_source, cov_target)
    # Near its horizon a plane excuses any error: all points that count lie on one side of it.
    side = np.sign(source @ candidates[:, 2, :2, None] + candidates[:, 2:, 2:])[..., 0]
    square[side != np.where(side.sum(axis=1) < 0, -1.0, 1.0)[:, None]] = np.inf
    square = np.where(np.isfinite(square), square, np.inf)
    best = int(np.argmin(np.partition(square, h - 1, axis=1)[:, h - 1]))
    return np.argsort(square[best], kind="stable")[:h]
