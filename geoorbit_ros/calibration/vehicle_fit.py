"""The ground point whose vehicle explains the four edges of an observed box best.

Arrays hold their components first and the M vehicles last; see `elementwise`.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from geoorbit_ros.calibration.elementwise import inverse_2x2, solve, through, total
from geoorbit_ros.calibration.lens import Lens

Array = NDArray[np.float64]

CORNER = np.array([[x, y, z] for x in (-0.5, 0.5) for y in (-0.5, 0.5) for z in (0.0, 1.0)]).T
"""(3, 8) corners in units of length, width and height; the origin is the footprint's centre."""
COORDINATE = np.array([0, 1, 0, 1])
"""Left and right edges are columns of the image, top and bottom ones rows."""
ENDS, FLOOR_ROOF = np.array([-0.5, 0.5])[:, None], np.array([0.0, 1.0])[:, None]
"""Where a vehicle's corners are along one of its axes."""


def on_plane(projection: Array, pixel: Array, z_m: Array) -> tuple[Array, Array]:
    """Where the rays of pixels meet horizontal planes.

    Args:
        projection: (3, 4) local metres to pixels.
        pixel: (2, M).
        z_m: (M,) height of each pixel's plane above the road.

    Returns:
        (2, M) metres, and the inverse-depth scale (M,) there, positive in front of the camera; on
        the horizon both are infinite or NaN.
    """
    rays = projection[:2, :, None] - pixel[:, None] * projection[2, :, None]
    (a0, a1), (b0, b1) = rays[:, :2]
    p, q = rays[:, 2] * z_m + rays[:, 3]
    xy = np.empty_like(pixel)
    xy[0], xy[1] = a1 * q - b1 * p, b0 * p - a0 * q
    xy /= a0 * b1 - a1 * b0
    return xy, _inverse_depth(projection, xy) + projection[2, 2] * z_m


def _inverse_depth(projection: Array, xy: Array) -> Array:
    """(M,) third homogeneous coordinate of points (2, M) on the road."""
    return np.asarray(projection[2, 0] * xy[0] + projection[2, 1] * xy[1] + projection[2, 3])


def vehicle_axes(projection: Array, heading: Array) -> Array:
    """Homogeneous images (3, 3, M) of a metre along each vehicle's length, width and height."""
    axes = np.empty((3, 3, len(heading)))
    cos, sin = np.cos(heading), np.sin(heading)
    east, north = projection[:, 0, None], projection[:, 1, None]
    axes[0] = cos * east + sin * north
    axes[1] = cos * north - sin * east
    axes[2] = projection[:, 2, None]
    return axes


def corners(projection: Array, xy: Array, axes: Array) -> tuple[Array, Array]:
    """Pixels (2, 8, M) and depths (8, M) of the corners of vehicles at `xy` (2, M).

    Args:
        projection: (3, 4).
        xy: (2, M) metres.
        axes: (3, 3, M) homogeneous images of the length, width and height.
    """
    number = xy.shape[1]
    base = projection[:, 0, None] * xy[0] + projection[:, 1, None] * xy[1] + projection[:, 3, None]
    rear_front = base[:, None] + ENDS * axes[0][:, None]
    footprint = rear_front[:, :, None] + (ENDS * axes[1][:, None])[:, None]
    every = footprint[:, :, :, None] + (FLOOR_ROOF * axes[2][:, None])[:, None, None]
    uvw = every.reshape(3, 8, number)
    return uvw[:2] / uvw[2], uvw[2]


def edges(uv: Array) -> Array:
    """Left, top, right, bottom (4, M) of the boxes round corners (2, 8, M)."""
    return np.concatenate((uv.min(axis=1), uv.max(axis=1)))


