"""The lane estimator that users get: lanes as crests of traffic density along curved roads.

Per update: passes (condensed tracks) -> corridors (streams with a reference curve) -> lateral
profiles -> density over (s, d) -> crests -> members -> centrelines -> widths. Nothing in it knows
an axis: it depends on distances and angles between vehicles alone.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from geoorbit_ros.core.lanes import CrossSection, Lane, LaneMap
from geoorbit_ros.lanes.centerlines import LARGE_WEIGHT, Centerline, fit_centerline
from geoorbit_ros.lanes.confidence import LaneEvidence, judge
from geoorbit_ros.lanes.corridors import Corridor, find_corridors
from geoorbit_ros.lanes.density import Density, find_crests, lateral_density
from geoorbit_ros.lanes.evidence import Evidence
from geoorbit_ros.lanes.identity import LaneRegistry
from geoorbit_ros.lanes.increment import LaneCounter
from geoorbit_ros.lanes.junctions import hand_over, is_alone, lane_directions
from geoorbit_ros.lanes.lane_ends import straighten_ends
from geoorbit_ros.lanes.members import find_members, keeping_lane
from geoorbit_ros.lanes.parameters import LaneParameters
from geoorbit_ros.lanes.passes import Passes
from geoorbit_ros.lanes.profiles import Profiles, lateral_profiles
from geoorbit_ros.lanes.ridges import Ridge, separate, trace_ridges
from geoorbit_ros.lanes.spine import Spine
from geoorbit_ros.lanes.widths import lane_widths, neighbour_spacings

BLUR_PER_SMOOTHING_M = 0.045
PROMINENCE_PER_ANGLE = 0.5
MIN_HEIGHT = 0.3
FEW_BETWEEN_LANES = 0.05
MIN_LENGTH = 0.4
"""Shortest lane worth showing, in road scales: half a second of travel."""
GROWTH = 1.0
MAX_GROWTH = 100
"""Share, and number of passes, by which the evidence grows before a derivation: a centreline's
error shrinks with the root of the traffic, so less would hardly move it."""
RETRACE = 0.1
"""Share of the evidence that must be new for the reference curves to be traced anew."""
STRAYS = 3
STRAY_SHARE = 0.4
"""Vehicles outside all known lanes, and their share of the new ones, that call for a derivation."""


@dataclass(frozen=True, slots=True)
class _Candidate:
    """A lane of one corridor before it has a width and a name."""

    corridor: int
    line: Centerline
    vehicles: float
    evidence: LaneEvidence


@dataclass(frozen=True, slots=True)
class _Derived:
    """The last map derived in full, and what is needed to count on from it."""

    lane_map: LaneMap
    parameters: LaneParameters
    evidence: dict[int, LaneEvidence]
    counter: LaneCounter
    passes: int
    finished: int


class CurvilinearEstimator:
    """`LaneEstimator` for any heading, bends, ramps, both directions and sparse lanes."""

    def __init__(self) -> None:
        self._evidence = Evidence()
        self._registry = LaneRegistry()
        self._spines: list[tuple[Spine, float]] = []
        self._traced = 0
        self._last: _Derived | None = None

    def add(self, stamp_ns: int, rows: NDArray[np.void]) -> None:
        """Take one frame of `TRACK_DTYPE` rows; stamps increase from call to call."""
        self._evidence.add(stamp_ns, rows)

    def lanes(self, parameters: LaneParameters) -> LaneMap:
        """The lanes as the evidence stands now; see the module's text for the method."""
        passes, worth = self._evidence.passes()
        stamp_ns = self._evidence.stamp_ns
        if len(passes) == 0:
            return LaneMap(stamp_ns, ())
        corridors = self._corridors(passes)
        blur_m = BLUR_PER_SMOOTHING_M * parameters.smoothing
        prominence = PROMINENCE_PER_ANGLE * parameters.angle
        candidates: list[_Candidate] = []
        sections: list[CrossSection] = []
        grids: list[Profiles] = []
        for k, corridor in enumerate(corridors):
            profiles = lateral_profiles(corridor, passes, worth)
            grids.append(profiles)
            if not profiles.seen.any():
                continue
            found, density = _candidates(
                k, corridor, profiles, passes.large[profiles.passes], blur_m, prominence
            )
            candidates.extend(found)
            if found:
                sections.append(_cross_section(corridor, profiles, density, found))
        lanes = _shapes(candidates, corridors, grids, parameters.width_scale)
        matched = self._registry.match(lanes)
        lanes = [
            judge(lane, candidate.evidence, old is not None and old.status == "confirmed")
            for lane, candidate, old in zip(lanes, candidates, matched, strict=True)
        ]
        named = self._registry.identify(lanes, matched)
        lane_map = LaneMap(stamp_ns, tuple(sorted(named, key=lambda k: k.lane_id)), tuple(sections))
        self._last = _Derived(
            lane_map,
            parameters,
            {lane.lane_id: c.evidence for lane, c in zip(named, candidates, strict=True)},
            LaneCounter(lane_map.lanes),
            len(passes),
            self._evidence.finished_ever,
        )
        return lane_map

    def update(self, parameters: LaneParameters) -> LaneMap:
        """Count new vehicles into the last map, or derive it anew when that is worth it.

        A derivation costs time in proportion to the evidence, which is bounded; done once per so
        many vehicles, it costs the same per vehicle however long the camera has run.
        """
        last = self._last
        self._evidence.settle()
        if last is None or last.parameters != parameters:
            return self.lanes(parameters)
        fresh = self._evidence.finished_after(last.finished, last.lane_map.stamp_ns)
        counts, elsewhere = last.counter.count(fresh)
        grown = self._evidence.finished_ever - last.finished
        if grown >= min(GROWTH * last.passes, MAX_GROWTH) or elsewhere >= max(
            STRAYS, STRAY_SHARE * len(fresh)
        ):
            return self.lanes(parameters)
        lanes = []
        for lane, count in zip(last.lane_map.lanes, counts.tolist(), strict=True):
            evidence = last.evidence[lane.lane_id]
            more = replace(lane, vehicles=lane.vehicles + count)
            seen = replace(evidence, vehicles=evidence.vehicles + count)
            lanes.append(judge(more, seen, lane.status == "confirmed"))
        self._registry.identify(lanes, lanes)
        return replace(last.lane_map, stamp_ns=self._evidence.stamp_ns, lanes=tuple(lanes))

    def _corridors(self, passes: Passes) -> list[Corridor]:
        """Corridors along the known reference curves; these are traced anew as evidence grows."""
        fresh = self._evidence.finished_ever - self._traced
        if not self._spines or fresh >= RETRACE * len(passes):
            corridors = find_corridors(passes)
            self._traced = self._evidence.finished_ever
        else:
            corridors = find_corridors(passes, self._spines)
        self._spines = [(c.spine, c.speed_mps) for c in corridors]
        return corridors


