"""The direction of the road in the image is that in which vehicles move."""

import numpy as np
import pytest

from geoorbit_ros.detection.motion.road_axes import RoadAxes
from geoorbit_ros.detection.motion.vehicle_shapes import Box


def box_at(x: float, bottom: float) -> Box:
    return round(x) - 20, round(bottom) - 24, round(x) + 20, round(bottom)


def drive(axes: RoadAxes, step: tuple[float, float], period_s: float, start: float = 0.0) -> None:
    """One vehicle that moves by so many pixels from image to image."""
    for k in range(30):
        box = box_at(300.0 + k * step[0], 300.0 + k * step[1])
        axes.add(round((1.0 + start + period_s * k) * 1e9), [box])


@pytest.mark.parametrize("step", [(12.0, -5.0), (-12.0, 5.0), (0.0, 8.0), (9.0, 0.0)])
def test_the_road_runs_as_vehicles_move_whichever_way(step: tuple[float, float]) -> None:
    axes = RoadAxes()
    drive(axes, step, 0.15)
    along = axes.at(320.0, 300.0)
    assert along is not None
    assert abs(np.dot(along, step)) == pytest.approx(np.hypot(*step), rel=0.01)
    assert along[1] <= 1e-9


def test_traffic_both_ways_is_one_road() -> None:
    axes = RoadAxes()
    drive(axes, (12.0, -5.0), 0.15)
    drive(axes, (-12.0, 5.0), 0.15, start=60.0)
    along = axes.at(300.0, 300.0)
    assert along is not None
    assert along == pytest.approx((12.0 / 13.0, -5.0 / 13.0), abs=0.02)


def test_nothing_is_said_where_directions_disagree_or_nothing_moves() -> None:
    axes = RoadAxes()
    assert axes.at(300.0, 300.0) is None
    drive(axes, (0.0, 0.0), 0.15)
    assert axes.at(300.0, 300.0) is None, "a vehicle that stands has no direction"
    drive(axes, (12.0, 0.0), 0.15, start=60.0)
    drive(axes, (0.0, 12.0), 0.15, start=120.0)
    assert axes.at(300.0, 300.0) is None, "a crossing has two"


def test_another_vehicle_far_off_is_no_step() -> None:
    axes = RoadAxes()
    for k in range(60):
        axes.add(round((1.0 + 0.15 * k) * 1e9), [box_at(200.0 + 400.0 * (k % 2), 300.0)])
    assert axes.at(300.0, 300.0) is None
