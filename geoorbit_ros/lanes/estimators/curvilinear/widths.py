"""Lane widths from the spacing of neighbouring centrelines.

Lateral wander is no lane width (2 sigma of it is about 1 m): vehicles keep to the middle, so the
distance from middle to middle of two neighbours is.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from geoorbit_ros.lanes.estimators.curvilinear.centerlines import Centerline
from geoorbit_ros.lanes.estimators.curvilinear.grouped import quantile

TYPICAL_WIDTH_M = (3.25, 3.65)
"""City streets have 3.0 to 3.5 m (NACTO Urban Street Design Guide), faster roads 3.5 to 3.75 m
(AASHTO Green Book 12 ft, German RAA, UK CD 127)."""
TYPICAL_SPEED_MPS = (14.0, 22.0)
"""Speeds of the two widths, 50 and 80 km/h; in between, the width is interpolated. Chosen: higher
takes faster roads for city streets, lower the reverse."""
TYPICAL_SIGMA_M = 0.3
"""1-sigma of a road's width around the typical one. It covers the range of the standards above."""
SPREAD_M = 0.08
"""1-sigma of lane widths within one road. Chosen: larger trusts single spacings more, smaller makes
all lanes of a road equally wide."""
SHOULDER_M = 0.6
"""A spacing larger than the road's by more than this contains a shoulder or a median.
Chosen: larger counts shoulders as lane width, smaller leaves out wide lanes."""
SPACING_RANGE_M = (2.5, 4.9)
"""Spacings of neighbouring lanes. Chosen: lanes are 2.7 to 4.5 m wide (AASHTO Green Book; UK CD
127), and drivers' offsets move centrelines by 0.2 to 0.4 m; a wider range takes in shoulders."""
PARALLEL = 0.02
"""Slope between two lanes, 1 m in 50 m, from which their spacing is not used. Chosen: larger
measures widths at ramps, smaller leaves few stations."""
MIN_COMMON_STATIONS = 4
"""One road scale. Chosen: more leave short lanes without a measured width, fewer measure noise."""


@dataclass(frozen=True, slots=True)
class Spacing:
    """Distance between the middles of two neighbouring lanes.

    Attributes:
        lanes: Numbers of both.
        value_m: Median over their common stations.
        sigma_m: 1-sigma error.
    """

    lanes: tuple[int, int]
    value_m: float
    sigma_m: float


def neighbour_spacings(lines: Sequence[Centerline], step_m: NDArray[np.float64]) -> list[Spacing]:
    """Spacings of lanes that run beside each other; lanes go by their place in `lines`.

    Args:
        lines: Centrelines.
        step_m: (J,) distance between stations.
    """
    found = []
    for a, line in enumerate(lines):
        for b in range(a + 1, len(lines)):
            spacing = _spacing(line, lines[b], float(step_m[line.station[0]]))
            if spacing is not None:
                value, sigma = spacing
                found.append(Spacing((a, b), value, sigma))
    return found


def _spacing(a: Centerline, b: Centerline, step_m: float) -> tuple[float, float] | None:
    low = max(a.station[0], b.station[0])
    high = min(a.station[-1], b.station[-1]) + 1
    if high - low < MIN_COMMON_STATIONS:
        return None
    ia, ib = (
        slice(low - a.station[0], high - a.station[0]),
        slice(low - b.station[0], high - b.station[0]),
    )
    gap = np.abs(a.d[ia] - b.d[ib])
    sigma = np.hypot(a.sigma_m[ia], b.sigma_m[ib])
    use = (gap >= SPACING_RANGE_M[0]) & (gap <= SPACING_RANGE_M[1])
    slope = np.abs(np.diff(gap)) / step_m
    use[1:] &= slope <= PARALLEL
    use[:-1] &= slope <= PARALLEL
    if use.sum() < MIN_COMMON_STATIONS:
        return None
    return float(sigma[use] ** -2 @ gap[use] / (sigma[use] ** -2).sum()), quantile(sigma[use], 0.5)


def lane_widths(
    speed_mps: NDArray[np.float64], spacings: Sequence[Spacing]
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Width and its 1-sigma error of each lane.

    Two normal priors, one in the other: the road's width around the one that is typical of its
    speed, each lane's around the road's.

    Args:
        speed_mps: (N,) speed of the traffic in each lane.
        spacings: Measured spacings between lanes, by lane number.
    """
    count = len(speed_mps)
    if count == 0:
        return np.empty(0), np.empty(0)
    typical_m = float(np.interp(speed_mps, TYPICAL_SPEED_MPS, TYPICAL_WIDTH_M).mean())
    value = np.array([s.value_m for s in spacings])
    sigma = np.array([s.sigma_m for s in spacings])
    road, road_sigma = typical_m, TYPICAL_SIGMA_M
    if len(value):
        narrow = value <= np.median(value) + SHOULDER_M
        weight = 1.0 / (sigma[narrow] ** 2 + SPREAD_M**2)
        total = TYPICAL_SIGMA_M**-2 + weight.sum()
        road = (typical_m * TYPICAL_SIGMA_M**-2 + weight @ value[narrow]) / total
        road_sigma = total**-0.5
    width = np.empty(count)
    error = np.empty(count)
    for lane in range(count):
        mine = [s for s in spacings if lane in s.lanes and s.value_m <= road + SHOULDER_M]
        # A spacing is the mean of two widths: one of them is known up to the other's spread.
        weight = np.array([1.0 / (s.sigma_m**2 + SPREAD_M**2) for s in mine])
        spacing = np.array([s.value_m for s in mine])
        prior = 1.0 / (road_sigma**2 + SPREAD_M**2)
        total = prior + weight.sum()
        width[lane] = (prior * road + weight @ spacing) / total
        error[lane] = total**-0.5
    return width, error
