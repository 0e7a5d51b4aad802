"""Lane numbers across the road, the order of tables, the lane of a position."""

import numpy as np
import pytest

from geoorbit_ros.core.lane_order import drives_on_left, lane_ids_at, lane_numbers, left_to_right
from geoorbit_ros.core.lanes import Lane, lane_of_map
from geoorbit_ros.core.polylines import offset_line

WIDTH_M = 3.5


def lane(
    lane_id: int, x_m: float, heading: int = 1, start_m: float = 0.0, end_m: float = 100.0
) -> Lane:
    """A lane northwards (1) or southwards (-1) along x = `x_m`."""
    y_m = np.linspace(start_m, end_m, 20)[::heading]
    line = np.column_stack((np.full(20, x_m), y_m))
    half_m = WIDTH_M / 2
    return lane_of_map(lane_id, line, offset_line(line, half_m), offset_line(line, -half_m))


def road(first_x_m: float, ids: list[int], heading: int = 1) -> list[Lane]:
    return [lane(i, first_x_m + k * WIDTH_M, heading) for k, i in enumerate(ids)]


def test_lane_1_is_the_outermost_where_vehicles_drive_on_the_right() -> None:
    north, south = road(2.0, [5, 3, 9]), road(-9.0, [8, 2, 4], -1)
    assert not drives_on_left([*north, *south])
    assert lane_numbers([*north, *south]) == {9: 1, 3: 2, 5: 3, 8: 1, 2: 2, 4: 3}
    assert [x.lane_id for x in left_to_right([*south, *north])] == [5, 3, 9, 4, 2, 8]


def test_lane_1_is_the_outermost_where_vehicles_drive_on_the_left() -> None:
    north, south = road(-9.0, [5, 3, 9]), road(2.0, [8, 2, 4], -1)
    assert drives_on_left([*north, *south])
    assert lane_numbers([*north, *south]) == {5: 1, 3: 2, 9: 3, 4: 1, 2: 2, 8: 3}
    assert [x.lane_id for x in left_to_right([*south, *north])] == [5, 3, 9, 4, 2, 8]


def test_a_ramp_is_lane_1_and_the_lanes_beside_it_keep_one_number() -> None:
    ramp = lane(7, 7.0, start_m=0.0, end_m=40.0)
    assert lane_numbers([*road(0.0, [1, 2]), ramp]) == {7: 1, 2: 2, 1: 3}


@pytest.mark.parametrize("order", [1, -1])
def test_the_order_given_and_lanes_that_follow_one_another_change_nothing(order: int) -> None:
    lanes = [*road(0.0, [1, 2]), lane(6, 0.0, start_m=110.0, end_m=200.0)]
    assert lane_numbers(lanes[::order]) == {2: 1, 1: 2, 6: 1}


def test_no_lanes_have_no_numbers() -> None:
    assert lane_numbers([]) == {}
    assert left_to_right([]) == []


def test_a_vehicle_is_in_the_lane_it_drives_along() -> None:
    lanes = [*road(0.0, [1, 2]), *road(-WIDTH_M, [3], -1)]
    north = np.pi / 2
    position = np.array([[0.4, 50], [3.0, 50], [0.0, 50], [0.0, 50], [30.0, 50], [-3.5, 50]])
    heading = np.array([north, np.nan, 0.0, -north, north, -north])
    assert lane_ids_at(position, heading, lanes).tolist() == [1, 2, 0, 0, 0, 3]
