"""Where vehicles of given sizes stand whose boxes have given middles, and how large the boxes are.

`vehicle_fit` takes all four edges for the place, which is best for the place. Here sides tell which
camera is likely, so the place must not follow their noise: a vehicle whose box is a pixel too high
would be moved nearer, the more easily the lower the camera looks, and such cameras would seem to
explain boxes better.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from geoorbit_ros.calibration.elementwise import inverse_2x2, through
from geoorbit_ros.calibration.vehicle_fit import corners, edge_slopes, on_plane, vehicle_axes

Array = NDArray[np.float64]

STEPS = 2
"""Of Newton's method: each leaves less than a fifth of the error."""


@dataclass(frozen=True, slots=True)
class PlacedBoxes:
    """Boxes round vehicles.

    Attributes:
        xy: (2, N) middles of the footprints, metres.
        side_px: (2, N) width and height of the boxes.
        side_slope: (2, 3, N) their slopes with length, width and height, the middle of the box
            held, pixels per metre.
        by_length: (N,) slope of the height with the length, the vehicle's place held.
        good: (N,) False where a vehicle would reach behind the camera or beyond the horizon.
    """

    xy: Array
    side_px: Array
    side_slope: Array
    by_length: Array
    good: NDArray[np.bool_]


def place_boxes(
    projection: Array, centre: Array, heading: Array, size_m: Array, first: Array | None = None
) -> PlacedBoxes:
    """Vehicles whose boxes' middles are where they were seen (Newton's method).

    Args:
        projection: (3, 4) metres to ideal pixels.
        centre: (2, N) of the boxes, ideal pixels.
        heading: (N,) radians from x.
        size_m: (3, N) length, width, height.
        first: (2, N) first guess; None: the middle shows the body's middle.
    """
    with np.errstate(all="ignore"):
        unit = vehicle_axes(projection, heading)
        axes = unit * size_m[:, None]
        xy = on_plane(projection, centre, size_m[2] / 2)[0] if first is None else first
        for _ in range(STEPS):
            uv, depth = corners(projection, xy, axes)
            edge, by_place, by_size = edge_slopes(projection, uv, depth, unit)
            move = inverse_2x2((by_place[:2] + by_place[2:]) / 2)
            off = centre - (edge[:2] + edge[2:]) / 2
            xy = xy + through(move, off[:, None])[:, 0]
        uv, depth = corners(projection, xy, axes)
        edge, by_place, by_size = edge_slopes(projection, uv, depth, unit)
        middle = (by_size[:2] + by_size[2:]) / 2
        sides, turned = by_size[2:] - by_size[:2], by_place[2:] - by_place[:2]
        slope = sides - through(turned, through(move, middle))
        good = (depth.min(axis=0) > 0) & np.isfinite(slope).all(axis=(0, 1))
        good &= np.isfinite(xy).all(axis=0)
    return PlacedBoxes(
        np.where(good, xy, 0.0),
        np.where(good, edge[2:] - edge[:2], 0.0),
        np.where(good, slope, 0.0),
        np.where(good, sides[1, 0], 0.0),
        good,
    )
