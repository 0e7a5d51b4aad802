"""The motion that most of the matched points share."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from geoorbit_ros.view.picture import Matrix, moved

Array = NDArray[np.float64]

TOLERANCE_PX = 1.0
"""Points farther from where the motion puts them don't take part. Chosen: larger takes in leaves
and shadows, smaller loses blurred patches."""
WIDE_TOLERANCE_PX = 4.0
"""The same before perspective is fitted: a turn of three degrees bends the picture by so much."""
LEAST_INLIERS = 10
"""With fewer nothing is said. Chosen: the camera's name and clock, which stand in the image
whatever it shows, have fewer; more is blind at night."""
LEAST_SHARE = 0.15
"""Nor with a smaller share of all patches. Chosen: as above."""
LEAST_CELLS = 5
"""Nor where the inliers lie in fewer of 4 x 3 cells of the picture. Chosen: a sign, or the words
in the corners of the image, fill four."""
MARGIN, LEAST_BETWEEN = 0.15, 5
"""Share of the height at the top and at the bottom in which names, clocks and banners stand, and
the least number of inliers between. Chosen: in fog they are most of what the image shows, and the
same in each view."""
PERSPECTIVE_GAIN = 0.8
"""Perspective is taken where it makes the errors this much smaller, or more points fit. Chosen:
larger bends the picture by noise, smaller leaves the corners of a turned camera apart."""
PLAIN_SHARE = 0.9
"""Perspective is not tried where turn, zoom and shift fit more than this share of the points.
Chosen: larger takes more time in each image, smaller misses a slight bend."""
MOST_ZOOM = 1.5
"""No corner of the picture is stretched or shrunk by more. Chosen: patches of another size are not
found any more; larger takes a few points that agree by chance for a motion."""
LEAST_SIGMA_PX = 0.02
"""Nothing is known better, in pixels of a picture: patches along a shadow move together."""


@dataclass(frozen=True, slots=True)
class MotionFit:
    """A motion and how sure it is; see `reference.Match`."""

    motion: Matrix
    sigma_px: float
    inliers: int
    share: float


def fit_motion(
    then: Array, now: Array, of: int, shape: tuple[int, ...], start: Matrix
) -> MotionFit | None:
    """Turn, zoom and shift from points (N, 2) to points (N, 2); perspective where it shows.

    RANSAC (Fischler and Bolles 1981) finds the points that agree, least squares the motion.

    Args:
        then: Before.
        now: After.
        of: How many points were looked for.
        shape: Rows and columns of the picture.
        start: A guess. Where nearly all points agree that it is right but for a shift, nothing is
            drawn at random.

    Returns:
        None where too few agree.
    """
    if len(then) < LEAST_INLIERS:
        return None
    matrix, inlier = _near(then, now, start)
    if np.count_nonzero(inlier) < PLAIN_SHARE * len(then):
        matrix, inlier = _similarity(then, now, TOLERANCE_PX)
    parameters = 4
    if matrix is None or np.count_nonzero(inlier) < PLAIN_SHARE * len(then):
        bent, more = _perspective(then, now)
        if bent is not None and _is_better(bent, more, matrix, inlier, then, now):
            matrix, inlier, parameters = bent, more, 8
    if matrix is None:
        return None
    count = int(np.count_nonzero(inlier))
    share = count / max(of, 1)
    if count < LEAST_INLIERS or share < LEAST_SHARE or not _plausible(matrix, shape):
        return None
    if not (_spread(then[inlier], shape) and _spread(now[inlier], shape)):
        return None
    height = then[inlier, 1] / shape[0]
    if np.count_nonzero(np.abs(height - 0.5) < 0.5 - MARGIN) < LEAST_BETWEEN:
        return None
    error = moved(matrix, then[inlier]) - now[inlier]
    square = float((error**2).sum()) / max(2 * count - parameters, 1)
    # Mean variance of the fitted values: the trace of the hat matrix over their number.
    sigma_px = max(float(np.sqrt(square * parameters / (2 * count))), LEAST_SIGMA_PX)
    return MotionFit(matrix, sigma_px, count, share)


def _similarity(
    then: Array, now: Array, tolerance_px: float
) -> tuple[Matrix | None, NDArray[np.bool_]]:
    _, flags = cv2.estimateAffinePartial2D(then, now, ransacReprojThreshold=tolerance_px)
    return _refined(then, now, np.asarray(flags).ravel().astype(bool), tolerance_px)


def _near(then: Array, now: Array, start: Matrix) -> tuple[Matrix | None, NDArray[np.bool_]]:
    """The motion of points that moved as a guess says, all by the same shift beside it."""
    off = now - moved(start, then)
    off -= np.median(off, axis=0)
    return _refined(then, now, np.hypot(off[:, 0], off[:, 1]) <= TOLERANCE_PX, TOLERANCE_PX)


def _refined(
    then: Array, now: Array, inlier: NDArray[np.bool_], tolerance_px: float
) -> tuple[Matrix | None, NDArray[np.bool_]]:
    """Least squares of the points that agree, which are chosen anew by what was found."""
    matrix = None
    for _ in range(3):
        if np.count_nonzero(inlier) < LEAST_INLIERS:
            return None, inlier
        matrix = _least_squares(then[inlier], now[inlier])
        off = moved(matrix, then) - now
        again = np.hypot(off[:, 0], off[:, 1]) <= tolerance_px
        if np.array_equal(again, inlier):
            break
        inlier = again
    return matrix, inlier


def _least_squares(then: Array, now: Array) -> Matrix:
    """The similarity of least squares, in closed form (complex numbers as in Umeyama 1991)."""
    a, b = then.mean(axis=0), now.mean(axis=0)
    p, q = (then - a) @ [1.0, 1.0j], (now - b) @ [1.0, 1.0j]
    turn = np.vdot(p, q) / max(float(np.vdot(p, p).real), 1e-9)
    linear = np.array([[turn.real, -turn.imag], [turn.imag, turn.real]])
    matrix = np.eye(3)
    matrix[:2, :2], matrix[:2, 2] = linear, b - linear @ a
    return matrix


def _perspective(then: Array, now: Array) -> tuple[Matrix | None, NDArray[np.bool_]]:
    rough, near = _similarity(then, now, WIDE_TOLERANCE_PX)
    nothing = np.zeros(len(then), np.bool_)
    if rough is None or np.count_nonzero(near) < 2 * LEAST_INLIERS:
        return None, nothing
    found: Any = cv2.findHomography(then[near], now[near], cv2.RANSAC, TOLERANCE_PX)
    matrix, flags = found
    if matrix is None:
        return None, nothing
    inlier = nothing.copy()
    inlier[np.flatnonzero(near)] = flags.ravel().astype(bool)
    return np.asarray(matrix / matrix[2, 2]), inlier


def _is_better(
    bent: Matrix,
    more: NDArray[np.bool_],
    plain: Matrix | None,
    inlier: NDArray[np.bool_],
    then: Array,
    now: Array,
) -> bool:
    few, many = np.count_nonzero(inlier), np.count_nonzero(more)
    if many < LEAST_INLIERS:
        return False
    if plain is None or PERSPECTIVE_GAIN * many > few:
        return True
    both = inlier & more
    error = [float(((moved(m, then[both]) - now[both]) ** 2).mean()) for m in (bent, plain)]
    return bool(many >= few and error[0] < PERSPECTIVE_GAIN**2 * error[1])


def _plausible(matrix: Matrix, shape: tuple[int, ...]) -> bool:
    """Whether a camera that still shows some of the same can have moved the picture so."""
    height, width = shape[:2]
    corners = np.array([[0.0, 0.0], [width, 0.0], [width, height], [0.0, height]])
    if (corners @ matrix[2, :2] + matrix[2, 2] <= 0.1 * matrix[2, 2]).any():
        return False
    after = moved(matrix, corners)
    side = after[[1, 2, 3, 0]] - after
    back = -side[[3, 0, 1, 2]]
    turn = side[:, 0] * back[:, 1] - side[:, 1] * back[:, 0]  # twice the corner's triangle
    share = turn / (width * height)
    return bool((share > 1.0 / MOST_ZOOM**2).all() and (share < MOST_ZOOM**2).all())


def _spread(points: Array, shape: tuple[int, ...]) -> bool:
    cell = np.floor(points * [4 / shape[1], 3 / shape[0]]).astype(int).tolist()
    return len({(right, down) for right, down in cell}) >= LEAST_CELLS