def edge_slopes(
    projection: Array, uv: Array, depth: Array, unit_axes: Array, lens: Lens | None = None
) -> tuple[Array, Array, Array]:
    """How the edges of a vehicle's box move with its position and size.

    An edge moves as the corner that touches it, and a corner with its share of each dimension.

    Args:
        projection: (3, 4).
        uv: (2, 8, M) corners in ideal pixels.
        depth: (8, M) of the corners.
        unit_axes: (3, 3, M) from `vehicle_axes`.
        lens: Through which the box is seen; None: a pinhole.

    Returns:
        Edges (4, M), left, top, right, bottom; their slopes with x and y (4, 2, M); their slopes
        with length, width and height (4, 3, M). Pixels, pixels per metre.
    """
    if lens is not None:
        return _edge_slopes_behind(lens, projection, uv, depth, unit_axes)
    edge, number = edges(uv), uv.shape[2]
    touching = np.concatenate((uv.argmin(axis=1), uv.argmax(axis=1)))
    scale = (1.0 / depth.reshape(-1).take(touching * number + np.arange(number)))[:, None]
    with_position = projection[COORDINATE, :2, None] - edge[:, None] * projection[2, :2, None]
    with_size = unit_axes[:, COORDINATE] - edge * unit_axes[:, 2:]
    with_size *= CORNER.take(touching, axis=1)
    return edge, with_position * scale, with_size.transpose(1, 0, 2) * scale


