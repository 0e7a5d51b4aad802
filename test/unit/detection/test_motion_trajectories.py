"""What travels is a vehicle, and its way is a road; where things only move there is none."""

import numpy as np
import pytest

from geoorbit_ros.detection.motion.road_axes import RoadAxes
from geoorbit_ros.detection.motion.trajectories import KEPT_SHARE, Trajectories, Travelled
from geoorbit_ros.detection.motion.vehicle_shapes import Box, VehicleSizes

Step = tuple[float, float]


def box_at(x: float, bottom: float) -> Box:
    return round(x) - 20, round(bottom) - 24, round(x) + 20, round(bottom)


class Road:
    """Vehicles that are followed, and what is learnt from them."""

    def __init__(self) -> None:
        self.trajectories, self.axes = Trajectories(), RoadAxes()
        self.boxes: list[np.ndarray] = []
        self.now_s = 1.0

    def see(self, *boxes: Box, after_s: float = 0.15) -> Travelled:
        self.now_s += after_s
        travelled = self.trajectories.add(round(self.now_s * 1e9), list(boxes), [True] * len(boxes))
        self.axes.add(travelled)
        self.boxes += list(travelled.boxes)
        return travelled

    def drive(self, step: Step, start: Step = (300.0, 300.0), images: int = 30) -> int:
        """One vehicle that moves by so many pixels from image to image; how many had travelled."""
        self.now_s += 60.0
        at = [box_at(start[0] + k * step[0], start[1] + k * step[1]) for k in range(images)]
        return sum(self.see(box).vehicles for box in at)


@pytest.mark.parametrize("step", [(12.0, -5.0), (-12.0, 5.0), (0.0, 8.0), (9.0, 0.0)])
def test_the_road_runs_as_vehicles_move_whichever_way(step: Step) -> None:
    road = Road()
    assert road.drive(step) == 1
    along = road.axes.at(320.0, 300.0)
    assert along is not None
    assert abs(np.dot(along, step)) == pytest.approx(np.hypot(*step), rel=0.01)
    assert along[1] <= 1e-9


def test_traffic_both_ways_is_one_road() -> None:
    road = Road()
    road.drive((12.0, -5.0))
    road.drive((-12.0, 5.0))
    along = road.axes.at(300.0, 300.0)
    assert along is not None
    assert along == pytest.approx((12.0 / 13.0, -5.0 / 13.0), abs=0.02)


def test_a_crossing_has_no_direction() -> None:
    road = Road()
    assert road.axes.at(300.0, 300.0) is None
    road.drive((12.0, 0.0), (120.0, 300.0))
    road.drive((0.0, 12.0), (300.0, 120.0))
    assert road.axes.at(300.0, 300.0) is None


def test_what_stands_sways_or_jumps_has_not_travelled() -> None:
    road = Road()
    assert road.drive((0.0, 0.0)) == 0
    for k in range(200):  # leaves: to and fro by more than their own size
        sway = 30.0 * np.sin(0.3 * k)
        road.see(box_at(300.0 + sway, 300.0), box_at(200.0 + 400.0 * (k % 2), 500.0))
    assert not road.boxes
    assert road.axes.at(300.0, 300.0) is None


def test_a_vehicle_that_changes_its_size_at_once_is_another() -> None:
    road = Road()
    for k in range(40):  # pieces of one long vehicle, each seen for an instant
        x = 300 + 10 * k
        road.see((x, 280, x + (20, 28, 40, 56, 80)[k % 5], 300))
    assert not road.boxes


def test_boxes_count_by_the_way_not_by_the_time() -> None:
    """A queue that creeps must not decide what a car looks like."""
    road = Road()
    road.drive((0.5, 0.0), images=401)
    x, way_px = 300.0 + 0.5 * 400, 0.5 * 400
    for _ in range(200):  # it stands
        road.see(box_at(x, 300.0))
    side_px = np.sqrt(40.0 * 24.0)
    assert 0 < len(road.boxes) <= way_px / (KEPT_SHARE * side_px)


