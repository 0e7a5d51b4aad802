"""A camera found from traffic, as control points: what every other command reads."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import scipy
from numpy.typing import NDArray

from geoorbit_ros.calibration.camera_facts import MAX_SCALE_SIGMA, CameraFacts
from geoorbit_ros.calibration.control_points import ControlPoints
from geoorbit_ros.calibration.datum import Datum
from geoorbit_ros.calibration.homography import fit_homography
from geoorbit_ros.calibration.lens import Lens
from geoorbit_ros.calibration.traffic.estimate import TrafficCalibration
from geoorbit_ros.calibration.traffic.parameters import MANY, PLACE, YAW, projection_matrix

Array = NDArray[np.float64]

GRID = (6, 5)
"""Columns and rows of points over the part of the image where vehicles drove. Chosen: enough that
a person sees the plane; they are exact, so that more would say nothing more."""
TRAFFIC_SHARE = 0.02
"""The part goes from this quantile of the vehicles' places to the same from the other end: single
vehicles far out don't count."""
PIXEL_SIGMA = 0.1
"""1-sigma of the points' pixels: they are computed. What the camera may be off is in metres."""
ROUNDS = 3
"""Times that the points' errors are set so that a plane through them has the camera's."""


def control_grid(
    found: TrafficCalibration, datum: Datum | None = None, place: str = "traffic"
) -> ControlPoints:
    """Points of the road with their pixels, over the part where vehicles drove.

    Without known points, the frame begins on the ground below the camera, x is to the right and y
    ahead, so that "north" is where the camera looks.

    Args:
        found: The camera.
        datum: Where the frame's origin is on Earth; None: nobody knows.
        place: For messages.
    """
    ideal = _grid(found)
    pixel = ideal if found.lens is None else found.lens.distort(ideal)
    good = np.isfinite(pixel).all(axis=1)
    ideal, pixel = ideal[good], pixel[good]
    local = _ground(found.x, found.image_size, ideal)
    shifts = _shape_shifts(found, ideal, local)
    wanted = np.sqrt((shifts**2).sum(axis=(0, 2)) / 2.0) + 1e-3
    scale = min(scale_sigma(found), 0.99 * MAX_SCALE_SIGMA)
    focal, (width, height) = found.focal_px[0], found.image_size
    lens = found.lens or Lens(focal, focal, width / 2, height / 2, found.image_size)
    facts = CameraFacts(found.image_size, replace(lens, focal_known=True), scale)
    sigma_px = np.full(len(pixel), PIXEL_SIGMA)
    points = ControlPoints(
        pixel, local, datum, np.arange(len(pixel)) + 2, place,
        facts=facts, image_size=found.image_size, sigma_px=sigma_px, sigma_m=wanted,
    )  # fmt: skip
    for _ in range(ROUNDS):
        assert points.sigma_m is not None
        covariance = fit_homography(points).fit_covariance(pixel)
        got = np.sqrt(np.trace(covariance, axis1=1, axis2=2) / 2.0)
        common = scale * np.hypot(*(local - local.mean(axis=0)).T) / np.sqrt(2.0)
        ratio = np.median(np.hypot(wanted, common) / np.maximum(got, 1e-9))
        points = replace(points, sigma_m=points.sigma_m * float(np.clip(ratio, 0.2, 20.0)))
    return points


def scale_sigma(found: TrafficCalibration) -> float:
    """Relative 1-sigma error of distances between the vehicles' places, common to all."""
    ideal = _grid(found)
    local = _ground(found.x, found.image_size, ideal)
    size = np.linalg.norm(local - local.mean(axis=0))
    slopes = [
        (np.linalg.norm(moved - moved.mean(axis=0)) / size - 1.0)
        for moved in _moved(found, ideal, local)
    ]
    return float(np.sqrt(np.square(slopes).sum()))


def _grid(found: TrafficCalibration) -> Array:
    """(N, 2) ideal pixels within the vehicles' footprints' hull."""
    fit = found.model.explain(found.x, 2).fit
    uvw = found.projection[:, [0, 1, 3]] @ np.vstack((fit.xy, np.ones(fit.xy.shape[1])))
    seen = (uvw[:2] / uvw[2]).T[fit.good & (uvw[2] > 0)]
    low, high = np.quantile(seen, [TRAFFIC_SHARE, 1.0 - TRAFFIC_SHARE], axis=0)
    seen = seen[((seen >= low) & (seen <= high)).all(axis=1)]
    corners = seen[scipy.spatial.ConvexHull(seen, qhull_options="QJ").vertices]
    columns, rows = (np.linspace(low[k], high[k], GRID[k]) for k in (0, 1))
    grid = np.stack(np.meshgrid(columns, rows), axis=-1).reshape(-1, 2)
    inside = scipy.spatial.Delaunay(corners, qhull_options="QJ").find_simplex(grid) >= 0
    return np.concatenate((corners[:: max(1, len(corners) // 8)], grid[inside]))


def _ground(x: Array, image_size: tuple[int, int], ideal: Array) -> Array:
    """(N, 2) metres of ideal pixels, in the frame of the known points where there are some."""
    matrix = projection_matrix(x, image_size)[:, [0, 1, 3]]
    ground = np.linalg.solve(matrix, np.column_stack((ideal, np.ones(len(ideal)))).T)
    xy = (ground[:2] / ground[2]).T
    if len(x) < MANY:
        return np.asarray(xy)
    cos, sin = np.cos(x[YAW]), np.sin(x[YAW])
    return np.asarray(xy @ np.array([[cos, sin], [-sin, cos]]) + x[PLACE])


def _moved(found: TrafficCalibration, ideal: Array, local: Array) -> list[Array]:
    """The points for a 1-sigma step along each independent error of the camera."""
    value, vector = np.linalg.eigh(found.covariance)
    steps = vector * np.sqrt(np.maximum(value, 0.0))
    small = 0.05
    moved = []
    for step in steps.T:
        slope = (_ground(found.x + small * step, found.image_size, ideal) - local) / small
        moved.append(local + slope)
    return moved


def _shape_shifts(found: TrafficCalibration, ideal: Array, local: Array) -> Array:
    """(P, N, 2) metres by which independent errors move points, but for all of them together.

    A shift and a turn of all points are the frame's business, and a common scale has its own line
    in the file.
    """
    centred = local - local.mean(axis=0)
    turned = centred @ np.array([[0.0, 1.0], [-1.0, 0.0]])
    square = float((centred**2).sum())
    shifts = []
    for moved in _moved(found, ideal, local):
        off = (moved - moved.mean(axis=0)) - centred
        off -= centred * (off * centred).sum() / square
        off -= turned * (off * turned).sum() / square
        shifts.append(off)
    return np.array(shifts)
