"""How far detected lanes lie from a network's lanes, and which lanes belong together.

`offsets` measures every point of the detected lanes against every lane of the network.
`find_partners` decides which lane of the network each point lies in: the one nearest to it that has
it as its own nearest.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from geoorbit_ros.core.errors import RoadNetworkError
from geoorbit_ros.core.lanes import Lane
from geoorbit_ros.core.polylines import project, sample
from geoorbit_ros.roadnet.network import RoadNetwork

STEP_M = 2.0
"""Between samples along a lane. Chosen: smaller costs time, larger cuts bends."""
NEAR_M = 12.0
"""Network lanes farther from every detected lane are not looked at. Chosen: three lanes and a
little; larger costs time, smaller loses displaced roads."""
END_SLACK_M = 3.0
"""A detected lane may reach this far over the end of a network lane. Chosen: larger compares lanes
of the edge before, smaller leaves gaps at junctions."""
PARALLEL = float(np.cos(np.radians(25.0)))
"""Cosine of the largest angle between lanes that are compared. Chosen: larger angles compare lanes
that part, smaller ones lose bends drawn with few points."""


@dataclass(frozen=True, slots=True)
class LaneSamples:
    """Points every `STEP_M` along lanes.

    Attributes:
        lane: (N,) which of the lanes.
        xy: (N, 2) points.
        tangent: (N, 2) direction of travel there.
        step_m: (N,) length that each point stands for.
    """

    lane: NDArray[np.int64]
    xy: NDArray[np.float64]
    tangent: NDArray[np.float64]
    step_m: NDArray[np.float64]


@dataclass(frozen=True, slots=True)
class Offsets:
    """N points against L lines.

    Attributes:
        offset_m: (N, L) distance to the left of the line, `inf` where the point isn't beside it or
            the line isn't parallel to the point's lane.
        normal: (N, L, 2) unit vector to the left of the line.
        along: (N, L) cosine between the directions: 1 same, -1 opposite.
        arc_m: (N, L) place along the line.
    """

    offset_m: NDArray[np.float64]
    normal: NDArray[np.float64]
    along: NDArray[np.float64]
    arc_m: NDArray[np.float64]


def sample_lines(lines: Sequence[NDArray[np.float64]]) -> LaneSamples:
    """Points along polylines (K, 2)."""
    parts = [sample(line, STEP_M) for line in lines]
    return LaneSamples(
        np.repeat(np.arange(len(parts)), [len(p.point_m) for p in parts]),
        np.concatenate([np.empty((0, 2)), *(p.point_m for p in parts)]),
        np.concatenate([np.empty((0, 2)), *(p.tangent for p in parts)]),
        np.concatenate([np.empty(0), *(np.full(len(p.point_m), p.piece_m) for p in parts)]),
    )


def offsets(points: LaneSamples, lines: Sequence[NDArray[np.float64]]) -> Offsets:
    """Offsets of all points from all polylines (K, 2)."""
    shape = (len(points.xy), len(lines))
    found = Offsets(np.full(shape, np.inf), np.zeros((*shape, 2)), np.zeros(shape), np.zeros(shape))
    for k, line in enumerate(lines):
        # Most lines of a large network are far away.
        low, high = line.min(axis=0) - NEAR_M, line.max(axis=0) + NEAR_M
        at = np.flatnonzero(np.all((points.xy >= low) & (points.xy <= high), axis=1))
        if not len(at):
            continue
        foot = project(points.xy[at], line, END_SLACK_M)
        along = np.sum(points.tangent[at] * foot.tangent, axis=1)
        good = foot.inside & (np.abs(along) >= PARALLEL)
        found.offset_m[at, k] = np.where(good, foot.offset_m, np.inf)
        found.normal[at, k] = np.column_stack((-foot.tangent[:, 1], foot.tangent[:, 0]))
        found.along[at, k], found.arc_m[at, k] = along, foot.arc_m
    return found


def lanes_near(network: RoadNetwork, lanes: Sequence[Lane]) -> NDArray[np.int64]:
    """Numbers of the network's lanes near detected ones, internal ones included.

    Cycle lanes are left out: only motor vehicles make lanes.

    Raises:
        RoadNetworkError: There is none: the network lies elsewhere.
    """
    points = np.concatenate([lane.centerline_m for lane in lanes])
    low, high = points.min(axis=0) - NEAR_M, points.max(axis=0) + NEAR_M
    near = []
    for k in np.flatnonzero(network.for_motors).tolist():
        line = network.line(k)
        if np.all(line.max(axis=0) >= low) and np.all(line.min(axis=0) <= high):
            near.append(k)
    if not near:
        middle = 0.5 * (low + high)
        away = float(np.hypot(*(network.point_m - middle).T).min())
        raise RoadNetworkError(
            str(network.path),
            f"no lane near the detected ones, the nearest is {away:.0f} m away",
            "a network that covers what the camera sees",
        )
    return np.array(near, dtype=np.int64)


GATE_M = 1.75
"""Half a lane of 3.5 m: what is farther is another lane."""
EDGE_SHIFT_M, EDGE_FIT_M, EDGE_GAIN = 2.4, 0.8, 1.5
"""An edge may be displaced as a whole by the first; its traffic then lies within the second of its
lanes; and it counts only where the traffic fits so many times better than without. Chosen: two
thirds of a lane, a quarter of a lane, half as much again; larger shifts and smaller gains take
single changes of lane for displaced edges."""
AGAINST_M = 0.8
"""A lane of the opposite direction is the partner only where it is nearer by this than one of the
same direction. Chosen: a quarter of a lane; smaller calls lanes beside the opposite carriageway
turned, larger misses turned lanes."""


@dataclass(frozen=True, slots=True)
class Partners:
    """Which network lane each sample of the detected lanes lies in.

    Attributes:
        detected: (N,) detected lane of each sample, by its place in the list.
        lane: (N,) network lane by its number, -1 for none.
        offset_m: (N,) of the sample to the left of that lane.
        along: (N,) cosine between the directions.
        arc_m: (N,) place along that lane.
        gap_m: (N,) distance to the nearest network lane, partner or not, as a share of its width,
            after the displacement of the lane's edge as a whole has been taken away.
        xy: (N, 2) the samples, aligned.
    """

    detected: NDArray[np.int64]
    lane: NDArray[np.int64]
    offset_m: NDArray[np.float64]
    along: NDArray[np.float64]
    arc_m: NDArray[np.float64]
    gap_m: NDArray[np.float64]
    xy: NDArray[np.float64]


def find_partners(
    lines: Sequence[NDArray[np.float64]], network: RoadNetwork, number: NDArray[np.int64]
) -> Partners:
    """Partners of all samples along detected centre lines (K, 2), aligned."""
    points = sample_lines(lines)
    near = offsets(points, [network.line(int(k)) for k in number])
    moved = near.offset_m - edge_shifts(near, [network.edge_id[int(k)] for k in number])
    # Of two lanes in about one place the one that runs the right way.
    best = np.argmin(np.abs(moved) + AGAINST_M * (near.along < 0.0), axis=1)
    rows = np.arange(len(best))
    distance = moved[rows, best]
    lane = number[best]
    known = np.isfinite(distance)
    gap = np.where(known, np.abs(distance) / network.width_m[lane], np.inf)
    partner = known & (np.abs(distance) <= GATE_M)
    partner &= _is_nearest(points.xy, points.lane, near, best, distance, lines)
    return Partners(
        detected=points.lane,
        lane=np.where(partner, lane, -1),
        offset_m=near.offset_m[rows, best],
        along=near.along[rows, best],
        arc_m=near.arc_m[rows, best],
        gap_m=gap,
        xy=points.xy,
    )


def edge_shifts(near: Offsets, edges: Sequence[str]) -> NDArray[np.float64]:
    """(L,) how far to the left of each lane the traffic of its edge is as a whole, often 0.

    Some lanes of an edge that is displaced by about half a lane would be taken for their
    neighbours. So the shift is searched after which most of its samples lie on lanes.

    Args:
        near: Samples against L lanes.
        edges: (L,) the edge of each lane.
    """
    shifts = np.zeros(len(edges))
    grid = np.arange(-EDGE_SHIFT_M, EDGE_SHIFT_M + 1e-9, 0.1)
    for name in dict.fromkeys(edges):
        group = np.array([e == name for e in edges])
        offset, along = near.offset_m[:, group], near.along[:, group]
        # Its own traffic runs one way, that beside it may run the other.
        there, back = (np.where(along * way > 0.0, offset, np.inf) for way in (1.0, -1.0))
        inside = [np.count_nonzero(np.abs(o).min(axis=1) <= GATE_M) for o in (there, back)]
        offset = there if inside[0] >= inside[1] else back
        offset = offset[np.isfinite(offset).any(axis=1)]
        away = np.abs(offset[None] - grid[:, None, None]).min(axis=2, initial=np.inf)
        fit = (1.0 - np.minimum(away / EDGE_FIT_M, 1.0) ** 2).sum(axis=1)
        best = int(np.argmax(fit - 1e-3 * fit.max(initial=0.0) * np.abs(grid)))
        if fit[best] > EDGE_GAIN * fit[len(grid) // 2]:
            shifts[group] = grid[best]
    return shifts


def _is_nearest(
    xy: NDArray[np.float64],
    own: NDArray[np.int64],
    near: Offsets,
    best: NDArray[np.int64],
    offset: NDArray[np.float64],
    lines: Sequence[NDArray[np.float64]],
) -> NDArray[np.bool_]:
    """(N,) whether no other detected lane is nearer to the foot of each sample."""
    step = np.where(np.isfinite(offset), offset, 0.0)[:, None]
    foot = xy - step * near.normal[np.arange(len(best)), best]
    nearest = np.ones(len(xy), dtype=np.bool_)
    for d, line in enumerate(lines):
        other = project(foot, line)
        closer = other.inside & (np.abs(other.offset_m) < np.abs(offset) - 1e-6)
        nearest &= ~(closer & (own != d))
    return nearest
