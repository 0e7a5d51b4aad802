"""A road with painted lines as a camera on a pole sees it, drawn pixel by pixel from the ground."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cache

import cv2
import numpy as np
from numpy.typing import NDArray

from geoorbit_ros.calibration.control_points import ControlPoints
from geoorbit_ros.calibration.datum import Datum
from geoorbit_ros.calibration.homography import fit_homography
from geoorbit_ros.calibration.plane import Homography, RoadPlane
from geoorbit_ros.core.lanes import Lane, LaneMap
from geoorbit_ros.core.polylines import offset_line
from geoorbit_ros.scenes.camera import look_at

IMAGE_SIZE = (960, 540)
ROAD_M = (25.0, 95.0)
"""Where the lanes of `lane_map` begin and end, metres north of the camera."""
WHITE, YELLOW, ASPHALT = (225.0, 230.0, 230.0), (70.0, 190.0, 215.0), (92.0, 90.0, 88.0)
SAMPLES = 2
CURVE_PER_M = 4e-4


@dataclass(frozen=True)
class Stripe:
    """Something long on the road.

    Attributes:
        x_m: Its middle, east of the camera.
        width_m: Width.
        dash_m, period_m: A dash in each period; a period of 0 is a solid line.
        colour: BGR.
        y_m: Where it begins and ends.
    """

    x_m: float
    width_m: float = 0.15
    dash_m: float = 0.0
    period_m: float = 0.0
    colour: tuple[float, float, float] = WHITE
    y_m: tuple[float, float] = (0.0, 200.0)


def bend(y_m: NDArray[np.float64]) -> NDArray[np.float64]:
    """How far east the road has turned."""
    return np.asarray(CURVE_PER_M * y_m**2)


@cache
def road_plane() -> Homography:
    """Of a camera 9 m high beside the road; exact."""
    camera = look_at(np.array([-9.0, 0.0, 9.0]), np.array([2.0, 45.0, 0.0]), 45.0, IMAGE_SIZE)
    x, y = np.meshgrid([-8.0, 0.0, 8.0, 14.0], [20.0, 40.0, 70.0, 110.0])
    ground = np.column_stack([x.ravel(), y.ravel()])
    pixel, _ = camera.project(np.column_stack([ground, np.zeros(len(ground))]))
    points = ControlPoints(pixel, ground, Datum(48.0, 11.0), np.arange(len(ground)))
    return fit_homography(points)


@cache
def _ground() -> list[tuple[NDArray[np.float32], NDArray[np.float32]]]:
    """Metres east of the road's bend, and north, of every sample of every pixel."""
    width, height = IMAGE_SIZE
    steps = (np.arange(SAMPLES) + 0.5) / SAMPLES
    grids = []
    for down in steps:
        for across in steps:
            u, v = np.meshgrid(np.arange(width) + across, np.arange(height) + down)
            x, y = road_plane().to_ground(np.column_stack([u.ravel(), v.ravel()])).T
            x = np.asarray(x - bend(y), np.float32).reshape(height, width)
            grids.append((x, np.asarray(y, np.float32).reshape(height, width)))
    return grids


def road_image(
    stripes: Sequence[Stripe], noise: float = 3.0, colour: tuple[float, float, float] = ASPHALT
) -> NDArray[np.uint8]:
    """(540, 960, 3) BGR; grass beside the pavement, which reaches from -4 m to 14 m."""
    random = np.random.default_rng(5)
    total = np.zeros((*IMAGE_SIZE[::-1], 3), np.float32)
    for x, y in _ground():
        shown = np.full(total.shape, (200.0, 180.0, 160.0), np.float32)
        shown[np.isfinite(x)] = (60.0, 110.0, 80.0)
        with np.errstate(invalid="ignore"):
            shown[(x > -4.0) & (x < 14.0)] = colour
            for one in stripes:
                on = np.abs(x - one.x_m) < 0.5 * one.width_m
                on &= (y >= one.y_m[0]) & (y < one.y_m[1])
                if one.period_m:
                    on &= y % one.period_m < one.dash_m
                shown[on] = one.colour
        total += shown
    image = total / SAMPLES**2 + random.normal(0.0, noise, total.shape)
    return np.asarray(np.clip(np.rint(image), 0, 255), dtype=np.uint8)


def lane_map(
    centres_m: Sequence[float], width_m: float = 3.4, opposite: Sequence[bool] = ()
) -> LaneMap:
    """Lanes where the traffic has them, by the places of their drivers."""
    y = np.arange(ROAD_M[0], ROAD_M[1] + 1.0, 2.0)
    lanes = []
    for k, x_m in enumerate(centres_m):
        line, left, right = (
            np.column_stack([x_m + bend(y) + side, y])
            for side in (0.0, -0.5 * width_m, 0.5 * width_m)
        )
        if k < len(opposite) and opposite[k]:
            line, left, right = line[::-1], right[::-1], left[::-1]
        lanes.append(Lane(k + 1, line, left, right, width_m, 0.1, 0.9, "confirmed", 30.0))
    return LaneMap(1, tuple(lanes))


def offset_m(line: NDArray[np.float64]) -> NDArray[np.float64]:
    """How far east of the road's bend the points of a line are."""
    return np.asarray(line[:, 0] - bend(line[:, 1]))


def image_with_lines(
    plane: RoadPlane, lanes: Sequence[Lane], size: tuple[int, int] = (1920, 1080)
) -> NDArray[np.uint8]:
    """Asphalt with a white line of 0.16 m on every boundary of the lanes."""
    random = np.random.default_rng(1)
    noise = random.integers(-6, 7, (size[1], size[0], 3))
    image = np.asarray(90 + noise, dtype=np.uint8)
    for lane in lanes:
        for line in (lane.left_m, lane.right_m):
            ring = np.concatenate([offset_line(line, 0.08), offset_line(line, -0.08)[::-1]])
            pixel = plane.to_pixel(ring)
            pixel = pixel[np.isfinite(pixel).all(axis=1)]
            corners = np.rint((pixel - 0.5) * 16).astype(np.int32)
            cv2.fillPoly(image, [corners], (235, 235, 235), cv2.LINE_AA, 4)
    return image
