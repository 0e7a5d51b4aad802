"""Which vehicles drive in which candidate lane, and how many vehicles that really are."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from geoorbit_ros.lanes.profiles import Profiles
from geoorbit_ros.lanes.ridges import MIN_SPACING_M, Ridge

MAX_OFFSET_M = 0.5 * MIN_SPACING_M
PARALLEL = 0.05
"""Largest slope of a vehicle against its lane; a lane change in 4 s at 30 m/s peaks at 0.05."""
SAME_VEHICLE_S = 0.6
"""Headways in one lane are longer than this (HCM: saturation headway about 2 s), so two passes
closer in time are one vehicle whose track was broken or doubled."""


@dataclass(frozen=True, slots=True)
class Members:
    """The vehicles of one candidate lane.

    Attributes:
        inside: (V, J') bool, the vehicle drives in the lane, along it, at these stations of the ridge.
        crossing: (V, J') bool, the vehicle is in the lane's band but on its way across.
        vehicles: Number of distinct vehicles, old ones counting less.
        lane_share: Share of the traffic in the band that drives along the lane.
    """

    inside: NDArray[np.bool_]
    crossing: NDArray[np.bool_]
    vehicles: float
    lane_share: float


def find_members(profiles: Profiles, ridge: Ridge, support_m: float) -> Members:
    """Vehicles that drive along `ridge` for at least `support_m`."""
    cut = slice(ridge.first, ridge.first + len(ridge.d))
    smooth = np.gradient(ridge.d, profiles.step_m)
    near = profiles.seen[:, cut] & (np.abs(profiles.d[:, cut] - ridge.d) <= MAX_OFFSET_M)
    along = near & (np.abs(profiles.slope[:, cut] - smooth) <= PARALLEL)
    enough = along.sum(axis=1) * profiles.step_m >= support_m
    inside = along & enough[:, None]
    crossing = near & ~inside
    mass = float(profiles.weight @ inside.sum(axis=1))
    stray = float(profiles.weight @ crossing.sum(axis=1))
    return Members(
        inside,
        crossing,
        _distinct(profiles.t_ref_s[enough], profiles.weight[enough]),
        mass / max(mass + stray, 1e-9),
    )


def _distinct(t_ref_s: NDArray[np.float64], weight: NDArray[np.float64]) -> float:
    """Vehicles among passes, by the time at which each is at the corridor's middle."""
    if len(t_ref_s) == 0:
        return 0.0
    order = np.argsort(t_ref_s, kind="stable")
    new = np.append(True, np.diff(t_ref_s[order]) > SAME_VEHICLE_S)
    return float(np.maximum.reduceat(weight[order], np.flatnonzero(new)).sum())
