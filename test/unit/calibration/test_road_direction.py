"""The road's direction from those who drive there, and vehicles placed by their boxes' middles."""

from __future__ import annotations

import numpy as np
import pytest
from numpy.typing import NDArray

from geoorbit_ros.calibration.traffic.boxes import place_boxes
from geoorbit_ros.calibration.traffic.parameters import (
    FEW,
    FOCAL,
    HEIGHT,
    TILT,
    projection_matrix,
)
from geoorbit_ros.calibration.traffic.road_direction import Places, road_headings
from geoorbit_ros.scenes.camera import body_corners

RADIUS_M = 150.0


def bend(sight_noise_m: float, changes_lane: bool = False) -> Places:
    """Twelve vehicles in a bend to the left about (0, `RADIUS_M`), each every 2 m along 80 m."""
    random = np.random.default_rng(0)
    xy, vehicle, angle, time_s = [], [], [], []
    for k in range(12):
        along = np.arange(-40.0, 40.0, 2.0) + random.uniform(0.0, 2.0)
        radius = RADIUS_M - 3.6 * (k % 2) + (0.05 * along if changes_lane and k == 0 else 0.0)
        turn = along / RADIUS_M
        place = np.array([radius * np.sin(turn), RADIUS_M - radius * np.cos(turn)])
        # Uncertain along the line of sight of a camera that looks at 30 degrees to the road.
        sight = np.array([np.cos(np.pi / 6), np.sin(np.pi / 6)])
        xy.append(place + sight[:, None] * sight_noise_m * random.standard_normal(len(along)))
        vehicle += [k] * len(along)
        angle.append(turn + np.radians(3.0) * random.standard_normal(len(along)))
        time_s.append(along / 20.0)
    noise = np.full(len(vehicle), 0.1)
    places = np.concatenate(xy, axis=1)
    return Places(places, np.array(vehicle), np.concatenate(time_s), np.concatenate(angle), noise)


Array = NDArray[np.float64]


def at(turn: float) -> tuple[Array, NDArray[np.int64], Array, Array]:
    here = np.array([[RADIUS_M * np.sin(turn)], [RADIUS_M * (1.0 - np.cos(turn))]])
    rough, noise = np.array([turn + np.radians(2.0)]), np.array([0.1])
    return here, np.array([2], np.int64), rough, noise


@pytest.mark.parametrize("turn", [-0.25, -0.1, 0.0, 0.2])
def test_the_direction_in_a_bend_is_the_tangent_to_its_ends(turn: float) -> None:
    road, _ = road_headings(bend(0.0), *at(turn))
    assert road.angle[0] == pytest.approx(turn, abs=np.radians(0.2))
    assert road.curvature[0] == pytest.approx(1.0 / RADIUS_M, rel=0.25)


def test_noise_along_the_line_of_sight_does_not_turn_the_road_towards_the_camera() -> None:
    found = [road_headings(bend(2.0), *at(turn))[0].angle[0] - turn for turn in (-0.1, 0.0, 0.1)]
    assert np.abs(np.mean(found)) < np.radians(1.0), "2 m over 24 m are 5 degrees at one vehicle"


def test_one_who_changes_lane_does_not_turn_the_road() -> None:
    road, _ = road_headings(bend(0.0, changes_lane=True), *at(0.0))
    assert road.angle[0] == pytest.approx(0.0, abs=np.radians(0.3))


def test_where_nobody_drove_the_direction_is_unsure() -> None:
    here, vehicle, rough, noise = at(0.0)
    road, own = road_headings(bend(0.0), here + 500.0, vehicle, rough, noise)
    assert road.angle[0] == rough[0]
    assert min(road.variance[0], own.variance[0]) > np.radians(10.0) ** 2


def test_vehicles_stand_where_their_boxes_middles_are() -> None:
    x = np.zeros(FEW)
    x[[FOCAL, TILT, HEIGHT]] = np.log(0.9), np.radians(15.0), np.log(10.0)
    matrix = projection_matrix(x, (1280, 720))
    xy, heading = np.array([[-6.0, 3.0, 9.0], [25.0, 60.0, 110.0]]), np.array([1.2, 1.5, -1.7])
    size = np.array([[4.7, 12.0, 4.5], [1.9, 2.5, 1.8], [1.6, 3.2, 1.5]])

    def boxes(size: NDArray[np.float64]) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        uvw = body_corners(xy.T, heading, size.T) @ matrix[:, :3].T + matrix[:, 3]
        uv = uvw[..., :2] / uvw[..., 2:]
        low, high = uv.min(axis=1).T, uv.max(axis=1).T
        return (low + high) / 2, high - low

    centre, side = boxes(size)
    placed = place_boxes(matrix, centre, heading, size)
    assert placed.good.all()
    assert placed.xy == pytest.approx(xy, abs=0.01)
    assert placed.side_px == pytest.approx(side, abs=0.05)
    for k in range(3):
        longer = size.copy()
        longer[k] += 0.02
        change = (place_boxes(matrix, centre, heading, longer).side_px - placed.side_px) / 0.02
        assert placed.side_slope[:, k] == pytest.approx(change, abs=0.3)
