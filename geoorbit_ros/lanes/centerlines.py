"""The line a lane's vehicles follow, free of who happened to be seen where."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.linalg.lapack import dpbsv

from geoorbit_ros.lanes.members import Members
from geoorbit_ros.lanes.profiles import Profiles
from geoorbit_ros.lanes.ridges import Ridge

DRIVER_OFFSET_M = 0.3
"""1-sigma of a driver's habitual offset from the lane's middle."""
RESIDUAL_M = 0.25
"""1-sigma of a vehicle's wander about its own line plus what is left of the measuring noise."""
ITERATIONS = 3
LARGE_WEIGHT = 0.4
"""Trucks and buses locate a lane less well: their ground point depends on their unknown height."""


@dataclass(frozen=True, slots=True)
class Centerline:
    """A lane's middle in road coordinates.

    Attributes:
        station: (K,) consecutive station numbers.
        d: (K,) metres left of the spine.
        sigma_m: (K,) 1-sigma error.
        support: (K,) vehicles that show the lane there.
    """

    station: NDArray[np.int64]
    d: NDArray[np.float64]
    sigma_m: NDArray[np.float64]
    support: NDArray[np.float64]


def fit_centerline(
    profiles: Profiles,
    ridge: Ridge,
    members: Members,
    trust: NDArray[np.float64],
    stiffness_m: float,
) -> Centerline | None:
    """Random-effects fit d_v(s) = c(s) + b_v + noise.

    A plain mean over vehicles steps sideways wherever a vehicle with an unusual offset b_v comes
    into view or leaves; here each vehicle tells the shape c(s), and all together tell its place.

    Args:
        profiles: Lateral positions.
        ridge: The candidate lane.
        members: Its vehicles.
        trust: (V, J) how well each vehicle shows its lane's middle at each station.
        stiffness_m: Length below which the lane's offset from the spine is not expected to bend.

    Returns:
        None when no vehicle supports two neighbouring stations.
    """
    cut = slice(ridge.first, ridge.first + len(ridge.d))
    mine = np.flatnonzero(members.inside.any(axis=1))
    if len(mine) == 0:
        return None
    weight = members.inside[mine] * profiles.weight[mine, None] * trust[mine, cut]
    base = weight.max(axis=1)
    d = profiles.d[mine, cut]
    centre, offset = ridge.d.copy(), np.zeros(len(mine))
    for _ in range(ITERATIONS):
        residual = d - centre - offset[:, None]
        # Huber-type weights on single stations, then the shrunken mean offset of each vehicle.
        robust = weight / np.maximum(1.0, np.abs(residual) / (2.0 * RESIDUAL_M))
        mass = robust.sum(axis=1)
        # Stations of one vehicle are correlated over about a kernel width (four stations).
        shrink = (mass / 4.0) / (mass / 4.0 + (RESIDUAL_M / DRIVER_OFFSET_M) ** 2)
        offset = shrink * (robust * (d - centre)).sum(axis=1) / np.maximum(mass, 1e-9)
        offset -= _robust_mean(offset, base)
        support = robust.sum(axis=0)
        target = (robust * (d - offset[:, None])).sum(axis=0) / np.maximum(support, 1e-9)
        centre = _whittaker(target, support, stiffness_m / profiles.step_m)
    lanes_worth = float(base.sum())
    enough = support >= max(0.8 * min(base.max(), 1.0), 0.1 * support.max())
    if not enough.any():
        return None
    k = np.flatnonzero(enough)
    k = np.arange(k[0], k[-1] + 1)
    if len(k) < 2:
        return None
    sigma = np.sqrt(
        DRIVER_OFFSET_M**2 / max(lanes_worth, 0.5) + RESIDUAL_M**2 / np.maximum(support[k], 0.5)
    )
    return Centerline(ridge.first + k, centre[k], sigma, support[k])


def _robust_mean(value: NDArray[np.float64], weight: NDArray[np.float64]) -> float:
    """Weighted mean with Huber weights at one driver's offset around the weighted median."""
    order = np.argsort(value, kind="stable")
    share = np.cumsum(weight[order])
    centre = value[order][np.searchsorted(share, 0.5 * share[-1])]
    w = weight / np.maximum(1.0, np.abs(value - centre) / (1.5 * DRIVER_OFFSET_M))
    return float((w * value).sum() / w.sum())


def _whittaker(
    target: NDArray[np.float64], weight: NDArray[np.float64], length: float
) -> NDArray[np.float64]:
    """Penalised least squares with second differences (Eilers 2003, Analytical Chemistry 75)."""
    n = len(target)
    if n < 4:
        return target
    penalty = (length / (2.0 * np.pi)) ** 4 * max(float(np.median(weight)), 1e-3)
    bands = np.zeros((3, n))
    bands[2] = weight + 1e-9 + penalty * 6.0
    bands[2, [0, -1]] -= penalty * 5.0
    bands[2, [1, -2]] -= penalty
    bands[1, 1:] = penalty * -4.0
    bands[1, [1, -1]] += penalty * 2.0
    bands[0, 2:] = penalty
    # LAPACK's own banded Cholesky: scipy's checks around it cost more than the solution.
    _, solution, info = dpbsv(bands, weight * target)
    if info != 0:
        raise ArithmeticError(f"smoothing of {n} stations: band matrix not positive definite")
    return np.asarray(solution)
