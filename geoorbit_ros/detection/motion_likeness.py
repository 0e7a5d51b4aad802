"""How much a box is like a vehicle's."""

from __future__ import annotations

import math

from geoorbit_ros.detection.motion_sizes import Box, VehicleSizes

SMALLER_COST = 0.7
"""A part that is smaller than a car may be hidden: that costs less than being larger."""
MOST = 1.5
TRUCK_LEAST, TRUCK_MOST = (1.0, 1.6), (3.6, 3.0)
"""Width and height of trucks and buses, in cars."""
TRUCK_COST, DENTED_COST, CONVEX = 0.25, 3.0, 0.9
"""Trucks are rarer than cars, and have the outline of a box."""


def unlikeness(box: Box, fill: float, sizes: VehicleSizes) -> float:
    """How far a box is from a vehicle's at its place: 0 for a car, natural logarithms of size.

    Args:
        box: The part's.
        fill: Share of its convex hull that it fills.
        sizes: How large a car is at each place.
    """
    car = truck = 0.0
    ratios = zip((box[2] - box[0], box[3] - box[1]), sizes.car(box), strict=True)
    for (side, usual), least, most in zip(ratios, TRUCK_LEAST, TRUCK_MOST, strict=True):
        log = math.log(side / usual)
        car += min(log if log > 0.0 else -SMALLER_COST * log, MOST)
        truck += max(log - math.log(most), 0.0) + max(math.log(least) - log, 0.0)
    truck += TRUCK_COST + DENTED_COST * max(CONVEX - fill, 0.0)
    return min(car, truck)
