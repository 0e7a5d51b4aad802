"""The ground point whose vehicle explains the four edges of an observed box best."""

from __future__ import annotations

from dataclasses import dataclass

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


EDGE_SIGMA_PX = 1.1
"""1-sigma frame-to-frame noise of one edge of a box: 1.1 px and 1.4 % of the side. Measured at two
cameras on US-12 against parabolas over half a second; centres jitter by 0.7 to 0.9 px where sides
are below 110 px and by 1.3 to 2 px at 200 px, sides by twice that, as independent edges do."""
EDGE_SIGMA_RATIO = 0.014
"""The part of that noise that grows with the side, from the same measurement."""
SHAPE_SIGMA_RATIO = np.array([0.025, 0.10, 0.025, 0.025])
"""What doesn't change from frame to frame, in parts of the side: a detector doesn't draw exactly
where an outline ends, and a roof is shorter and narrower than the footprint, so that the upper
edge (second) is not where a box's would be."""
UNKNOWN_SIDE_PX2 = 1e6
"""Variance of a side that nothing predicts: so large that only the centre of the box counts."""
LEFT_RIGHT, TOP_BOTTOM = np.array([-1.0, 0, 1, 0]), np.array([0, -1.0, 0, 1])
"""How the edges move when a box becomes wider or higher about its centre."""
SIDES = UNKNOWN_SIDE_PX2 * (np.outer(LEFT_RIGHT, LEFT_RIGHT) + np.outer(TOP_BOTTOM, TOP_BOTTOM))
"""Covariance of the edges where the sides are unknown."""
STEPS = 2
"""Each step leaves less than a fifth of the error; the first guess is within metres."""


@dataclass(frozen=True, slots=True)
class VehicleFit:
    """Ground points of one frame's boxes.

    Attributes:
        xy: (M, 2) centre of the footprint, metres.
        first_xy: (M, 2) first guess, from the box's centre and the vehicle's height alone.
        noise: (M, 2, 2) covariance from frame-to-frame noise alone, m^2.
        covariance: (M, 2, 2) with the unknown size and shape of the vehicle, m^2.
        side_px: (M, 2) width and height of the box that the vehicle would have.
        side_slope: (M, 2, 3) their slopes with length, width and height, pixels per metre.
        good: (M,) False where the vehicle would reach behind the camera or beyond the horizon;
            covariances are NaN there and everything else is zero.
    """

    xy: Array
    first_xy: Array
    noise: Array
    covariance: Array
    side_px: Array
    side_slope: Array
    good: NDArray[np.bool_]


def fit_vehicles(
    projection: Array,
    centre: Array,
    side: Array,
    heading: Array,
    size_m: Array,
    size_cov: Array,
    solid: NDArray[np.bool_],
) -> VehicleFit:
    """Maximum a posteriori ground points, given what is known of each vehicle's size.

    Two unknowns, four edges: the edges' covariance is their own noise plus what the uncertain size
    does to them, so that the edges that depend least on it decide. For a car that is the lower
    one, where height doesn't matter; for a truck of unknown length the middle. The equations are
    linear around the first guess, which takes the box's centre for the image of the body's centre
    half its height above the road (Gauss-Newton on normal equations, e.g. Hartley and Zisserman,
    appendix 6).

    A vehicle of unknown heading is taken for an upright stick, of which only the middle counts.

    Args:
        projection: (3, 4) local metres to pixels.
        centre: (M, 2) of the boxes, pixels.
        side: (M, 2) width and height, pixels.
        heading: (M,) radians from east, NaN where unknown.
        size_m: (M, 3) length, width, height.
        size_cov: (M, 3, 3) covariance of `size_m`.
        solid: (M,) False where the pixel already is the ground point.
    """
    shaped = solid & ~np.isnan(heading)
    axes = vehicle_axes(projection, np.where(shaped, heading, 0.0), size_m)
    if not shaped.all():
        axes[~shaped, :, :2] = 0.0
        axes[~solid] = 0.0
    first, ahead = on_plane(projection, centre, np.where(solid, size_m[:, 2] / 2, 0.0))
    uv, depth = corners(projection, first, axes)
    edge, with_position, with_size = edge_slopes(projection, uv, depth, axes, size_m)

    size_error = with_size @ size_cov @ with_size.transpose(0, 2, 1)
    gain, covariance, noise = _solution(side, with_position, size_error, shaped)
    half, xy = side / 2, first
    measured = np.concatenate((centre - half, centre + half), axis=1)
    for step in range(STEPS):
        if step > 0:
            edge = edges(corners(projection, xy, axes)[0])
        xy = xy + (gain * (measured - edge)[:, None, :]).sum(axis=2)
    reached = xy @ projection[2, :2] + projection[2, 3]
    good = (ahead > 0) & (depth.min(axis=1) > 0) & (reached > 0)
    good &= np.isfinite(reached + covariance[:, 0, 0] + covariance[:, 1, 1])
    side_px, side_slope = edge[:, 2:] - edge[:, :2], with_size[:, 2:] - with_size[:, :2]
    found = VehicleFit(xy, first, noise, covariance, side_px, side_slope, good)
    if not good.all():
        _blank(found)
    return found


def _solution(
    side: Array, with_position: Array, size_error: Array, shaped: NDArray[np.bool_]
) -> tuple[Array, Array, Array]:
    """Least squares of two unknowns from four edges.

    Args:
        side: (M, 2) width and height of the boxes, pixels.
        with_position: (M, 4, 2) slopes of the edges with the position.
        size_error: (M, 4, 4) covariance of the edges from the unknown size.
        shaped: (M,) False where only the box's centre counts.

    Returns:
        (M, 2, 4) metres per pixel of each edge; (M, 2, 2) covariance of the position, of all errors
        and of the frame-to-frame noise alone.
    """
    square = np.concatenate((side, side), axis=1) ** 2
    white = EDGE_SIGMA_PX**2 + EDGE_SIGMA_RATIO**2 * square
    spread = size_error.copy()
    spread.reshape(-1, 16)[:, ::5] += white + SHAPE_SIGMA_RATIO**2 * square
    spread[~shaped] += SIDES
    weighted = with_position.transpose(0, 2, 1) @ np.linalg.inv(spread)
    covariance = inverse_2x2(weighted @ with_position)
    gain = covariance @ weighted
    return gain, covariance, (gain * white[:, None, :]) @ gain.transpose(0, 2, 1)


def _blank(fit: VehicleFit) -> None:
    """Replace what came out for vehicles that are not `good`, as `VehicleFit` says."""
    for values in (fit.xy, fit.first_xy, fit.side_px, fit.side_slope):
        values[~fit.good] = 0.0
    for values in (fit.noise, fit.covariance):
        values[~fit.good] = np.nan


def inverse_2x2(matrix: Array) -> Array:
    """Inverses of matrices (M, 2, 2); infinite for singular ones."""
    inverse = np.empty_like(matrix)
    inverse[:, 0, 0], inverse[:, 1, 1] = matrix[:, 1, 1], matrix[:, 0, 0]
    inverse[:, 0, 1], inverse[:, 1, 0] = -matrix[:, 0, 1], -matrix[:, 1, 0]
    determinant = matrix[:, 0, 0] * matrix[:, 1, 1] - matrix[:, 0, 1] * matrix[:, 1, 0]
    return np.asarray(inverse / determinant[:, None, None])