def _candidates(
    number: int,
    corridor: Corridor,
    profiles: Profiles,
    large: NDArray[np.bool_],
    blur_m: float,
    prominence: float,
) -> tuple[list[_Candidate], Density]:
    """The candidate lanes of one corridor, from left to right, and the density they crest in."""
    trust = np.where(large, LARGE_WEIGHT, 1.0)[:, None] * np.ones(profiles.seen.shape)
    density, ridges, directions = _crests(profiles, trust, blur_m, prominence)
    # Once more, without the vehicles that are between lanes: they blur what they cross.
    keeping = keeping_lane(profiles, ridges, directions, corridor.scale_m)
    trust *= keeping
    if np.mean(keeping[profiles.seen]) < 1.0 - FEW_BETWEEN_LANES:
        density, ridges, directions = _crests(profiles, trust, blur_m, prominence)
    found = []
    for ridge, direction in zip(ridges, directions, strict=True):
        alone = is_alone(ridge, ridges)
        members = find_members(profiles, ridge, direction, corridor.scale_m, alone)
        line = fit_centerline(profiles, ridge, members, trust, 2.0 * corridor.scale_m)
        length_m = 0.0 if line is None else (len(line.d) - 1) * profiles.step_m
        if line is not None and length_m >= MIN_LENGTH * corridor.scale_m:
            evidence = LaneEvidence(
                members.evidence,
                members.lane_share,
                length_m / corridor.scale_m,
                members.presence,
            )
            found.append(_Candidate(number, line, members.vehicles, evidence))
    lines = straighten_ends([c.line for c in found])
    found = [replace(c, line=line) for c, line in zip(found, lines, strict=True)]
    return sorted(found, key=lambda c: -float(np.mean(c.line.d))), density


def _crests(
    profiles: Profiles, trust: NDArray[np.float64], blur_m: float, prominence: float
) -> tuple[Density, list[Ridge], list[NDArray[np.float64]]]:
    """Density, the crests in it that can be lanes, and the direction of driving along each."""
    density = lateral_density(profiles, blur_m, trust)
    traced = trace_ridges(find_crests(density, MIN_HEIGHT, prominence))
    ridges = separate(hand_over(traced, len(profiles.station_m)))
    return density, ridges, lane_directions(ridges, profiles.step_m)


def _shapes(
    candidates: list[_Candidate],
    corridors: list[Corridor],
    grids: list[Profiles],
    width_scale: float,
) -> list[Lane]:
    """Widths and boundaries; ids and verdicts are still open."""
    spacings = []
    for k, grid in enumerate(grids):
        mine = [i for i, c in enumerate(candidates) if c.corridor == k]
        lines = [candidates[i].line for i in mine]
        spacings += neighbour_spacings(lines, grid.step_m, mine)
    speed = np.array([corridors[c.corridor].speed_mps for c in candidates])
    width, error = lane_widths(speed, spacings)
    lanes = []
    for i, candidate in enumerate(candidates):
        spine = corridors[candidate.corridor].spine
        s = grids[candidate.corridor].station_m[candidate.line.station]
        d, half = candidate.line.d, 0.5 * width_scale * width[i]
        lanes.append(
            Lane(
                lane_id=0,
                centerline_m=spine.to_map(s, d),
                left_m=spine.to_map(s, d + half),
                right_m=spine.to_map(s, d - half),
                width_m=2.0 * half,
                width_sigma_m=width_scale * float(error[i]),
                confidence=0.0,
                status="tentative",
                vehicles=candidate.vehicles,
                sigma_m=float(np.mean(candidate.line.sigma_m)),
            )
        )
    return lanes


def _cross_section(
    corridor: Corridor, profiles: Profiles, density: Density, found: list[_Candidate]
) -> CrossSection:
    """The corridor's lateral histogram where most of its lanes are seen."""
    seen = np.zeros(len(profiles.station_m))
    for c in found:
        seen[c.line.station] += c.vehicles
    at = np.flatnonzero(seen == seen.max())
    heading = corridor.spine.heading_at(profiles.station_m[at])
    peaks = [
        float(np.mean(c.line.d[np.isin(c.line.station, at)]))
        for c in found
        if np.isin(c.line.station, at).any()
    ]
    mean = np.arctan2(np.sin(heading).mean(), np.cos(heading).mean())
    return CrossSection(
        float((90.0 - np.degrees(mean)) % 360.0),
        density.offset_m,
        density.value[at].mean(axis=0),
        np.array(peaks),
    )
