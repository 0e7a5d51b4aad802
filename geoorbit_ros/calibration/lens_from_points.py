"""A lens from control points: the distortion through which they lie on one plane."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import numpy as np
import scipy
from numpy.typing import NDArray

from geoorbit_ros.calibration.camera_pose import recover_pose
from geoorbit_ros.calibration.control_points import ControlPoints, check_points
from geoorbit_ros.calibration.lens import LensEstimate, unit_lens, with_focal
from geoorbit_ros.calibration.plane import Homography
from geoorbit_ros.calibration.plane_fit import (
    GROUND_SIGMA_M,
    PIXEL_SIGMA,
    PlaneFit,
    fit_plane,
    k1_column,
    noise_level,
)
from geoorbit_ros.core.errors import CalibrationError

Array = NDArray[np.float64]

MIN_POINTS = 8
"""A plane takes four points, a lens' k1 half a point; the others tell it from errors of the points.
Chosen: fewer take one wrong point for a lens, more leave out careful calibrations."""
SIGNIFICANT = 10.83
"""By how much the squared errors must fall: chi-square, 1 degree of freedom, 99.9 %. Chosen: larger
overlooks lenses, smaller sees them in noise."""
GRID = (
    -0.9,
    -0.75,
    -0.6,
    -0.5,
    -0.4,
    -0.32,
    -0.25,
    -0.19,
    -0.14,
    -0.1,
    -0.06,
    -0.03,
    0.0,
    0.04,
    0.09,
    0.15,
    0.25,
)
"""k1 in units of the image's width at which the search begins: between neighbours, points at the
border of an image move by some pixels. Beyond the ends, images fold over near their middle."""
TOLERANCE = 1e-5
"""Of k1 in units of the image's width: a hundredth of a pixel at the image's border."""
TELLING = 0.1
"""A k1 less certain than this, in units of the image's width, is not known: 20 px at the border of
an image of 1920."""


def shows_lens(points: ControlPoints, plain: PlaneFit) -> bool:
    """Whether points may be explained far better through a lens than by their plane alone.

    A score test: what adding k1 would explain, to first order. Points that were left out make the
    search worth its time, too.
    """
    if points.image_size is None or len(points) < MIN_POINTS:
        return False
    if not plain.homography.residual.inlier.all():
        return True
    k1, sigma = _first_order(points, plain)
    level = noise_level(float(plain.error @ plain.error), len(plain.error) - 8)
    return k1**2 > SIGNIFICANT * level * sigma**2 / 2


def find_lens(
    points: ControlPoints,
    plain: PlaneFit | None,
    pixel_sigma: float = PIXEL_SIGMA,
    ground_sigma_m: float = GROUND_SIGMA_M,
) -> tuple[LensEstimate, Homography | None]:
    """The lens' k1 by control points, and the plane behind it where they show one.

    The plane is fitted for each k1 anew, with its own choice of points that agree; k1 is where the
    squared errors are smallest. Only its quotient with the square of the focal length shows; the
    focal length is that of the plane behind the lens, where it fixes one.

    Args:
        points: Pixels of an image whose size is known.
        plain: Their plane without a lens; None: there is none.
        pixel_sigma: Expected 1-sigma of a clicked pixel, where the points don't say it.
        ground_sigma_m: Expected 1-sigma of a surveyed position, likewise.
    """
    size = points.image_size
    if size is None or len(points) < MIN_POINTS:
        found = "an unknown image size" if size is None else f"{len(points)} control points"
        text = f"{found} can't tell the lens: {MIN_POINTS} control points of a known image can"
        return LensEstimate(None, np.nan, np.inf, text), None

    def cost(k1: float) -> float:
        try:
            return fit_plane(points, unit_lens(size, k1), pixel_sigma, ground_sigma_m).cost
        except CalibrationError:
            return np.inf

    k1 = _least(cost)
    if k1 is None:
        text = "the control points can't tell the lens: through none they lie on a plane"
        return LensEstimate(None, np.nan, np.inf, text), None
    try:
        fit = fit_plane(points, unit_lens(size, k1), pixel_sigma, ground_sigma_m, k1_fitted=True)
    except CalibrationError as error:
        return LensEstimate(None, np.nan, np.inf, f"the lens can't be told: {error}"), None
    level = noise_level(fit.cost, 2 * len(points) - 9)
    gain = np.inf if plain is None else (plain.cost - fit.cost) / level
    plane = fit.homography
    assert plane.k1_spread is not None
    sigma = float(np.linalg.norm(plane.k1_spread))
    if not sigma <= TELLING:
        text = f"the control points can't tell the lens: k1 is known to ± {sigma:.1g} only"
        return LensEstimate(None, k1, sigma, text), None
    if gain < SIGNIFICANT:
        text = f"the control points show no lens: k1 = {k1:.3f} ± {sigma:.3f} of the image's width"
        return LensEstimate(None, k1, sigma, text), None
    return _with_its_focal(plane, size, sigma)


def estimate_lens_from_points(
    points: ControlPoints, pixel_sigma: float = PIXEL_SIGMA, ground_sigma_m: float = GROUND_SIGMA_M
) -> LensEstimate:
    """The lens that control points show, whatever their file says; see `find_lens`.

    Raises:
        CalibrationError: Points that can't fix a plane (`check_points`).
    """
    check_points(points)
    try:
        plain = fit_plane(points, None, pixel_sigma, ground_sigma_m)
    except CalibrationError:
        plain = None
    return find_lens(points, plain, pixel_sigma, ground_sigma_m)[0]


def _first_order(points: ControlPoints, plain: PlaneFit) -> tuple[float, float]:
    """k1 that the errors of a plane show, and its 1-sigma, both to first order."""
    assert points.image_size is not None
    column = k1_column(unit_lens(points.image_size, 0.0), points.pixel[plain.used], plain.whiten)
    q, _ = np.linalg.qr(plain.design)
    rest = column - q @ (q.T @ column)
    square = float(rest @ rest)
    if square <= 0.0:
        return 0.0, np.inf
    return float(rest @ plain.error) / square, square**-0.5


def _least(cost: Callable[[float], float]) -> float | None:
    """Where a cost is smallest: the best of `GRID`, then between its neighbours."""
    found = np.array([cost(k1) for k1 in GRID])
    if not np.isfinite(found).any():
        return None
    at = int(np.argmin(found))
    bounds = GRID[max(at - 1, 0)], GRID[min(at + 1, len(GRID) - 1)]
    finite = [k1 for k1 in bounds if np.isfinite(cost(k1))]
    low, high = min([*finite, GRID[at]]), max([*finite, GRID[at]])
    if low == high:
        return GRID[at]
    best = scipy.optimize.minimize_scalar(
        cost, bounds=(low, high), method="bounded", options={"xatol": TOLERANCE}
    )
    return float(best.x) if best.fun <= found[at] else GRID[at]


def _with_its_focal(
    plane: Homography, size: tuple[int, int], sigma: float
) -> tuple[LensEstimate, Homography]:
    """The lens in units of the focal length that the plane behind it shows."""
    lens = plane.lens
    assert lens is not None
    assert plane.k1_spread is not None
    unit, spread = "the image's width", plane.k1_spread
    try:
        focal = recover_pose(plane, size).focal_px
        gain = (focal / lens.fx) ** 2
        lens, spread, sigma = with_focal(lens, focal), spread * gain, sigma * gain
        unit = f"the focal length, {focal:.0f} px"
    except CalibrationError:
        pass  # k1 in units of the image's width says the same
    text = (
        f"the control points show a lens that bends straight lines: k1 = {lens.k1:.3f} ± "
        f"{sigma:.3f} in units of {unit}; the road is seen through it"
    )
    plane = replace(plane, lens=lens, k1_spread=spread)
    return LensEstimate(lens, lens.k1, sigma, text), plane
