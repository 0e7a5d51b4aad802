"""Where the camera stands and how it maps points above the road, from the road plane alone."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

from geoorbit_ros.calibration.lens import Lens
from geoorbit_ros.calibration.plane import Homography
from geoorbit_ros.core.errors import CalibrationError

Matrix = NDArray[np.float64]

HEIGHT_M = (3.0, 100.0)
"""Roadside poles are 5 to 25 m, bridges and towers up to 100 m."""
FOCAL_WIDTHS = (0.2, 20.0)
"""Focal length over image width: 136 degrees wide to 3 degrees, rectilinear lenses and zooms."""
MAX_RELATIVE_SIGMA = 0.5
"""A focal length less certain than this says nothing about heights. Chosen: larger uses wrong
heights, smaller leaves cameras without a pose."""
MAX_SKEW = 0.15
"""How far the road's axes may be from perpendicular and equally long. A principal point 10 % of
the image's width off its centre makes 0.07, an image of another size 0.2 and more; control points
with the errors of a survey stay below 0.06."""


@dataclass(frozen=True, slots=True)
class CameraPose:
    """A camera above the road.

    Attributes:
        projection: (3, 4) float64, homogeneous local metres (x, y, z above the road, 1) to
            homogeneous ideal pixels, the third component positive in front of the camera. Its
            columns 1, 2 and 4 are the inverse homography, so that road points agree exactly.
        position_m: (3,) optical centre, metres east, north and above the road.
        rotation: (3, 3) map frame to optical frame (REP-103: x right, y down, z forward).
        focal_px: Focal length in pixels.
        focal_sigma_px: 1-sigma error of `focal_px` that the control points leave; 0 where the
            focal length is given.
        lens: From ideal pixels to those of the images; None: the same.
    """

    projection: Matrix
    position_m: Matrix
    rotation: Matrix
    focal_px: float
    focal_sigma_px: float
    lens: Lens | None = None

    def project(self, points_m: ArrayLike) -> Matrix:
        """Pixels (N, 2) of points (N, 3) in local metres; NaN behind the camera."""
        xyz = np.asarray(points_m, dtype=np.float64).reshape(-1, 3)
        uvw = xyz @ self.projection[:, :3].T + self.projection[:, 3]
        with np.errstate(divide="ignore", invalid="ignore"):
            pixel = np.where(uvw[:, 2:] > 0, uvw[:, :2] / uvw[:, 2:], np.nan)
            return pixel if self.lens is None else self.lens.distort(pixel)


def recover_pose(
    homography: Homography, image_size: tuple[int, int], max_skew: float = MAX_SKEW
) -> CameraPose:
    """Recover focal length and pose, assuming square pixels and a centred principal point.

    Where the plane's lens says its principal point, and its focal length, these are taken instead,
    unless the road doesn't fit them at all (`plausibility` says so).
    Otherwise, the images of the road's two axes are perpendicular and of equal length in space,
    which gives two linear equations for 1/f^2 (Zhang (2000), A Flexible New Technique for Camera
    Calibration, equations 3 and 4). Their least-squares solution does not depend on where east is.

    Args:
        homography: The road plane.
        image_size: (width, height) in pixels of the images the control points were clicked in.
        max_skew: How far the road's axes may be from perpendicular and equally long.

    Raises:
        CalibrationError: The plane fixes no focal length (a camera looking straight down), or an
            implausible one, or a camera at an implausible height. The sentence says which.
    """
    place = f"camera pose from {homography.points.place}"
    lens = homography.lens
    if lens is not None and lens.focal_known:
        pose, skew = _pose(homography, _camera_matrix(homography, image_size, lens.fx), 0.0)
        if skew <= max_skew:
            return _checked(pose, skew, max_skew, image_size, place)
    axis = _camera_matrix(homography, image_size, 1.0)
    focal = _focal_length(homography.matrix, axis)
    if not np.isfinite(focal):
        raise CalibrationError(
            place,
            "a road plane that fits no focal length",
            f"a pinhole camera with the centre of a {image_size[0]}x{image_size[1]} image "
            "on its axis, looking at the road at a slant",
        )
    changed = [_focal_length(homography.matrix + d, axis) for d in homography.spread]
    sigma = float(np.sqrt(np.square(np.subtract(changed, focal)).sum()))
    if not sigma <= MAX_RELATIVE_SIGMA * focal:
        raise CalibrationError(
            place,
            f"a focal length of {focal:.0f} ± {sigma:.0f} px",
            "control points that fix it to 50 %: more of them, wider apart",
        )
    low, high = (factor * image_size[0] for factor in FOCAL_WIDTHS)
    if not low <= focal <= high:
        raise CalibrationError(
            place, f"a focal length of {focal:.0f} px", f"{low:.0f} to {high:.0f} px"
        )
    pose, skew = _pose(homography, _camera_matrix(homography, image_size, focal), sigma)
    return _checked(pose, skew, max_skew, image_size, place)


def _checked(
    pose: CameraPose, skew: float, max_skew: float, image_size: tuple[int, int], place: str
) -> CameraPose:
    """The pose, where it can be one."""
    if skew > max_skew:
        raise CalibrationError(
            place,
            f"a road whose axes are distorted by {100 * skew:.0f} %",
            f"at most {100 * max_skew:.0f} %: are the images really {image_size[0]}x"
            f"{image_size[1]}, of a camera without lens distortion?",
        )
    if not HEIGHT_M[0] <= pose.position_m[2] <= HEIGHT_M[1]:
        raise CalibrationError(
            place,
            f"a camera {pose.position_m[2]:.1f} m above the road",
            f"{HEIGHT_M[0]:g} to {HEIGHT_M[1]:g} m",
        )
    return pose


def _camera_matrix(homography: Homography, image_size: tuple[int, int], focal: float) -> Matrix:
    """From rays to ideal pixels, (3, 3): the lens' own, else with the image's centre on the axis.

    Pixel centres have whole coordinates or halves, depending on who clicked: half a pixel is far
    below what a principal point is off.
    """
    lens = homography.lens
    if lens is None:
        return np.array([[focal, 0, image_size[0] / 2], [0, focal, image_size[1] / 2], [0, 0, 1]])
    return np.array([[focal, 0, lens.cx], [0, focal * lens.fy / lens.fx, lens.cy], [0, 0, 1]])


def _focal_length(matrix: Matrix, axis: Matrix) -> float:
    """Focal length in pixels, NaN where 1/f^2 comes out at zero or below.

    Args:
        matrix: (3, 3) ideal pixels to road.
        axis: (3, 3) camera matrix with a focal length of one.
    """
    a, b = (np.linalg.inv(axis) @ np.linalg.inv(matrix)).T[:2]
    # The image of a slanted plane scales the focal length out of these two products:
    # a.b = 0 and (a.a - b.b) / 2 = 0 with the metric diag(1/f^2, 1/f^2, 1).
    plane = np.array([a[0] * b[0] + a[1] * b[1], (a[:2] @ a[:2] - b[:2] @ b[:2]) / 2])
    depth = np.array([a[2] * b[2], (a[2] ** 2 - b[2] ** 2) / 2])
    # Solved for f^2, in which the errors of noisy control points are closer to linear.
    with np.errstate(divide="ignore", invalid="ignore"):
        return float(np.sqrt(-(plane @ depth) / (depth @ depth)))


def _pose(homography: Homography, camera: Matrix, sigma: float) -> tuple[CameraPose, float]:
    """The pose, and how far the road's axes are from perpendicular and equally long in it."""
    columns = np.linalg.inv(camera) @ np.linalg.inv(homography.matrix)
    # The inverse homography has positive depth at the control points, hence in front.
    scale = (np.linalg.norm(columns[:, 0]) + np.linalg.norm(columns[:, 1])) / 2
    r1, r2 = columns[:, 0] / scale, columns[:, 1] / scale
    skew = float(np.hypot(r1 @ r2, (r1 @ r1 - r2 @ r2) / 2))
    u, _, vt = np.linalg.svd(np.column_stack((r1, r2, np.cross(r1, r2))))
    rotation = u @ vt
    position = -rotation.T @ (columns[:, 2] / scale)
    up = camera @ rotation[:, 2] * scale
    g = homography.inverse
    projection = np.column_stack((g[:, 0], g[:, 1], up, g[:, 2]))
    lens = homography.lens
    return CameraPose(projection, position, rotation, float(camera[0, 0]), sigma, lens), skew