def test_two_that_pass_each_other_both_travel() -> None:
    road, found = Road(), 0
    for k in range(40):
        a, b = box_at(100.0 + 10.0 * k, 300.0), box_at(500.0 - 10.0 * k, 330.0)
        found += road.see(a, b).vehicles
    assert found == 2


@pytest.mark.parametrize(("whole", "isolated"), [(3, 0), (4, 0), (5, 5), (9, 9)])
def test_what_is_by_itself_in_a_few_images_alone_teaches_nothing(whole: int, isolated: int) -> None:
    """Pieces of vehicles travel, too, but join others again."""
    trajectories, taught, teaching = Trajectories(), 0, 0
    for k in range(20):
        seen = [box_at(300.0 + 12.0 * k, 300.0)]
        found = trajectories.add(10**9 + k * 150_000_000, seen, [3 <= k < 3 + whole])
        taught += int(found.isolated.sum())
        teaching += found.teaching
    assert taught == isolated
    assert teaching == (isolated > 0)


def cars(count: int, rows: tuple[float, float]) -> np.ndarray:
    """Boxes of cars that are a tenth as high as the row that they end in."""
    bottom = np.linspace(*rows, count)
    x = np.random.default_rng(3).uniform(100.0, 900.0, count)
    half = 0.07 * bottom
    return np.column_stack((x - half, 0.9 * bottom, x + half, bottom))


def test_the_size_of_a_car_is_learnt_from_several_vehicles() -> None:
    for vehicles, known in ((3, False), (4, True)):
        sizes = VehicleSizes()
        sizes.add(cars(200, (200.0, 600.0)), vehicles)
        sizes.learn()
        assert sizes.known == known


def test_far_cars_say_nothing_about_near_ones() -> None:
    sizes = VehicleSizes()
    sizes.add(cars(200, (200.0, 300.0)), 20)
    sizes.learn()
    assert sizes.known
    assert sizes.knows((400, 350, 440, 380))
    assert not sizes.knows((400, 550, 500, 600))
    assert sizes.car((400, 350, 440, 380))[1] == pytest.approx(38.0, rel=0.1)


def test_where_things_move_and_never_travel_is_no_road() -> None:
    road = Road()
    leaves = box_at(400.0, 200.0)
    assert road.axes.on_road(leaves), "nothing is known yet"
    for _ in range(30):
        road.see(leaves)
    assert not road.axes.on_road(leaves)
    assert road.axes.on_road(box_at(400.0, 300.0)), "nothing was seen there"
    assert road.axes.on_road(box_at(4000.0, 3000.0)), "beyond everything that was seen"
    road.drive((10.0, 0.0), (300.0, 200.0))
    assert road.axes.on_road(leaves), "a vehicle has travelled there"


def test_the_covered_share_of_the_road_is_that_of_where_vehicles_drove() -> None:
    road = Road()
    moving = np.zeros((400, 800), np.uint8)
    assert np.isnan(road.axes.covered_share(moving)), "no road is known"
    for bottom in (300.0, 324.0):
        road.drive((10.0, 0.0), (100.0, bottom), images=60)
    assert road.axes.covered_share(moving) == 0.0
    moving[:, :400] = 255
    assert road.axes.covered_share(moving) == pytest.approx(0.5, abs=0.05)
    moving[:200] = 255
    assert road.axes.covered_share(moving) == pytest.approx(0.5, abs=0.05), "beside the road"


def test_a_queue_does_not_make_its_road_clutter() -> None:
    road = Road()
    road.drive((10.0, 0.0))
    for _ in range(100):
        road.see(box_at(500.0, 300.0))
    assert road.axes.on_road(box_at(500.0, 300.0))


def test_time_may_start_again() -> None:
    road = Road()
    road.drive((10.0, 0.0))
    road.now_s = 1.0
    assert road.drive((10.0, 0.0)) == 1
