"""Detected lanes laid over a network: how far every point of the ones is from every other lane."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from geoorbit_ros.core.lanes import Lane
from geoorbit_ros.core.polylines import project, sample
from geoorbit_ros.roadnet.errors import RoadNetworkError
from geoorbit_ros.roadnet.network import RoadNetwork

STEP_M = 2.0
NEAR_M = 12.0
"""Network lanes farther from every detected lane say nothing about them."""
END_SLACK_M = 3.0
"""A detected lane may reach this far over the end of a network lane."""
PARALLEL = float(np.cos(np.radians(25.0)))


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
    """How every point lies to every polyline (K, 2)."""
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

    Raises:
        RoadNetworkError: There is none: the network lies elsewhere.
    """
    points = np.concatenate([lane.centerline_m for lane in lanes])
    low, high = points.min(axis=0) - NEAR_M, points.max(axis=0) + NEAR_M
    near = []
    for k in range(len(network)):
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
"""Half a lane: what is farther is another lane."""
EDGE_SHIFT_M, EDGE_FIT_M, EDGE_GAIN = 2.4, 0.8, 1.5
"""An edge may be displaced by this; traffic then lies within this of its lanes; and it is so only
where that much more of it lies there than without."""
AGAINST_M = 0.8
"""A lane of the other direction is a partner where it is nearer by this than one of the same."""


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
            without what the lane's edge is displaced by as a whole.
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
    """(L,) how far to the left of each lane its edge's traffic is as a whole, often 0.

    An edge that is displaced by about half a lane would have some of its lanes taken for their
    neighbours. So the shift is looked for with which most of its samples lie on lanes.

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
