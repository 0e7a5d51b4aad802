"""Candidate lanes: from where vehicles drive to the lines they follow, and what speaks for each."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from geoorbit_ros.core.lanes import LaneEvidence
from geoorbit_ros.lanes.estimators.curvilinear.centerlines import (
    LARGE_WEIGHT,
    Centerline,
    fit_centerlines,
)
from geoorbit_ros.lanes.estimators.curvilinear.density import Density, Raster, find_maxima
from geoorbit_ros.lanes.estimators.curvilinear.grouped import quantile
from geoorbit_ros.lanes.estimators.curvilinear.junctions import hand_over, is_alone, lane_directions
from geoorbit_ros.lanes.estimators.curvilinear.members import find_members, keeping_lane
from geoorbit_ros.lanes.estimators.curvilinear.profiles import STATIONS_PER_SCALE, Profiles
from geoorbit_ros.lanes.estimators.curvilinear.ridges import Ridge, separate, trace_ridges
from geoorbit_ros.lanes.estimators.curvilinear.widths import SPACING_RANGE_M
from geoorbit_ros.lanes.parameters import LaneParameters

DRIFT_M = 0.2
"""A spacing smaller than usual by more than this is drift, not a lane. Chosen: larger leaves ends
that bend to the neighbour, smaller straightens noise."""
USUAL_QUANTILE = 0.7
"""Quantile of the spacings that is the usual one. Chosen: above the median, because drift only
makes spacings smaller; larger follows outliers."""
EMPTYING = 0.75
"""Share of a lane's usual traffic below which it is emptying. Chosen: larger straightens lanes that
are merely less driven, smaller begins to straighten too late."""
EMPTY = 0.15
"""Share below which it has ended. Chosen: larger makes lanes shorter, smaller draws them on beside
the last vehicle."""
MIN_STATIONS = 6
"""Common stations (1.5 road scales) from which two lanes are compared. Chosen: fewer compare noise,
more leave short ends as they are."""


def straighten_ends(lines: Sequence[Centerline]) -> list[Centerline]:
    """Keep each emptying lane beside its busier neighbour, and end it where it is empty."""
    result = list(lines)
    traffic = np.array([line.support.sum() for line in lines])
    busiest = np.argsort(-traffic, kind="stable").tolist()
    for k in np.argsort(traffic, kind="stable").tolist():
        for other in busiest:
            if other != k:
                result[k] = _beside(result[k], result[other])
    return result


def _beside(line: Centerline, neighbour: Centerline) -> Centerline:
    low = max(line.station[0], neighbour.station[0])
    high = min(line.station[-1], neighbour.station[-1]) + 1
    if high - low < MIN_STATIONS:
        return line
    own = slice(low - line.station[0], high - line.station[0])
    there = slice(low - neighbour.station[0], high - neighbour.station[0])
    gap = line.d[own] - neighbour.d[there]
    spacing = np.abs(gap)
    if spacing.min() > SPACING_RANGE_M[1]:
        return line
    usual = spacing[(spacing >= SPACING_RANGE_M[0]) & (spacing <= SPACING_RANGE_M[1])]
    if len(usual) < max(MIN_STATIONS, 0.5 * len(spacing)):
        return line
    wanted = quantile(usual, USUAL_QUANTILE)
    drifts = spacing < wanted - DRIFT_M
    traffic = line.support[own] / max(quantile(line.support[own][~drifts], 0.5), 1e-9)
    emptying = (traffic < EMPTYING) & (neighbour.support[there] > line.support[own])
    moved = np.zeros(len(line.d), bool)
    flag = drifts & emptying
    # Only runs that reach an end of the lane: a dip in the middle is real.
    begins, ends = low == line.station[0], high == line.station[-1] + 1
    moved[own] = (_run_at_start(flag) & begins) | (_run_at_start(flag[::-1])[::-1] & ends)
    if not moved.any():
        return line
    d = line.d.copy()
    side = np.sign(np.median(gap))
    common = np.zeros(len(line.d), bool)
    common[own] = True
    d[moved] = (neighbour.d[there] + side * wanted)[moved[common]]
    keep = np.ones(len(d), bool)
    keep[own] = ~(moved[own] & (traffic < EMPTY))
    k = np.flatnonzero(keep)
    cut = slice(int(k[0]), int(k[-1]) + 1)
    return replace(
        line,
        station=line.station[cut],
        d=d[cut],
        sigma_m=line.sigma_m[cut],
        support=line.support[cut],
    )


def _run_at_start(flag: NDArray[np.bool_]) -> NDArray[np.bool_]:
    return np.asarray(np.logical_and.accumulate(flag))


BLUR_PER_SMOOTHING_M = 0.045
"""Lateral 1-sigma blur of the density per unit of theta_smoothing: 0.45 m at its default of 10.
Chosen: larger joins neighbouring lanes, smaller splits one lane of few vehicles."""
PROMINENCE_PER_ANGLE = 0.5
"""Share by which a maximum rises above the saddle beside it, per unit of theta_angle: 25 % at its
default of 0.5. Chosen: larger misses weak lanes, smaller takes noise for lanes."""
MIN_HEIGHT = 0.3
"""Vehicles per metre below which a maximum is noise. Chosen: one vehicle under a blur of 0.45 m has
0.9; larger misses vehicles far down a road, smaller follows their tails."""
FEW_BETWEEN_LANES = 0.05
"""Share of traffic between lanes that does not blur the density enough for a second round. Chosen:
larger leaves lanes blurred at ramps, smaller costs time where it changes nothing."""
MIN_LENGTH = 0.4
"""Shortest lane that is kept, in road scales: 0.3 s of travel. Chosen: longer misses
lanes at the edge of the view, shorter keeps scraps of tracks."""


@dataclass(frozen=True, slots=True)
class Candidate:
    """A lane before it has a width and a name.

    Attributes:
        corridor: Number of its corridor.
        line: Its centreline.
        vehicles: Distinct vehicles in it.
        evidence: What speaks for it.
    """

    corridor: int
    line: Centerline
    vehicles: float
    evidence: LaneEvidence


@dataclass(frozen=True, slots=True)
class Traced:
    """Ridges in the density of traffic.

    Attributes:
        density: The density.
        ridges: Those that can be lanes.
        directions: Slope of driving along each of them.
        trust: (S,) how well each sample of the profiles shows its lane's middle.
    """

    density: Density
    ridges: list[Ridge]
    directions: list[NDArray[np.float64]]
    trust: NDArray[np.float64]


def find_ridges(profiles: Profiles, large: NDArray[np.bool_], parameters: LaneParameters) -> Traced:
    """The ridges along which vehicles drive.

    Args:
        profiles: Where vehicles drive.
        large: (V,) which of them are buses or trucks.
        parameters: Theta.
    """
    raster = Raster(profiles, BLUR_PER_SMOOTHING_M * parameters.smoothing)
    prominence = PROMINENCE_PER_ANGLE * parameters.angle
    weight = profiles.weight[profiles.row]

    def trace(trust: NDArray[np.float64]) -> Traced:
        density = raster.density(weight * trust)
        maxima = find_maxima(density, MIN_HEIGHT, prominence)
        traced = trace_ridges(maxima, profiles, weight * trust)
        ridges = separate(hand_over(traced, len(profiles.station_m)))
        return Traced(density, ridges, lane_directions(ridges, profiles.step_m), trust)

    found = trace(np.where(large, LARGE_WEIGHT, 1.0)[profiles.row])
    # Once more, without the vehicles that are between lanes: they blur what they cross.
    keeping = keeping_lane(profiles, found.ridges, found.directions)
    if keeping.size and keeping.mean() < 1.0 - FEW_BETWEEN_LANES:
        return trace(found.trust * keeping)
    return replace(found, trust=found.trust * keeping)


def find_candidates(profiles: Profiles, traced: Traced) -> list[Candidate]:
    """The candidate lanes, by corridor and from left to right.

    Args:
        profiles: Where vehicles drive.
        traced: Ridges in their density.
    """
    ridges = traced.ridges
    if not ridges:
        return []
    alone = [is_alone(r, ridges) for r in ridges]
    members = find_members(profiles, ridges, traced.directions, alone)
    lines = fit_centerlines(profiles, ridges, members, traced.trust)
    found = []
    for k, line in enumerate(lines):
        length = 0.0 if line is None else (len(line.d) - 1) / STATIONS_PER_SCALE
        if line is None or length < MIN_LENGTH:
            continue
        evidence = LaneEvidence(
            float(members.evidence[k]),
            float(members.lane_share[k]),
            length,
            float(members.presence[k]),
        )
        corridor = int(profiles.corridor[line.station[0]])
        found.append(Candidate(corridor, line, float(members.vehicles[k]), evidence))
    straight = straighten_ends([c.line for c in found])
    found = [replace(c, line=line) for c, line in zip(found, straight, strict=True)]
    return sorted(found, key=lambda c: (c.corridor, -float(np.mean(c.line.d))))
