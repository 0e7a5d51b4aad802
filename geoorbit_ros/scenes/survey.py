"""Control points as a surveyor would take them: on the road, with small errors on both sides."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from geoorbit_ros.calibration.control_points import ControlPoints
from geoorbit_ros.calibration.datum import Datum
from geoorbit_ros.scenes.camera import PinholeCamera
from geoorbit_ros.scenes.roads import PlacedRoad

POINTS = 16
"""Control points of a camera. Chosen: more make the calibration more exact than a person's."""
SURVEY_SIGMA_M = 0.02
"""1-sigma of a surveyed coordinate. Chosen: that of satellite positioning with corrections
(RTK)."""
CLICK_SIGMA_PX = 0.5
"""1-sigma of a clicked pixel coordinate. Chosen: a careful person's."""
MARGIN_PX = 20.0
"""No point is nearer to the image border. Chosen: in a real camera lens distortion is largest
there."""
MAX_GROUND_SIGMA_M = 0.5
"""No point is taken where a pixel is more than this on the ground. Chosen: larger makes the
homography inexact."""


def survey_control_points(
    placed: dict[str, PlacedRoad], camera: PinholeCamera, datum: Datum, seed: int
) -> ControlPoints:
    """Points on the roads' borders, spread over the visible ground."""
    random = np.random.default_rng([seed, 5])
    lines = [p.offset(right) for p in placed.values() for right in (0.0, p.road.lanes * p.width_m)]
    ground = np.concatenate(lines)
    pixel, depth = camera.project(np.column_stack([ground, np.zeros(len(ground))]))
    size = np.array(camera.image_size)
    inside = (depth > 1.0) & np.all((pixel > MARGIN_PX) & (pixel < size - MARGIN_PX), axis=1)
    ground, pixel = ground[inside], pixel[inside]
    sharp = camera.ground_sigma_m(ground, 1.0) <= MAX_GROUND_SIGMA_M
    ground, pixel = ground[sharp], pixel[sharp]
    chosen = _spread(pixel, POINTS)
    surveyed = ground[chosen] + SURVEY_SIGMA_M * random.standard_normal((len(chosen), 2))
    clicked = pixel[chosen] + CLICK_SIGMA_PX * random.standard_normal((len(chosen), 2))
    return ControlPoints(clicked, surveyed, datum, np.arange(len(chosen)) + 2)


def _spread(points: NDArray[np.float64], count: int) -> NDArray[np.int64]:
    """Farthest-point sampling: well spread, the same for the same points."""
    chosen = [int(np.argmax(points[:, 1]))]
    distance = np.full(len(points), np.inf)
    while len(chosen) < min(count, len(points)):
        distance = np.minimum(distance, np.hypot(*(points - points[chosen[-1]]).T))
        chosen.append(int(np.argmax(distance)))
    return np.array(chosen)
