"""Fits the road plane to control points, and to the lens before them where they show one."""

from __future__ import annotations

from dataclasses import replace

from geoorbit_ros.calibration.control_point_file import of_images
from geoorbit_ros.calibration.control_points import ControlPoints, check_points
from geoorbit_ros.calibration.lens_from_points import find_lens, shows_lens
from geoorbit_ros.calibration.plane import ControlResidual, Homography
from geoorbit_ros.calibration.plane_fit import GROUND_SIGMA_M, PIXEL_SIGMA, fit_plane
from geoorbit_ros.core.errors import CalibrationError
from geoorbit_ros.core.input_report import Remark, Treatment

__all__ = [
    "GROUND_SIGMA_M",
    "PIXEL_SIGMA",
    "ControlResidual",
    "Homography",
    "fit_homography",
    "plane_of_images",
]


def plane_of_images(plane: Homography, image_size: tuple[int, int]) -> Homography:
    """The road plane in pixels of the camera's images, once these are seen.

    Fitted anew where the control points are of images of another size, or where nobody has said
    their size yet.

    Raises:
        CalibrationError: As `of_images` and `fit_homography`.
    """
    points = plane.points
    if points.image_size == image_size:
        return plane
    return fit_homography(of_images(points, image_size))


def fit_homography(
    points: ControlPoints,
    pixel_sigma: float = PIXEL_SIGMA,
    ground_sigma_m: float = GROUND_SIGMA_M,
) -> Homography:
    """Fit the road plane in local metres, float64; see `plane_fit.fit_plane`.

    A lens that the points' file names is taken for exact. Without one, points that are explained
    far better through a lens are fitted through it (`lens_from_points`), and `remarks` says so.

    Args:
        points: At least four, in any order; the result does not depend on it.
        pixel_sigma: Expected 1-sigma of a clicked pixel, where the points don't say it.
        ground_sigma_m: Expected 1-sigma of a surveyed position, likewise.

    Raises:
        CalibrationError: The points fix no plane, don't agree on one, or show it mirrored, which
            is what swapped columns do.
    """
    check_points(points)
    sigmas = pixel_sigma, ground_sigma_m
    lens = points.facts.lens
    if lens is not None:
        return fit_plane(points, lens, *sigmas).homography
    try:
        plain = fit_plane(points, None, *sigmas)
    except CalibrationError:
        estimate, behind = find_lens(points, None, *sigmas)
        if behind is None:
            raise
    else:
        if not shows_lens(points, plain):
            return plain.homography
        estimate, behind = find_lens(points, plain, *sigmas)
        if behind is None:
            return plain.homography
    return replace(behind, remarks=(Remark(Treatment.NOTED, 0, estimate.sentence),))
