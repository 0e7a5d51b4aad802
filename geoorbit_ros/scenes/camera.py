"""A camera on a pole over flat ground: square pixels, principal point in the middle, a lens."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from geoorbit_ros.calibration.lens import Lens


@dataclass(frozen=True)
class PinholeCamera:
    """Projection of map points (ENU, metres above the road) to pixels.

    Attributes:
        matrix: (3, 4), homogeneous map point to homogeneous ideal pixel.
        centre_m: (3,) the camera's place.
        focal_px: Focal length.
        image_size: Width and height.
        lens: From ideal pixels to those of the image; None: the same.
    """

    matrix: NDArray[np.float64]
    centre_m: NDArray[np.float64]
    focal_px: float
    image_size: tuple[int, int]
    lens: Lens | None = None

    def project(
        self, points_m: NDArray[np.float64]
    ) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """Pixels (..., 2) and depths (...,) of points (..., 3); behind the camera depth <= 0.

        NaN where none is seen: behind the camera, or beyond what the lens shows.
        """
        homogeneous = points_m @ self.matrix[:, :3].T + self.matrix[:, 3]
        depth = homogeneous[..., 2]
        safe = np.where(depth > 0.1, depth, np.nan)
        pixel = homogeneous[..., :2] / safe[..., None]
        return pixel if self.lens is None else self.lens.distort(pixel), depth

    def ground_sigma_m(
        self, ground_m: NDArray[np.float64], pixel_sigma: float
    ) -> NDArray[np.float64]:
        """(N,) largest 1-sigma ground error of points (N, 2) for an isotropic pixel error."""
        plane = self.matrix[:, [0, 1, 3]]
        homogeneous = np.column_stack([ground_m, np.ones(len(ground_m))]) @ plane.T
        u, v = homogeneous[:, 0] / homogeneous[:, 2], homogeneous[:, 1] / homogeneous[:, 2]
        rows = [(plane[k, :2] - w[:, None] * plane[2, :2]) for k, w in ((0, u), (1, v))]
        jacobian = np.stack(rows, axis=1) / homogeneous[:, 2, None, None]
        if self.lens is not None:
            jacobian = self.lens.slope(np.column_stack([u, v])) @ jacobian
        smallest = np.linalg.svd(jacobian, compute_uv=False)[:, -1]
        return np.asarray(pixel_sigma / smallest)


def look_at(
    centre_m: NDArray[np.float64],
    target_m: NDArray[np.float64],
    horizontal_fov_deg: float,
    image_size: tuple[int, int],
    k1: float = 0.0,
    k2: float = 0.0,
) -> PinholeCamera:
    """Camera at `centre_m` (3,) whose image has `target_m` (3,) in its middle and no roll.

    Args:
        centre_m: (3,) its place.
        target_m: (3,) what it looks at.
        horizontal_fov_deg: Field of view without distortion: it says the focal length.
        image_size: Width and height.
        k1: First radial coefficient of its lens.
        k2: Second one.
    """
    forward = target_m - centre_m
    forward = forward / np.linalg.norm(forward)
    right = np.cross(forward, [0.0, 0.0, 1.0])
    right /= np.linalg.norm(right)
    down = np.cross(forward, right)
    rotation = np.vstack([right, down, forward])
    focal = 0.5 * image_size[0] / np.tan(np.radians(0.5 * horizontal_fov_deg))
    intrinsics = np.array(
        [[focal, 0.0, 0.5 * image_size[0]], [0.0, focal, 0.5 * image_size[1]], [0.0, 0.0, 1.0]]
    )
    matrix = intrinsics @ np.column_stack([rotation, -rotation @ centre_m])
    lens = scene_lens(horizontal_fov_deg, image_size, k1, k2) if k1 or k2 else None
    return PinholeCamera(matrix, centre_m, float(focal), image_size, lens)


def scene_lens(
    horizontal_fov_deg: float, image_size: tuple[int, int], k1: float, k2: float
) -> Lens:
    """The lens of a scene's camera; see `look_at`."""
    width, height = image_size
    focal = float(0.5 * width / np.tan(np.radians(0.5 * horizontal_fov_deg)))
    return Lens(focal, focal, 0.5 * width, 0.5 * height, image_size, k1, k2)


def body_corners(
    xy: NDArray[np.float64], heading: NDArray[np.float64], size: NDArray[np.float64]
) -> NDArray[np.float64]:
    """(N, 8, 3) corners of upright boxes.

    Args:
        xy: (N, 2) middle of the footprint.
        heading: (N,) radians counter-clockwise from east.
        size: (N, 3) length, width, height.
    """
    signs = np.array([[a, b, c] for a in (-0.5, 0.5) for b in (-0.5, 0.5) for c in (0.0, 1.0)])
    local = signs[None] * size[:, None, :]
    cos, sin = np.cos(heading)[:, None], np.sin(heading)[:, None]
    return np.stack(
        [
            xy[:, :1] + local[..., 0] * cos - local[..., 1] * sin,
            xy[:, 1:] + local[..., 0] * sin + local[..., 1] * cos,
            local[..., 2],
        ],
        axis=2,
    )
