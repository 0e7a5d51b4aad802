"""The line a lane's vehicles follow, free of who happened to be seen where."""

from __future__ import annotations

import itertools
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import scipy
from numpy.typing import NDArray

from geoorbit_ros.lanes.estimators.curvilinear.grouped import changes, lengths, quantile, totals
from geoorbit_ros.lanes.estimators.curvilinear.members import Members
from geoorbit_ros.lanes.estimators.curvilinear.profiles import STATIONS_PER_SCALE, Profiles
from geoorbit_ros.lanes.estimators.curvilinear.ridges import Ridge

DRIVER_OFFSET_M = 0.3
"""1-sigma of a driver's habitual offset from the lane's middle. Chosen: larger lets vehicles say
less about the lane's place, smaller lets one unusual driver shift it."""
RESIDUAL_M = 0.25
"""1-sigma of a vehicle's wander about its own line plus what is left of the measuring noise.
Chosen: larger trusts outliers more, smaller discards good stations."""
STIFFNESS_SCALES = 2.0
"""A lane's offset from the reference line does not bend within a length of so many road scales.
Chosen: longer cuts corners at ramps, shorter follows the noise of single vehicles."""
ITERATIONS = 3
"""Rounds of the fit. Chosen: more cost time, fewer leave outliers with too much weight."""
LARGE_WEIGHT = 0.4
"""Trucks and buses locate a lane less well: their ground point depends on their unknown height.
Chosen: larger moves lanes to where trucks are seen, smaller wastes them on roads with few cars."""
STAYING = 0.5
"""Share of a lane that a vehicle must stay in it to show its shape in full: those that come late or
leave early show where they came from or went. Chosen: larger wastes vehicles, smaller bends
ends."""


@dataclass(frozen=True, slots=True)
class Centerline:
    """A lane's middle in road coordinates.

    Attributes:
        station: (K,) consecutive station numbers.
        d: (K,) metres left of the reference line.
        sigma_m: (K,) 1-sigma error.
        support: (K,) vehicles that show the lane there.
    """

    station: NDArray[np.int64]
    d: NDArray[np.float64]
    sigma_m: NDArray[np.float64]
    support: NDArray[np.float64]


def fit_centerlines(
    profiles: Profiles, ridges: Sequence[Ridge], members: Members, trust: NDArray[np.float64]
) -> list[Centerline | None]:
    """Random-effects fit d_v(s) = c(s) + b_v + noise, for all lanes at once.

    A plain mean over vehicles steps sideways wherever a vehicle with an unusual offset b_v comes
    into view or leaves; here each vehicle tells the shape c(s), and all together tell its place.

    Args:
        profiles: Lateral positions.
        ridges: The candidate lanes.
        members: Their vehicles.
        trust: (S,) how well each sample shows its lane's middle.

    Returns:
        For each ridge its line, or None when no vehicle supports two neighbouring stations.
    """
    if len(members.lane) == 0:
        return [None] * len(ridges)
    length = np.array([len(r.d) for r in ridges])
    begin = np.append(0, np.cumsum(length))
    first = np.array([r.first for r in ridges])
    lane, sample = members.lane, members.sample
    at = begin[lane] + profiles.station[sample] - first[lane]
    new = changes(profiles.row[sample]) | changes(lane)
    driver, entry = np.cumsum(new) - 1, np.flatnonzero(new)
    of_driver = lane[entry]
    weight = profiles.weight[profiles.row[sample]] * trust[sample]
    base = np.maximum.reduceat(weight, entry)
    share = lengths(entry, len(lane)) / length[of_driver]
    stay = np.minimum(share / STAYING, 1.0)[driver]
    weight = weight * stay
    d = profiles.d[sample]
    smoother = _Smoother(begin, totals(at, weight, begin[-1]))
    centre, offset = np.concatenate([r.d for r in ridges]), np.zeros(len(entry))
    for _ in range(ITERATIONS):
        own = d - centre[at]
        # Huber-type weights on single stations, then the shrunken mean offset of each vehicle.
        residual = np.abs(own - offset[driver])
        robust = weight / np.maximum(1.0, residual * (0.5 / RESIDUAL_M))
        mass = np.add.reduceat(robust, entry)
        # Stations of one vehicle are correlated over about a kernel width (four stations).
        shrink = (mass / 4.0) / (mass / 4.0 + (RESIDUAL_M / DRIVER_OFFSET_M) ** 2)
        offset = shrink * np.add.reduceat(robust * own, entry) / np.maximum(mass, 1e-9)
        offset -= _robust_means(offset, base, of_driver, len(ridges))[of_driver]
        mass = totals(at, robust, begin[-1])
        target = totals(at, robust * (d - offset[driver]), begin[-1])
        centre = smoother.smooth(target / np.maximum(mass, 1e-9), mass)
    support = totals(at, robust / stay, begin[-1])
    driver_weight = totals(of_driver, base, len(ridges))
    lines: list[Centerline | None] = []
    for k in range(len(ridges)):
        cut = slice(begin[k], begin[k + 1])
        best = base[of_driver == k].max(initial=0.0)
        lines.append(
            _line(int(first[k]), centre[cut], support[cut], float(driver_weight[k]), float(best))
        )
    return lines


