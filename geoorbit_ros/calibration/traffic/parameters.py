"""The parameters of a camera that is found from traffic, and what is known of them beforehand."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]

FOCAL, TILT, ROLL, HEIGHT, FLEET, MARGIN, ROOF, YAW, PLACE = (
    0, 1, 2, 3, slice(4, 10), slice(10, 12), 12, 13, slice(14, 16),
)  # fmt: skip
"""Parameters: log of focal length over image width; tilt below the horizontal and roll in radians;
log of the height in metres; how much larger than usual cars are (length, width, height), then
motorcycles, buses and trucks; pixels that a detector draws boxes wider and higher; share of its
length by which a car's roof is shorter; then, where points are known, the camera's heading and
place in their frame."""
FEW, MANY = 13, 16
"""Parameters without known points, and with them."""
LOWEST = np.array([np.log(0.25), np.radians(1), -0.2, np.log(2.5), *[-0.3] * 6, -8, -8, -0.2])
HIGHEST = np.array([np.log(10.0), np.radians(80), 0.2, np.log(90), *[0.3] * 6, 8, 8, 0.5])
"""Bounds: 127 to 6 degrees wide, 2.5 to 90 m high, roll to 11 degrees."""
STEP = np.array([0.1, 0.03, 0.02, 0.1, *[0.03] * 6, 1, 1, 0.05, 0.05, 1, 1])
"""How much of each parameter changes about as much."""

FLEET_COMMON, FLEET_OWN = 0.03, 0.025
"""1-sigma of the mean size of a place's cars against `MEAN_M`: of all three dimensions together,
and of each. New cars are 1.80 m wide in Europe (Transport & Environment (2024), growth of 1 cm in
two years) and 1.85 to 1.95 m in North America, whose commonest models are a crossover and a pickup;
lengths 4.4 and 4.8 m. A fleet in the middle is off by 3 to 4 %."""
GROUP_FLEET = np.array([0.1, 0.04, 0.12])
"""The same of motorcycles, buses (2.55 m is the legal width nearly everywhere) and trucks, which
for a detector are everything from a pickup to a semitrailer."""
MARGIN_SIGMA_PX = 1.0
"""1-sigma of what a detector adds to a box's width and height whatever the distance."""
ROOF_MEAN, ROOF_SIGMA = 0.12, 0.15
"""A roof is shorter than the car and the upper edge of a box shows the roof: by 0 (a van) to 0.25
(a saloon car, whose roof is half as long as it is)."""
ROOF_OF_LARGE = 0.3
"""The same of buses and trucks, as a share of that of cars."""
ROLL_SIGMA_RAD = np.radians(1.0)
"""1-sigma of a camera's roll: mounts are levelled by eye. Boxes say little about it: vehicles that
come and those that go look different, and each kind is on one side of the image."""
HEIGHT_MEAN_M, HEIGHT_SIGMA = 11.0, 0.8
FOCAL_SIGMA = 1.0
TILT_MEAN_RAD, TILT_SIGMA_RAD = 0.3, 0.6
"""Weak priors, of which any camera on a pole is within two sigma: 2 to 55 m high, a focal length of
0.14 to 7 image widths."""
KNOWN_FOCAL_SIGMA = 0.01
"""1-sigma, as a share, of a focal length that the user's camera_info gives."""


def prior_residuals(x: Array, image_width: int, focal_px: float | None) -> Array:
    """How unusual a camera and its fleet are, in sigma.

    Args:
        x: Parameters.
        image_width: In pixels.
        focal_px: The focal length, where it is known.
    """
    cars = FLEET_COMMON**2 * np.ones((3, 3)) + FLEET_OWN**2 * np.eye(3)
    focal, focal_sigma = 0.0, FOCAL_SIGMA
    if focal_px is not None:
        focal, focal_sigma = float(np.log(focal_px / image_width)), KNOWN_FOCAL_SIGMA
    camera = [
        (x[ROOF] - ROOF_MEAN) / ROOF_SIGMA,
        x[ROLL] / ROLL_SIGMA_RAD,
        (x[HEIGHT] - np.log(HEIGHT_MEAN_M)) / HEIGHT_SIGMA,
        (x[FOCAL] - focal) / focal_sigma,
        (x[TILT] - TILT_MEAN_RAD) / TILT_SIGMA_RAD,
    ]
    whole_fleet = np.linalg.solve(np.linalg.cholesky(cars), x[4:7])
    parts = (whole_fleet, x[7:10] / GROUP_FLEET, x[MARGIN] / MARGIN_SIGMA_PX, camera)
    return np.concatenate(parts)


def projection_matrix(x: Array, image_size: tuple[int, int]) -> Array:
    """(3, 4) from metres (right, ahead, up; from the ground below the camera) to pixels."""
    width, height = image_size
    sin, cos = np.sin(x[TILT]), np.cos(x[TILT])
    right, down = np.array([1.0, 0.0, 0.0]), np.array([0.0, -sin, -cos])
    turn, lean = np.cos(x[ROLL]), np.sin(x[ROLL])
    ahead = np.array([0.0, cos, -sin])
    rotation = np.vstack((turn * right - lean * down, lean * right + turn * down, ahead))
    focal = np.exp(x[FOCAL]) * width
    camera = np.array([[focal, 0, width / 2], [0, focal, height / 2], [0, 0, 1]])
    place = np.array([0.0, 0.0, np.exp(x[HEIGHT])])
    return np.asarray(camera @ np.column_stack((rotation, -rotation @ place)))


@dataclass(frozen=True, slots=True)
class KnownPoints:
    """Points on the road whose place is known, with their errors.

    Attributes:
        pixel: (M, 2) ideal pixels.
        local_m: (M, 2) metres in a frame of the user's.
        sigma_px: (M,) of a pixel coordinate.
        sigma_m: (M,) of a ground coordinate.
    """

    pixel: Array
    local_m: Array
    sigma_px: Array
    sigma_m: Array
