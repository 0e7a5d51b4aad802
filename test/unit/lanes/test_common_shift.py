"""A line's error by the calibration is as large as it is said to be."""

from dataclasses import replace

import numpy as np
import pytest
from numpy.typing import NDArray

from geoorbit_ros.calibration.control_points import ControlPoints
from geoorbit_ros.calibration.homography import fit_homography
from geoorbit_ros.calibration.plane import RoadPlane
from geoorbit_ros.calibration.plane_fit import GROUND_SIGMA_M, PIXEL_SIGMA
from geoorbit_ros.core.lanes import LaneMap, lane_of_map
from geoorbit_ros.lanes.common_shift import shift_sigma_m, with_shift_sigma
from geoorbit_ros.lanes.geojson import dumps_lanes, parse_lane_file
from geoorbit_ros.scenes.roads import place_roads
from geoorbit_ros.scenes.scene import load_scene
from geoorbit_ros.scenes.simulate import simulate
from geoorbit_ros.scenes.traffic import simulate_traffic

Array = NDArray[np.float64]


@pytest.fixture(scope="module")
def true_points() -> ControlPoints:
    """Control points of a simulated camera without errors."""
    scene = load_scene("straight_3x3")
    record = simulate_traffic(scene, place_roads(scene), 2.0, 1)
    run = simulate(scene, 2.0, 1, traffic_record=record)
    points = run.control_points
    exact = RoadPlane(fit_homography(points).matrix, np.zeros((1, 3, 3)))
    return replace(points, local_m=exact.to_ground(points.pixel), image_size=None)


def line_on(plane: RoadPlane) -> Array:
    """A boundary that the camera sees, a hundred metres along the road."""
    ends = plane.to_ground([[500.0, 900.0], [900.0, 420.0]])
    return np.asarray(np.linspace(ends[0], ends[1], 30))


def test_boundaries_lie_within_the_shift_that_is_said_two_times_out_of_three(
    true_points: ControlPoints,
) -> None:
    rng, truth = np.random.default_rng(5), fit_homography(true_points)
    line = line_on(truth)
    pixel = truth.to_pixel(line)
    along = (line[-1] - line[0]) / np.hypot(*(line[-1] - line[0]))
    inside = []
    for _ in range(150):
        measured = replace(
            true_points,
            pixel=true_points.pixel + rng.normal(0.0, PIXEL_SIGMA, true_points.pixel.shape),
            local_m=true_points.local_m
            + rng.normal(0.0, GROUND_SIGMA_M, true_points.local_m.shape),
        )
        plane = fit_homography(measured)
        found = plane.to_ground(pixel)  # where perfect traffic would put the boundary
        off = (found - line) @ [-along[1], along[0]]
        inside.append(abs(off.mean()) < shift_sigma_m(found, plane))
    assert 0.60 < np.mean(inside) < 0.76


def test_an_exact_calibration_shifts_nothing_and_a_scale_shifts_what_is_far_aside() -> None:
    matrix = np.eye(3)
    exact = RoadPlane(matrix, np.zeros((1, 3, 3)))
    line = np.column_stack([np.linspace(10.0, 60.0, 20), np.full(20, 4.0)])
    assert shift_sigma_m(line, exact) == 0.0
    scaled = RoadPlane(matrix, np.diag([0.02, 0.02, 0.0])[None])
    assert shift_sigma_m(line, scaled) == pytest.approx(0.08)


def test_the_shift_travels_with_the_lanes(true_points: ControlPoints) -> None:
    plane = fit_homography(true_points)
    line = line_on(plane)
    beside = line + np.array([0.0, 3.5])
    lane_map = LaneMap(1, (lane_of_map(1, line, beside, line),))
    told = with_shift_sigma(lane_map, plane)
    assert plane.datum is not None
    read = parse_lane_file(dumps_lanes(told, plane.datum), "text", plane.datum).lane_map
    assert read.lanes[0].shift_sigma_m == pytest.approx(told.lanes[0].shift_sigma_m, abs=5e-4)
    assert all(0.0 < shift < 0.5 for shift in read.lanes[0].shift_sigma_m)