def _line(
    first: int,
    centre: NDArray[np.float64],
    support: NDArray[np.float64],
    driver_weight: float,
    best: float,
) -> Centerline | None:
    """The part of a fit that vehicles support, with its error."""
    k = np.flatnonzero(support >= max(0.8 * min(best, 1.0), 0.1 * float(support.max()), 1e-6))
    if len(k) == 0 or k[-1] == k[0]:
        return None
    k = np.arange(k[0], k[-1] + 1)
    sigma = np.sqrt(
        DRIVER_OFFSET_M**2 / max(driver_weight, 0.5) + RESIDUAL_M**2 / np.maximum(support[k], 0.5)
    )
    return Centerline(first + k, centre[k], sigma, support[k])


def _robust_means(
    value: NDArray[np.float64], weight: NDArray[np.float64], group: NDArray[np.int64], groups: int
) -> NDArray[np.float64]:
    """(groups,) weighted means, with Huber weights at one driver's offset around the median."""
    order = np.lexsort((value, group))
    share = np.cumsum(weight[order])
    total = totals(group, weight, groups)
    until = np.cumsum(total)
    middle = np.searchsorted(share, until - 0.5 * total)
    centre = value[order][np.minimum(middle, len(value) - 1)]
    w = weight / np.maximum(1.0, np.abs(value - centre[group]) / (1.5 * DRIVER_OFFSET_M))
    mean = totals(group, w * value, groups) / np.maximum(totals(group, w, groups), 1e-12)
    return np.asarray(mean)


class _Smoother:
    """Penalised least squares with second differences (Eilers 2003, Analytical Chemistry 75).

    Args:
        begin: (R + 1,) line k is `slice(begin[k], begin[k + 1])` of all values, at least 4 of them.
        weight: (N,) of the values; each line's median sets how stiff it is.
    """

    def __init__(self, begin: NDArray[np.int64], weight: NDArray[np.float64]) -> None:
        first, last = begin[:-1], begin[1:] - 1
        stiffness = (STIFFNESS_SCALES * STATIONS_PER_SCALE / (2.0 * np.pi)) ** 4
        usual = [max(quantile(weight[a:b], 0.5), 1e-3) for a, b in itertools.pairwise(begin)]
        penalty = np.repeat(stiffness * np.array(usual), np.diff(begin))
        bands = np.zeros((3, len(weight)))
        bands[2] = 6.0 * penalty
        bands[1] = -4.0 * penalty
        bands[0] = penalty
        for end, inner in ((first, first + 1), (last, last - 1)):
            bands[2, end] -= 5.0 * penalty[end]
            bands[2, inner] -= penalty[inner]
        for near in (first + 1, last):
            bands[1, near] += 2.0 * penalty[near]
        # A line's values don't touch those of the line before.
        bands[1, first] = bands[0, first] = bands[0, first + 1] = 0.0
        self._bands = bands

    def smooth(
        self, target: NDArray[np.float64], weight: NDArray[np.float64]
    ) -> NDArray[np.float64]:
        """All lines, smoothed."""
        bands = self._bands.copy()
        bands[2] += weight + 1e-9
        # LAPACK's own banded Cholesky: scipy's checks around it cost more than the solution.
        _, solution, info = scipy.linalg.lapack.dpbsv(bands, weight * target)
        if info != 0:
            raise ArithmeticError(f"smoothing of {len(weight)} stations: not positive definite")
        return np.asarray(solution)
