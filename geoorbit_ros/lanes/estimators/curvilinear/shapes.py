"""Lanes on the ground: from lines in road coordinates to centreline, boundaries, cross-sections."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from geoorbit_ros.core.lanes import CrossSection, Lane
from geoorbit_ros.lanes.estimators.curvilinear.candidates import Candidate
from geoorbit_ros.lanes.estimators.curvilinear.corridors import Corridor
from geoorbit_ros.lanes.estimators.curvilinear.density import Density
from geoorbit_ros.lanes.estimators.curvilinear.profiles import Profiles
from geoorbit_ros.lanes.estimators.curvilinear.widths import lane_widths, neighbour_spacings


def shape_lanes(
    candidates: Sequence[Candidate],
    corridors: Sequence[Corridor],
    profiles: Profiles,
    width_scale: float,
) -> list[Lane]:
    """Lanes with widths and boundaries; ids and verdicts are still open.

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


def cross_sections(
    candidates: Sequence[Candidate],
    corridors: Sequence[Corridor],
    profiles: Profiles,
    density: Density,
) -> tuple[CrossSection, ...]:
    """The lateral histogram of each corridor with lanes, where most of its lanes are seen."""
    found = []
    for k in sorted({c.corridor for c in candidates}):
        lines = [c.line for c in candidates if c.corridor == k]
        seen = np.zeros(len(profiles.station_m))
        for candidate in candidates:
            if candidate.corridor == k:
                seen[candidate.line.station] += candidate.vehicles
        at = np.flatnonzero(seen == seen.max())
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