def _edge_slopes_behind(
    lens: Lens, projection: Array, uv: Array, depth: Array, unit_axes: Array
) -> tuple[Array, Array, Array]:
    """`edge_slopes` where the corners are seen through a lens: its slopes chain with theirs."""
    real, bend = lens.distort_columns(uv)
    edge, number = edges(real), uv.shape[2]
    touching = np.concatenate((real.argmin(axis=1), real.argmax(axis=1)))
    at = touching * number + np.arange(number)
    ideal = uv.reshape(2, -1).take(at, axis=1)
    scale = 1.0 / depth.reshape(-1).take(at)
    bend = bend.reshape(2, 2, -1).take(at, axis=2)
    with_position, with_size = np.empty((4, 2, number)), np.empty((4, 3, number))
    for k, coordinate in enumerate(COORDINATE):
        seen = ideal[:, k, None]
        by_place = projection[:2, :2, None] - seen * projection[2, :2, None]
        by_size = unit_axes[:, :2].transpose(1, 0, 2) - seen * unit_axes[:, 2]
        with_position[k] = through(bend[:, :, k], by_place)[coordinate] * scale[k]
        sized = through(bend[:, :, k], by_size)[coordinate]
        with_size[k] = sized * CORNER.take(touching[k], axis=1) * scale[k]
    return edge, with_position, with_size


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
    """Ground points of boxes.

    Attributes:
        xy: (2, M) centre of the footprint, metres.
        first_xy: (2, M) first guess, from the box's centre and the vehicle's height alone.
        noise: (2, 2, M) covariance from frame-to-frame noise alone, m^2.
        covariance: (2, 2, M) with the unknown size and shape of the vehicle, m^2.
        side_px: (2, M) width and height of the box that the vehicle would have.
        side_slope: (2, 3, M) their slopes with length, width and height, pixels per metre.
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
    lens: Lens | None = None,
) -> VehicleFit:
    """Maximum a posteriori ground points, given what is known of each vehicle's size.

    Two unknowns, four edges: the edges' covariance is their own noise plus what the uncertain size
    does to them, so that the edges that depend least on it decide. For a car that is the lower
    one, where height doesn't matter; for a truck of unknown length the middle. The equations are
    linear around the first guess, which takes the box's centre for the image of the body's centre
    half its height above the road (Gauss-Newton on normal equations, e.g. Hartley and Zisserman,
    appendix 6).

    A vehicle of unknown heading is taken for an upright stick, of which only the middle counts.

    Behind a lens, the box round the corners is as the lens shows them: pixels are real ones.

    Args:
        projection: (3, 4) local metres to pixels.
        centre: (2, M) of the boxes, pixels.
        side: (2, M) width and height, pixels.
        heading: (M,) radians from east, NaN where unknown.
        size_m: (3, M) length, width, height.
        size_cov: (3, 3, M) covariance of `size_m`.
        lens: Through which the boxes are seen; None: a pinhole.
    """
    shaped = ~np.isnan(heading)
    unit = vehicle_axes(projection, np.where(shaped, heading, 0.0))
    if not shaped.all():
        unit[:2, :, ~shaped] = 0.0
    axes = unit * size_m[:, None]
    ray = centre if lens is None else lens.undistort_columns(centre)
    first, ahead = on_plane(projection, ray, size_m[2] / 2)
    uv, depth = corners(projection, first, axes)
    edge, with_position, with_size = edge_slopes(projection, uv, depth, unit, lens)

    gain, covariance, noise = _solution(side, with_position, with_size, size_cov, shaped)
    half, xy = side / 2, first
    measured = np.concatenate((centre - half, centre + half))
    for step in range(STEPS):
        if step > 0:
            uv = corners(projection, xy, axes)[0]
            edge = edges(uv if lens is None else lens.distort_columns(uv)[0])
        xy = xy + total(gain * (measured - edge)[:, None])
    reached = _inverse_depth(projection, xy)
    good = (ahead > 0) & (depth.min(axis=0) > 0) & (reached > 0)
    good &= np.isfinite(reached + covariance[0, 0] + covariance[1, 1])
    if lens is not None:
        good &= np.isfinite(xy[0] + xy[1])
    side_px, side_slope = edge[2:] - edge[:2], with_size[2:] - with_size[:2]
    found = VehicleFit(xy, first, noise, covariance, side_px, side_slope, good)
    if not good.all():
        _blank(found)
    return found


def fit_points(
    projection: Array, pixel: Array, side: Array, lens: Lens | None = None
) -> VehicleFit:
    """Ground points of pixels that already show the road, as exact as the middle of a box.

    Args:
        projection: (3, 4) local metres to pixels.
        pixel: (2, M).
        side: (2, M) width and height of what was seen there, pixels; zero where it isn't known.
        lens: Through which they are seen; None: a pinhole.
    """
    number = pixel.shape[1]
    ideal = pixel if lens is None else lens.undistort_columns(pixel)
    xy, depth = on_plane(projection, ideal, np.zeros(number))
    slope = (projection[:2, :2, None] - ideal[:, None] * projection[2, :2, None]) / depth
    if lens is not None:
        slope = through(lens.distort_columns(ideal)[1], slope)
    by_pixel = inverse_2x2(slope).transpose(1, 0, 2)
    variance = (EDGE_SIGMA_PX**2 + EDGE_SIGMA_RATIO**2 * side**2) / 2
    noise = total((by_pixel * variance[:, None])[:, :, None] * by_pixel[:, None])
    good = (depth > 0) & np.isfinite(noise[0, 0] + noise[1, 1])
    nothing, no_slope = np.zeros((2, number)), np.zeros((2, 3, number))
    found = VehicleFit(xy, xy, noise, noise, nothing, no_slope, good)
    if not good.all():
        _blank(found)
    return found


def _solution(
    side: Array, with_position: Array, with_size: Array, size_cov: Array, shaped: NDArray[np.bool_]
) -> tuple[Array, Array, Array]:
    """Least squares of two unknowns from four edges.

    Args:
        side: (2, M) width and height of the boxes, pixels.
        with_position: (4, 2, M) slopes of the edges with the position.
        with_size: (4, 3, M) slopes of the edges with the size.
        size_cov: (3, 3, M) covariance of the size.
        shaped: (M,) False where only the box's centre counts.

    Returns:
        (4, 2, M) metres per pixel of each edge; (2, 2, M) covariance of the position, of all errors
        and of the frame-to-frame noise alone.
    """
    square = np.concatenate((side, side)) ** 2
    white = EDGE_SIGMA_PX**2 + EDGE_SIGMA_RATIO**2 * square
    by_size = total(with_size.transpose(1, 0, 2)[:, :, None] * size_cov[:, None])
    spread = total(by_size.transpose(1, 0, 2)[:, :, None] * with_size.transpose(1, 0, 2)[:, None])
    spread.reshape(16, -1)[::5] += white + SHAPE_SIGMA_RATIO[:, None] ** 2 * square
    if not shaped.all():
        spread[:, :, ~shaped] += SIDES[:, :, None]
    weighted = solve(spread, with_position)
    covariance = inverse_2x2(total(weighted[:, :, None] * with_position[:, None]))
    gain = weighted[:, :1] * covariance[0] + weighted[:, 1:] * covariance[1]
    noise = total((gain * white[:, None])[:, :, None] * gain[:, None])
    return gain, covariance, noise


def _blank(fit: VehicleFit) -> None:
    """Replace what came out for vehicles that are not `good`, as `VehicleFit` says."""
    for values in (fit.xy, fit.first_xy, fit.side_px, fit.side_slope):
        values[..., ~fit.good] = 0.0
    for values in (fit.noise, fit.covariance):
        values[..., ~fit.good] = np.nan
