"""Which vehicles drive in which candidate lane, and how many vehicles that really are."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from geoorbit_ros.lanes.estimators.curvilinear.grouped import totals
from geoorbit_ros.lanes.estimators.curvilinear.profiles import STATIONS_PER_SCALE, Profiles
from geoorbit_ros.lanes.estimators.curvilinear.ridges import MIN_SPACING_M, Ridge, table

MAX_OFFSET_M = 0.5 * MIN_SPACING_M
"""From the ridge to a vehicle in the lane: half-way to the nearest neighbour that may be."""
SIDEWAYS_M = 0.5
"""A vehicle that moves sideways by more than this over one road scale is changing lanes. Chosen:
larger lets lane changes bend a lane, smaller throws out vehicles of noisy tracks."""
SIDEWAYS_ALONE_M = 1.5
"""The same where no other lane is near, so that only the slope's own error matters. Chosen:
larger takes crossing vehicles in, smaller throws out noisy tracks."""
MIN_SUPPORT = 0.6
"""Length in road scales that a vehicle must be seen in a lane to be its member. Chosen:
longer loses lanes at the edge of the view, shorter counts vehicles that cross the lane."""
FULL_SUPPORT = 1.25
"""Length in road scales over which a vehicle must be seen in a lane to count in full. Chosen:
longer confirms short lanes later, shorter counts scraps of tracks as vehicles."""
BAND_M = 6.0
"""Half-width of the band, a lane and its neighbours, in which traffic is compared. Chosen: wider
compares with other lanes than the neighbours, narrower with the lane alone."""
SAME_VEHICLE_S = 0.6
"""Headways in one lane are longer than this (HCM: saturation headway about 2 s), so two segments
closer in time are one vehicle whose track was broken or doubled."""


@dataclass(frozen=True, slots=True)
class Members:
    """The vehicles of R candidate lanes.

    Attributes:
        lane: (M,) ascending; lane and sample together say who drives along which lane where.
        sample: (M,) numbers of samples of the profiles, ascending within a lane.
        vehicles: (R,) number of distinct vehicles, old ones counting less.
        evidence: (R,) the same, a vehicle seen over a short stretch counting less.
        lane_share: (R,) share of the traffic in the lane's band that drives along it, not across.
        presence: (R,) traffic in and beside the lane, as a share of the most seen in that band
            anywhere along the corridor; small where vehicles fade from the camera's sight.
    """

    lane: NDArray[np.int64]
    sample: NDArray[np.int64]
    vehicles: NDArray[np.float64]
    evidence: NDArray[np.float64]
    lane_share: NDArray[np.float64]
    presence: NDArray[np.float64]


def find_members(
    profiles: Profiles,
    ridges: Sequence[Ridge],
    directions: Sequence[NDArray[np.float64]],
    alone: Sequence[bool],
) -> Members:
    """Vehicles that drive along each ridge for a while.

    Args:
        profiles: All vehicles.
        ridges: The candidate lanes.
        directions: Slope dd/ds that driving along each of them has at each of its stations.
        alone: Whether no other lane is beside it, so that sideways movement is no lane change.
    """
    stations, rows = len(profiles.station_m), len(profiles.segment)
    middle = table(ridges, [r.d for r in ridges], stations, np.inf)
    direction = table(ridges, directions, stations, 0.0)
    near = [
        np.flatnonzero(np.abs(profiles.d - line[profiles.station]) <= MAX_OFFSET_M)
        for line in middle
    ]
    lane, sample = np.repeat(np.arange(len(near)), [len(k) for k in near]), np.concatenate(near)
    row, station = profiles.row[sample], profiles.station[sample]
    sideways_m = np.where(alone, SIDEWAYS_ALONE_M, SIDEWAYS_M)[lane]
    turned = np.abs(profiles.slope[sample] - direction[lane, station])
    along = turned <= sideways_m / profiles.scale_m[station]
    pair = lane * rows + row
    length = totals(pair, along, len(ridges) * rows) / STATIONS_PER_SCALE
    enough = length >= MIN_SUPPORT
    inside = along & enough[pair]
    traffic = totals(lane, profiles.weight[row], len(ridges))
    mass = totals(lane, profiles.weight[row] * inside, len(ridges))
    lane, sample = lane[inside], sample[inside]
    vehicles, evidence = _distinct(profiles, ridges, lane, sample, enough)
    return Members(
        lane,
        sample,
        vehicles,
        evidence,
        mass / np.maximum(traffic, 1e-9),
        _presence(profiles, ridges, lane, sample),
    )


def keeping_lane(
    profiles: Profiles, ridges: Sequence[Ridge], directions: Sequence[NDArray[np.float64]]
) -> NDArray[np.float64]:
    """(S,) weight in (0, 1]: small where a vehicle moves across the lane nearest to it.

    Args:
        profiles: All vehicles.
        ridges: Candidate lanes.
        directions: Slope of driving along each of them.
    """
    if not ridges:
        return np.ones(len(profiles.d))
    stations = len(profiles.station_m)
    middle = table(ridges, [r.d for r in ridges], stations, np.inf)
    direction = table(ridges, directions, stations, 0.0)
    nearest, expected = np.full(len(profiles.d), MIN_SPACING_M), profiles.slope.copy()
    for line, slope in zip(middle, direction, strict=True):
        away = np.abs(profiles.d - line[profiles.station])
        closer = np.flatnonzero(away < nearest)
        nearest[closer] = away[closer]
        expected[closer] = slope[profiles.station[closer]]
    across = (profiles.slope - expected) * profiles.scale_m[profiles.station]
    across /= 0.6 * SIDEWAYS_M
    across *= across
    return np.asarray(1.0 / (1.0 + across * across))


def _presence(
    profiles: Profiles,
    ridges: Sequence[Ridge],
    lane: NDArray[np.int64],
    sample: NDArray[np.int64],
) -> NDArray[np.float64]:
    stations = len(profiles.station_m)
    weight = profiles.weight[profiles.row]
    cell = lane * stations + profiles.station[sample]
    own = totals(cell, weight[sample], len(ridges) * stations).reshape(len(ridges), stations)
    result = np.zeros(len(ridges))
    for k, ridge in enumerate(ridges):
        here = np.flatnonzero(profiles.corridor == profiles.corridor[ridge.first])
        middle = np.full(stations, np.inf)
        middle[here] = np.interp(here, ridge.stations, ridge.d)
        band = np.abs(profiles.d - middle[profiles.station]) <= BAND_M
        traffic = totals(profiles.station, weight * band, stations)
        # Where its own vehicles are: a busy lane stays one though a few are seen far beyond.
        result[k] = own[k] @ traffic / max(own[k].sum() * traffic.max(), 1e-9)
    return result


def _distinct(
    profiles: Profiles,
    ridges: Sequence[Ridge],
    lane: NDArray[np.int64],
    sample: NDArray[np.int64],
    member: NDArray[np.bool_],
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Vehicles per lane among segments, told apart by when each is at the corridor's middle.

    Args:
        profiles: All vehicles.
        ridges: The R candidate lanes.
        lane: Lane of each member's sample.
        sample: Its sample.
        member: (R V,) which rows are members of which lanes.
    """
    rows = len(profiles.segment)
    pair = np.flatnonzero(member)
    if len(pair) == 0:
        return np.zeros(len(ridges)), np.zeros(len(ridges))
    owner, time_s = pair // rows, profiles.t_ref_s[pair % rows]
    order = np.lexsort((time_s, owner))
    pair, owner = pair[order], owner[order]
    new = np.append(True, (np.diff(time_s[order]) > SAME_VEHICLE_S) | (np.diff(owner) != 0))
    first = np.flatnonzero(new)
    vehicle = np.zeros(len(member), np.int64)
    vehicle[pair] = np.cumsum(new) - 1
    weight = np.maximum.reduceat(profiles.weight[pair % rows], first)
    hit = np.zeros((len(first), len(profiles.station_m)), bool)
    hit[vehicle[lane * rows + profiles.row[sample]], profiles.station[sample]] = True
    length = np.array([len(r.d) for r in ridges]) / STATIONS_PER_SCALE
    wanted = np.minimum(FULL_SUPPORT, 0.5 * length)[owner[first]]
    share = np.minimum(1.0, hit.sum(axis=1) / STATIONS_PER_SCALE / wanted)
    return (
        totals(owner[first], weight, len(ridges)),
        totals(owner[first], weight * share, len(ridges)),
    )
