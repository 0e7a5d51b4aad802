"""The part of the road that a camera sees well enough, as a polygon on the ground."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from geoorbit_ros.calibration.plane import Homography
from geoorbit_ros.roadnet.errors import RoadNetworkError

PIXEL_SIGMA = 1.5
MAX_SIGMA_M = 2.0
"""Beyond, one and a half pixels are more than half a lane along the line of sight."""
BORDER_SHARE = 0.01
"""Boxes cut by the image border are not used (`calibration.box_projector`)."""
COLUMNS, ROWS = 33, 200


def view_polygon(
    homography: Homography, image_size: tuple[int, int], max_sigma_m: float = MAX_SIGMA_M
) -> NDArray[np.float64]:
    """(V, 2) corners in the map frame of what the camera sees, counter-clockwise or clockwise.

    Its near side is the lower border of the image, its far side where a pixel error of
    `PIXEL_SIGMA` becomes `max_sigma_m` on the ground.

    Raises:
        RoadNetworkError: No part of the road is seen that well.
    """
    width, height = image_size
    margin_x, margin_y = BORDER_SHARE * width, BORDER_SHARE * height
    rows = np.linspace(height - margin_y, margin_y, ROWS)
    near, far = [], []
    for x in np.linspace(margin_x, width - margin_x, COLUMNS):
        pixel = np.column_stack((np.full(ROWS, x), rows))
        with np.errstate(divide="ignore", invalid="ignore", over="ignore"):
            good = homography.visible(pixel) & (
                homography.sigma_m(pixel, PIXEL_SIGMA) <= max_sigma_m
            )
        count = ROWS if good.all() else int(np.argmin(good))
        if count > 1:
            near.append(pixel[0])
            far.append(pixel[count - 1])
    if len(near) < 2:
        found = f"no ground with errors up to {max_sigma_m:g} m in a {width}x{height} image"
        raise RoadNetworkError("camera's view", found, "a camera that looks at the road")
    return np.asarray(homography.to_ground(np.array(near + far[::-1])), dtype=np.float64)


def inside(point_m: NDArray[np.float64], polygon_m: NDArray[np.float64]) -> NDArray[np.bool_]:
    """(N,) whether points (N, 2) lie in a polygon (V, 2), by the even-odd rule."""
    x, y = point_m[:, :1], point_m[:, 1:]
    x0, y0 = polygon_m.T
    x1, y1 = np.roll(x0, -1), np.roll(y0, -1)
    crosses = (y0 > y) != (y1 > y)
    with np.errstate(divide="ignore", invalid="ignore"):
        at = x0 + (y - y0) * (x1 - x0) / (y1 - y0)
    return np.asarray(np.count_nonzero(crosses & (x < at), axis=1) % 2 == 1)
