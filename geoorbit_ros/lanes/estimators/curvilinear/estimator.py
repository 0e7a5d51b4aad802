"""The lane estimator that users get: lanes as ridges of traffic density along curved roads.

Per update: segments (condensed tracks) -> corridors (streams with a reference line) -> lateral
profiles -> density over (s, d) -> ridges -> members -> centrelines -> widths. Nothing in it knows
an axis: it depends on distances and angles between vehicles alone.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from geoorbit_ros.core.lanes import CrossSection, Lane, LaneMap
from geoorbit_ros.core.plugins import register
from geoorbit_ros.lanes.confidence import SHOW, assess
from geoorbit_ros.lanes.estimators.curvilinear.candidates import (
    Candidate,
    find_candidates,
    find_ridges,
)
from geoorbit_ros.lanes.estimators.curvilinear.corridors import Corridor, find_corridors
from geoorbit_ros.lanes.estimators.curvilinear.density import Density
from geoorbit_ros.lanes.estimators.curvilinear.evidence import Evidence
from geoorbit_ros.lanes.estimators.curvilinear.profiles import Profiles, lateral_profiles
from geoorbit_ros.lanes.estimators.curvilinear.reference_line import ReferenceLine
from geoorbit_ros.lanes.estimators.curvilinear.trajectory_segments import TrajectorySegments
from geoorbit_ros.lanes.estimators.curvilinear.widths import lane_widths, neighbour_spacings
from geoorbit_ros.lanes.estimators.estimator import State
from geoorbit_ros.lanes.parameters import LaneParameters

SECTION_M = 10.0
"""Length of road from which a lateral histogram is taken. Chosen: longer blurs lanes that spread
apart, as at a ramp; shorter shows single vehicles."""
RETRACE = 0.1
"""Share of the evidence that must be new for the reference lines to be traced anew. Chosen: larger
keeps early lines of few vehicles longer, smaller costs time at every derivation."""


@register("estimator", "curvilinear")
class CurvilinearEstimator:
    """`LaneEstimator` for any heading, bends, ramps, both directions and sparse lanes.

    It is a `SegmentSource` and `Restorable`. Its reference lines are kept until a tenth of the
    evidence is new, so a map may differ by centimetres with when maps were asked for before.
    """

    def __init__(self) -> None:
        self._evidence = Evidence()
        self._lines: list[tuple[ReferenceLine, float]] = []
        self._known: list[tuple[ReferenceLine, float]] = []
        self._traced = 0
        self._new_rows = True

    def add(self, stamp_ns: int, rows: NDArray[np.void]) -> None:
        """Take one frame of `TRACK_DTYPE` rows; stamps increase from call to call."""
        self._new_rows = True
        self._evidence.add(stamp_ns, rows)

    def lanes(self, parameters: LaneParameters) -> LaneMap:
        """All lanes that the rows may show, weak ones too; see the module's text for the method.

        The cross-sections are those of lanes that need no history to be shown.
        """
        segments, weight = self._evidence.segments()
        stamp_ns = self._evidence.stamp_ns
        if len(segments) == 0:
            return LaneMap(stamp_ns, ())
        corridors = self._corridors(segments)
        if not corridors:
            return LaneMap(stamp_ns, ())
        profiles = lateral_profiles(corridors, segments, weight)
        traced = find_ridges(profiles, segments.large[profiles.segment], parameters)
        candidates = find_candidates(profiles, traced)
        shapes = _shape_lanes(candidates, corridors, profiles, parameters.width_scale)
        lanes = [assess(lane, c.evidence) for lane, c in zip(shapes, candidates, strict=True)]
        strong = [c for lane, c in zip(lanes, candidates, strict=True) if lane.confidence >= SHOW]
        sections = _cross_sections(strong, corridors, profiles, traced.density)
        return LaneMap(stamp_ns, tuple(lanes), sections, segments=len(segments))

    def finished_segments(self) -> int:
        """How many trajectory segments have ended so far, forgotten ones included."""
        return self._evidence.finished()

    def segments_after(self, count: int, stamp_ns: int) -> TrajectorySegments:
        """Segments that ended after the first `count` and began after `stamp_ns`."""
        return self._evidence.finished_after(count, stamp_ns)

    def state(self) -> State:
        """The trajectory segments; what is derived from them is not kept."""
        return self._evidence.state()

    def restore(self, state: Mapping[str, NDArray[Any]], stamp_ns: int) -> None:
        """Go on from a state; the next frame comes at `stamp_ns`.

        Raises:
            KeyError, ValueError, IndexError: Not such a state.
        """
        self._new_rows = True
        self._evidence.restore(state, stamp_ns)

    def _corridors(self, segments: TrajectorySegments) -> list[Corridor]:
        """Corridors along the known reference lines; these are traced anew as evidence grows."""
        if self._new_rows:
            self._new_rows = False
            finished = self._evidence.finished()
            retrace = not self._lines or finished - self._traced >= RETRACE * len(segments)
            self._traced = finished if retrace else self._traced
            self._known = [] if retrace else self._lines
        corridors = find_corridors(segments, self._known)
        self._lines = [(c.reference_line, c.speed_mps) for c in corridors]
        return corridors


def _shape_lanes(
    candidates: Sequence[Candidate],
    corridors: Sequence[Corridor],
    profiles: Profiles,
    width_scale: float,
) -> list[Lane]:
    """Lanes with widths and boundaries; ids and confidences are still open.

    Args:
        candidates: Lines and vehicles.
        corridors: The streams they belong to.
        profiles: The stations of the lines.
        width_scale: Factor on the widths.
    """
    spacings = neighbour_spacings([c.line for c in candidates], profiles.step_m)
    speed_mps = np.array([corridors[c.corridor].speed_mps for c in candidates])
    width, error = lane_widths(speed_mps, spacings)
    lanes = []
    for i, candidate in enumerate(candidates):
        s, d = profiles.station_m[candidate.line.station], candidate.line.d
        half = 0.5 * width_scale * float(width[i])
        points = corridors[candidate.corridor].reference_line.to_map(
            np.concatenate([s, s, s]), np.concatenate([d, d + half, d - half])
        )
        centre, left, right = points.reshape(3, len(d), 2)
        lanes.append(
            Lane(
                lane_id=0,
                centerline_m=centre,
                left_m=left,
                right_m=right,
                width_m=2.0 * half,
                width_sigma_m=width_scale * float(error[i]),
                confidence=0.0,
                status="tentative",
                vehicles=candidate.vehicles,
                sigma_m=float(candidate.line.sigma_m.mean()),
            )
        )
    return lanes


def _cross_sections(
    candidates: Sequence[Candidate],
    corridors: Sequence[Corridor],
    profiles: Profiles,
    density: Density,
) -> tuple[CrossSection, ...]:
    """The lateral histogram of each corridor with lanes, where most of its vehicles are seen."""
    found = []
    for k in sorted({c.corridor for c in candidates}):
        lines = [c.line for c in candidates if c.corridor == k]
        seen = np.zeros(len(profiles.station_m))
        for candidate in candidates:
            if candidate.corridor == k:
                seen[candidate.line.station] += candidate.vehicles
        at = np.flatnonzero(seen == seen.max())
        middle_m = profiles.station_m[at[len(at) // 2]]
        at = at[np.abs(profiles.station_m[at] - middle_m) <= SECTION_M / 2]
        heading = corridors[k].reference_line.heading_at(profiles.station_m[at])
        peaks = [
            float(line.d[here].mean())
            for line in lines
            if (here := (line.station >= at[0]) & (line.station <= at[-1])).any()
        ]
        value = density.value[at].mean(axis=0)
        some = np.flatnonzero(value)
        mean = np.arctan2(np.sin(heading).mean(), np.cos(heading).mean())
        found.append(
            CrossSection(
                float((90.0 - np.degrees(mean)) % 360.0),
                density.offset_m[some[0] : some[-1] + 1],
                value[some[0] : some[-1] + 1],
                np.array(peaks),
            )
        )
    return tuple(found)
