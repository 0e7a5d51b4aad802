"""Which lane of a network each part of the detected lanes lies in.

At every sample of a detected lane, the network's lane that is nearest to it, and has it as its own
nearest, is its partner there.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from geoorbit_ros.core.polylines import project
from geoorbit_ros.mapcheck.overlay import Offsets, offsets, sample_lines
from geoorbit_ros.roadnet.network import RoadNetwork

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
