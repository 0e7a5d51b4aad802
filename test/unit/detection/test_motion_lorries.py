"""A long lorry is one vehicle; cars in a queue, or beside a lorry, stay several."""

from dataclasses import dataclass
from functools import lru_cache

import cv2
import numpy as np
import pytest
from numpy.typing import NDArray

from geoorbit_ros.detection.motion.blobs import find_vehicles
from geoorbit_ros.detection.motion.road_axes import RoadAxes
from geoorbit_ros.detection.motion.trajectories import Trajectories
from geoorbit_ros.detection.motion.vehicle_shapes import Box, VehicleOutlines, VehicleSizes

SIZE = (1280, 720)
FOCAL_PX = 900.0
CAR = (4.5, 1.82, 1.47)
LORRY = (16.5, 2.55, 4.0)
TRUCK = (9.0, 2.5, 3.4)
LANE_M = 3.6


@dataclass(frozen=True)
class Camera:
    """On a pole at the origin; it looks along y, tilted down; the road turns right of that."""

    height_m: float
    tilt_deg: float
    heading_deg: float

    def pixels(self, ground: NDArray[np.float64]) -> NDArray[np.float64]:
        """(N, 2) of points (N, 3): right, ahead, up from the foot of the pole, metres."""
        tilt = np.radians(self.tilt_deg)
        ahead, up = ground[:, 1], ground[:, 2] - self.height_m
        depth = ahead * np.cos(tilt) - up * np.sin(tilt)
        down = -up * np.cos(tilt) - ahead * np.sin(tilt)
        flat = np.column_stack([ground[:, 0], down]) * FOCAL_PX / depth[:, None]
        return np.asarray(flat + np.array([SIZE[0] / 2, SIZE[1] / 2]))

    def mask(
        self, along_m: float, lane: int, kind: tuple[float, float, float]
    ) -> NDArray[np.uint8]:
        """(H, W) 255 where a vehicle is: a box with its nose up, as cars have."""
        length, width, height = kind
        heading = np.radians(self.heading_deg)
        forth = np.array([np.sin(heading), np.cos(heading)])
        across = np.array([forth[1], -forth[0]])
        middle = np.array([0.0, 40.0]) + along_m * forth + lane * LANE_M * across
        corners = []
        for a in (-0.5, 0.5):
            for b in (-0.5, 0.5):
                at = middle + a * length * forth + b * width * across
                corners += [[*at, 0.0], [*at, height]]
        canvas = np.zeros(SIZE[::-1], np.uint8)
        hull = cv2.convexHull(np.rint(self.pixels(np.array(corners))).astype(np.int32))
        cv2.fillConvexPoly(canvas, hull, 255)
        return canvas


OBLIQUE = Camera(16.0, 22.0, 50.0)
ALONG = Camera(16.0, 22.0, 12.0)
LOW = Camera(8.0, 12.0, 20.0)
CAMERAS = [OBLIQUE, ALONG, LOW]


def box_of(mask: NDArray[np.uint8]) -> Box:
    x, y, width, height = cv2.boundingRect(mask)
    return x, y, x + width, y + height


@lru_cache
def learnt(camera: Camera) -> tuple[VehicleSizes, VehicleOutlines, RoadAxes]:
    """What cars that drove past one by one taught."""
    sizes, outlines, axes = VehicleSizes(), VehicleOutlines(), RoadAxes()
    trajectories = Trajectories()
    stamp_ns = 0
    for lane in (-2, -1, 0, 1, 2):
        for along_m in np.arange(-14.0, 50.0, 1.5).tolist():
            stamp_ns += 150_000_000
            mask = camera.mask(along_m, lane, CAR)
            box = box_of(mask)
            axes.add(trajectories.add(stamp_ns, [box], [True]))
            sizes.add(np.array([box], dtype=np.float64), 1)
            outlines.add((mask > 0).astype(np.uint8), box, (0, 0))
        stamp_ns += 10_000_000_000
    sizes.learn()
    assert sizes.known
    return sizes, outlines, axes


def found(camera: Camera, *vehicles: tuple[float, int, tuple[float, float, float]]) -> list[Box]:
    mask = np.zeros(SIZE[::-1], np.uint8)
    for vehicle in vehicles:
        mask |= camera.mask(*vehicle)
    return [vehicle.box for vehicle in find_vehicles(mask, mask, *learnt(camera))]


def overlap(a: Box, b: Box) -> float:
    wide = max(min(a[2], b[2]) - max(a[0], b[0]), 0)
    tall = max(min(a[3], b[3]) - max(a[1], b[1]), 0)
    areas = [(box[2] - box[0]) * (box[3] - box[1]) for box in (a, b)]
    return wide * tall / (sum(areas) - wide * tall)


@pytest.mark.parametrize("camera", CAMERAS)
@pytest.mark.parametrize("kind", [LORRY, TRUCK])
@pytest.mark.parametrize("along_m", [-5.0, 5.0, 12.0])
def test_a_lorry_is_one_vehicle(
    camera: Camera, kind: tuple[float, float, float], along_m: float
) -> None:
    boxes = found(camera, (along_m, 0, kind))
    assert len(boxes) == 1
    assert overlap(boxes[0], box_of(camera.mask(along_m, 0, kind))) > 0.85


@pytest.mark.parametrize("camera", CAMERAS)
@pytest.mark.parametrize("from_car_to_car_m", [7.0, 8.0])
def test_two_cars_in_a_queue_stay_two(camera: Camera, from_car_to_car_m: float) -> None:
    """Standing traffic leaves 2 to 3 m; along the road, one hides a part of the other."""
    boxes = found(camera, (0.0, 0, CAR), (from_car_to_car_m, 0, CAR))
    assert len(boxes) == 2


def test_a_car_before_a_lorry_is_not_swallowed() -> None:
    camera, lorry, car = ALONG, (6.0, 0, LORRY), (0.0, 1, CAR)
    boxes = found(camera, lorry, car)
    assert len(boxes) == 2
    for vehicle in (lorry, car):
        assert max(overlap(box, box_of(camera.mask(*vehicle))) for box in boxes) > 0.6
