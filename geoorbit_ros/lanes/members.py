"""Which vehicles drive in which candidate lane, and how many vehicles that really are."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from geoorbit_ros.lanes.profiles import Profiles
from geoorbit_ros.lanes.ridges import MIN_SPACING_M, Ridge

MAX_OFFSET_M = 0.5 * MIN_SPACING_M
SIDEWAYS_M = 0.5
"""A vehicle that moves sideways by more than this over one road scale is changing lanes."""
MIN_SUPPORT = 0.6
"""Length in road scales that a vehicle must be seen in a lane to be its member."""
BAND_M = 6.0
"""Half-width of the band, a lane and its neighbours, in which traffic is compared."""
SAME_VEHICLE_S = 0.6
"""Headways in one lane are longer than this (HCM: saturation headway about 2 s), so two passes
closer in time are one vehicle whose track was broken or doubled."""


SIDEWAYS_ALONE_M = 1.5
"""The same where no other lane is near, so that only the slope's own error matters."""
FULL_SUPPORT = 1.25
"""Length in road scales over which a vehicle must be seen in a lane to count in full."""


@dataclass(frozen=True, slots=True)
class Members:
    """The vehicles of one candidate lane.

    Attributes:
        inside: (V, J') bool, the vehicle drives along the lane at these stations of the ridge.
        vehicles: Number of distinct vehicles, old ones counting less.
        evidence: The same, a vehicle seen over a short stretch counting less.
        lane_share: Share of the traffic in the lane's band that drives along it, not across.
        presence: Traffic in and beside the lane, as a share of the most seen in that band anywhere
            along the corridor; small where vehicles fade from the camera's sight.
    """

    inside: NDArray[np.bool_]
    vehicles: float
    evidence: float
    lane_share: float
    presence: float


def find_members(
    profiles: Profiles,
    ridge: Ridge,
    direction: NDArray[np.float64],
    scale_m: float,
    alone: bool = False,
) -> Members:
    """Vehicles that drive along `ridge` for a while.

    Args:
        profiles: All vehicles of the corridor.
        ridge: The candidate lane.
        direction: (J',) slope dd/ds that driving along the lane has at each of its stations.
        scale_m: The corridor's scale.
        alone: No other lane is beside this one, so that sideways movement is no lane change.
    """
    cut = slice(ridge.first, ridge.first + len(ridge.d))
    sideways_m = SIDEWAYS_ALONE_M if alone else SIDEWAYS_M
    offset = profiles.d[:, cut] - ridge.d
    near = profiles.seen[:, cut] & (np.abs(offset) <= MAX_OFFSET_M)
    along = near & (np.abs(profiles.slope[:, cut] - direction) <= sideways_m / scale_m)
    enough = along.sum(axis=1) * profiles.step_m >= MIN_SUPPORT * scale_m
    inside = along & enough[:, None]
    mass = float(profiles.weight @ inside.sum(axis=1))
    stray = float(profiles.weight @ (near & ~inside).sum(axis=1))
    wanted_m = min(FULL_SUPPORT * scale_m, 0.5 * len(ridge.d) * profiles.step_m)
    vehicles, evidence = _distinct(profiles, inside, enough, wanted_m)
    return Members(
        inside,
        vehicles,
        evidence,
        mass / max(mass + stray, 1e-9),
        _presence(profiles, ridge, inside),
    )


def keeping_lane(
    profiles: Profiles,
    ridges: Sequence[Ridge],
    directions: Sequence[NDArray[np.float64]],
    scale_m: float,
) -> NDArray[np.float64]:
    """(V, J) weight in (0, 1]: small where a vehicle moves across the lane nearest to it.

    Args:
        profiles: All vehicles of the corridor.
        ridges: Candidate lanes.
        directions: Slope of driving along each of them.
        scale_m: The corridor's scale.
    """
    shape = profiles.seen.shape
    nearest = np.full(shape, MIN_SPACING_M)
    direction = profiles.slope.copy()
    for ridge, slope in zip(ridges, directions, strict=True):
        cut = slice(ridge.first, ridge.first + len(ridge.d))
        offset = np.abs(profiles.d[:, cut] - ridge.d)
        closer = offset < nearest[:, cut]
        nearest[:, cut] = np.where(closer, offset, nearest[:, cut])
        direction[:, cut] = np.where(closer, slope, direction[:, cut])
    across = (profiles.slope - direction) / (0.6 * SIDEWAYS_M / scale_m)
    return np.asarray(1.0 / (1.0 + across**4))


def _presence(profiles: Profiles, ridge: Ridge, inside: NDArray[np.bool_]) -> float:
    middle = np.interp(np.arange(profiles.seen.shape[1]), ridge.stations, ridge.d)
    band = profiles.seen & (np.abs(profiles.d - middle) <= BAND_M)
    traffic = profiles.weight @ band
    cut = slice(ridge.first, ridge.first + len(ridge.d))
    # Where its own vehicles are: a busy lane stays one though a few are seen far beyond.
    own = profiles.weight @ inside
    return float((own @ traffic[cut]) / max(own.sum() * traffic.max(), 1e-9))


def _distinct(
    profiles: Profiles,
    inside: NDArray[np.bool_],
    member: NDArray[np.bool_],
    wanted_m: float,
) -> tuple[float, float]:
    """Vehicles among passes, told apart by when each is at the corridor's middle."""
    if not member.any():
        return 0.0, 0.0
    order = np.flatnonzero(member)[np.argsort(profiles.t_ref_s[member], kind="stable")]
    gap = np.diff(profiles.t_ref_s[order])
    first = np.flatnonzero(np.append(True, gap > SAME_VEHICLE_S))
    weight = np.maximum.reduceat(profiles.weight[order], first)
    stations = np.logical_or.reduceat(inside[order], first, axis=0).sum(axis=1)
    share = np.minimum(1.0, stations * profiles.step_m / wanted_m)
    return float(weight.sum()), float(weight @ share)
