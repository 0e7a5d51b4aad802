"""Candidate lanes: from where vehicles drive to the lines they follow, and what speaks for each."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from geoorbit_ros.lanes.centerlines import LARGE_WEIGHT, Centerline, fit_centerlines
from geoorbit_ros.lanes.confidence import LaneEvidence
from geoorbit_ros.lanes.density import Density, Raster, find_crests
from geoorbit_ros.lanes.junctions import hand_over, is_alone, lane_directions
from geoorbit_ros.lanes.lane_ends import straighten_ends
from geoorbit_ros.lanes.members import find_members, keeping_lane
from geoorbit_ros.lanes.parameters import LaneParameters
from geoorbit_ros.lanes.profiles import STATIONS_PER_SCALE, Profiles
from geoorbit_ros.lanes.ridges import Ridge, separate, trace_ridges

BLUR_PER_SMOOTHING_M = 0.045
PROMINENCE_PER_ANGLE = 0.5
MIN_HEIGHT = 0.3
FEW_BETWEEN_LANES = 0.05
MIN_LENGTH = 0.4
"""Shortest lane worth showing, in road scales: half a second of travel."""


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
        ridges: Its crests that can be lanes.
        directions: Slope of driving along each of them.
        trust: (S,) how well each sample of the profiles shows its lane's middle.
    """

    density: Density
    ridges: list[Ridge]
    directions: list[NDArray[np.float64]]
    trust: NDArray[np.float64]


def find_ridges(profiles: Profiles, large: NDArray[np.bool_], parameters: LaneParameters) -> Traced:
    """The crests along which vehicles drive.

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
        crests = find_crests(density, MIN_HEIGHT, prominence)
        traced = trace_ridges(crests, profiles, weight * trust)
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
