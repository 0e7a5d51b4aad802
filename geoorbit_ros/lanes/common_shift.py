"""By how much a whole line may lie aside: the error of the calibration, which no traffic averages.

Vehicles err one by one, and over many of them that averages out: `Lane.sigma_m`. The control points
err once, and the line lies aside with them for as long as the calibration is used.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from geoorbit_ros.calibration.plane import RoadPlane
from geoorbit_ros.core.lanes import Lane, LaneMap

Array = NDArray[np.float64]


def shift_sigma_m(line_m: Array, plane: RoadPlane) -> float:
    """1-sigma of the sideways shift of a line (N, 2), in the mean over its length.

    Each independent error of the fit moves the line's points together (`RoadPlane.fit_shifts`); the
    mean of what it does across the line counts, and independent errors add as squares. It holds
    what `plane.spread` holds: control points, their common scale, and the lens fitted with them.

    Returns:
        NaN where the camera sees none of the line.
    """
    step = np.diff(line_m, axis=0)
    length = np.hypot(step[:, 0], step[:, 1])
    weight = 0.5 * (np.append(length, 0.0) + np.append(0.0, length))
    along = np.gradient(line_m, axis=0)
    across = np.column_stack([-along[:, 1], along[:, 0]])
    across /= np.maximum(np.hypot(across[:, 0], across[:, 1]), 1e-12)[:, None]
    pixel = plane.to_pixel(line_m)
    seen = np.isfinite(pixel).all(axis=1) & (weight > 0.0)
    if not seen.any():
        return float("nan")
    sideways = np.einsum("nd,nkd->nk", across[seen], plane.fit_shifts(pixel[seen]))
    return float(np.linalg.norm(np.average(sideways, axis=0, weights=weight[seen])))


def with_shift_sigma(lane_map: LaneMap, plane: RoadPlane) -> LaneMap:
    """The map whose lanes say by how much each of their lines may lie aside.

    Args:
        lane_map: In the frame of the plane.
        plane: The calibration by which the traffic was placed.
    """

    def told(lane: Lane) -> Lane:
        lines = lane.centerline_m, lane.left_m, lane.right_m
        centre, left, right = (shift_sigma_m(line, plane) for line in lines)
        return replace(lane, shift_sigma_m=(centre, left, right))

    return replace(lane_map, lanes=tuple(told(lane) for lane in lane_map.lanes))
