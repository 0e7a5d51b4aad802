"""The projective geometry between a vehicle on the road and its box in the image."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]

CORNER = np.array([[x, y, z] for x in (-0.5, 0.5) for y in (-0.5, 0.5) for z in (0.0, 1.0)])
"""The eight corners in units of length, width and height; the origin is the footprint's centre."""
COORDINATE = np.array([0, 1, 0, 1])
"""Left and right edges are columns of the image, top and bottom ones rows."""


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
    """Homogeneous images (M, 3, 3) of each vehicle's length, width and height, one per column."""
    axes = np.empty((len(heading), 3, 3))
    cos, sin = np.cos(heading)[:, None], np.sin(heading)[:, None]
    east, north, up = projection[:, 0], projection[:, 1], projection[:, 2]
    axes[:, :, 0] = cos * east + sin * north
    axes[:, :, 1] = cos * north - sin * east
    axes[:, :, 2] = up
    axes *= size_m[:, None, :]
    return axes


def corners(projection: Array, xy: Array, axes: Array) -> tuple[Array, Array]:
    """Pixels (M, 2, 8) and depths (M, 8) of the corners of vehicles at `xy` (M, 2)."""
    base = xy @ projection[:, :2].T + projection[:, 3]
    uvw = (axes.reshape(-1, 3) @ CORNER.T).reshape(-1, 3, 8) + base[:, :, None]
    return uvw[:, :2] / uvw[:, 2:], uvw[:, 2]


def edges(uv: Array) -> Array:
    """Left, top, right, bottom (M, 4) of the boxes round corners (M, 2, 8)."""
    return np.concatenate((uv.min(axis=2), uv.max(axis=2)), axis=1)


def edge_slopes(
    projection: Array, uv: Array, depth: Array, axes: Array, size_m: Array
) -> tuple[Array, Array, Array]:
    """How the edges of a vehicle's box move with its position and size.

    An edge moves as the corner that touches it, and a corner with its share of each dimension.

    Args:
        projection: (3, 4).
        uv: (M, 2, 8) corners in pixels.
        depth: (M, 8) of the corners.
        axes: (M, 3, 3) from `vehicle_axes`.
        size_m: (M, 3) length, width, height that `axes` were made with.

    Returns:
        Edges (M, 4), left, top, right, bottom; their slopes with x and y (M, 4, 2); their slopes
        with length, width and height (M, 4, 3). Pixels, pixels per metre.
    """
    touching = np.concatenate((uv.argmin(axis=2), uv.argmax(axis=2)), axis=1)
    row = np.arange(len(uv))[:, None]
    edge = uv[row, COORDINATE, touching]
    scale = 1.0 / depth[row, touching][:, :, None]
    moved = axes[:, COORDINATE] - edge[:, :, None] * axes[:, 2:]
    with_position = projection[COORDINATE, :2] - edge[:, :, None] * projection[2, :2]
    with_size = CORNER[touching] * moved / size_m[:, None, :]
    return edge, with_position * scale, with_size * scale
