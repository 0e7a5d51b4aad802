"""The projective geometry between a vehicle on the road and its box in the image."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]

CORNER = np.array([[x, y, z] for x in (-0.5, 0.5) for y in (-0.5, 0.5) for z in (0.0, 1.0)])
"""The eight corners in units of length, width and height; the origin is the footprint's centre."""


def on_plane(projection: Array, pixel: Array, z_m: Array) -> tuple[Array, Array]:
    """Where the rays of pixels meet horizontal planes.

    Args:
        projection: (3, 4) local metres to pixels.
        pixel: (M, 2).
        z_m: (M,) height of each pixel's plane above the road.

    Returns:
        (M, 2) metres, and the inverse-depth scale (M,) there, positive in front of the camera; on
        the horizon both are infinite or NaN.
    """
    a = projection[0] - pixel[:, :1] * projection[2]
    b = projection[1] - pixel[:, 1:] * projection[2]
    p, q = a[:, 2] * z_m + a[:, 3], b[:, 2] * z_m + b[:, 3]
    det = a[:, 0] * b[:, 1] - a[:, 1] * b[:, 0]
    xy = np.empty((len(pixel), 2))
    xy[:, 0] = (a[:, 1] * q - b[:, 1] * p) / det
    xy[:, 1] = (b[:, 0] * p - a[:, 0] * q) / det
    depth = xy @ projection[2, :2] + projection[2, 2] * z_m + projection[2, 3]
    return xy, depth


def vehicle_axes(projection: Array, heading: Array, size_m: Array) -> Array:
    """Homogeneous image (M, 3, 3) of the vectors length, width and height of each vehicle."""
    axes = np.empty((len(heading), 3, 3))
    cos, sin = np.cos(heading)[:, None], np.sin(heading)[:, None]
    east, north, up = projection[:, 0], projection[:, 1], projection[:, 2]
    axes[:, 0] = cos * east + sin * north
    axes[:, 1] = cos * north - sin * east
    axes[:, 2] = up
    return np.asarray(axes * size_m[:, :, None])


def corners(projection: Array, xy: Array, axes: Array) -> tuple[Array, Array]:
    """Pixels (M, 8, 2) and depths (M, 8) of the corners of vehicles at `xy` (M, 2)."""
    base = xy @ projection[:, :2].T + projection[:, 3]
    uvw = CORNER @ axes + base[:, None, :]
    return uvw[..., :2] / uvw[..., 2:], uvw[..., 2]


def box_of_vehicle(uv: Array, depth: Array, axes: Array, size_m: Array) -> tuple[Array, Array]:
    """Sides of the box round the corners and their slope with the vehicle's size.

    Args:
        uv: (M, 8, 2) corners in pixels.
        depth: (M, 8) of the corners.
        axes: (M, 3, 3) from `vehicle_axes`.
        size_m: (M, 3) length, width, height.

    Returns:
        (M, 2) width and height in pixels and (M, 2, 3) their derivatives by length, width and
        height. A corner that bounds the box moves by its own share of each dimension.
    """
    row, column = np.arange(len(uv))[:, None], np.arange(2)
    side_of = axes[:, :, :2].transpose(0, 2, 1)
    sides, slope = np.zeros((len(uv), 2)), np.zeros((len(uv), 2, 3))
    for sign, extreme in ((1.0, np.argmax(uv, axis=1)), (-1.0, np.argmin(uv, axis=1))):
        edge = uv[row, extreme, column]
        moved = side_of - edge[:, :, None] * axes[:, None, :, 2]
        share = CORNER[extreme] / (depth[row, extreme][:, :, None] * size_m[:, None, :])
        sides += sign * edge
        slope += sign * moved * share
    return sides, slope
