"""Corridors: streams of traffic that run side by side in one direction of travel.

A carriageway with its ramps is one corridor; the opposite carriageway, a side street and the branch
of a turn are others. Within a corridor every node has road coordinates.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from geoorbit_ros.lanes.estimators.curvilinear.reference_line import (
    ReferenceLine,
    trace_reference_line,
)
from geoorbit_ros.lanes.estimators.curvilinear.trajectory_segments import (
    MIN_TRAVEL_M,
    TrajectorySegments,
    step_m,
    wrap_rad,
)

MAX_CORRIDORS = 16
"""Chosen: a junction of four two-way arms has twelve movements; more cost time where tracks are
noise, fewer leave out streams."""
MIN_STREAM_M = 40.0
"""Travel of all vehicles together; less is what remains of some that left their streams. Chosen:
larger finds quiet streams later, smaller makes corridors of scraps."""
MAX_OFFSET_M = 40.0
"""From the reference line. Chosen: a carriageway of eight lanes with ramps is narrower; larger
takes in parallel roads, which are better described by a line of their own."""
MAX_ANGLE_RAD = 0.45
"""Between a vehicle and its corridor: ramps leave at less, turning vehicles at more. Chosen: larger
keeps turning vehicles in the corridor, smaller cuts off lane changes."""


@dataclass(frozen=True, slots=True)
class Corridor:
    """One stream and the nodes in it.

    Attributes:
        reference_line: Along it.
        node: (M,) indices into the nodes of the segments.
        s: (M,) arc length of each node, metres.
        d: (M,) offset to the left, metres.
        speed_mps: Speed of the stream.
    """

    reference_line: ReferenceLine
    node: NDArray[np.int64]
    s: NDArray[np.float64]
    d: NDArray[np.float64]
    speed_mps: float

    @property
    def scale_m(self) -> float:
        """Length over which the road's shape is averaged.

        Roads bend, and vehicles change lanes, over a time rather than a length.
        """
        return scale_m(self.speed_mps)


def find_corridors(
    segments: TrajectorySegments, known: Sequence[tuple[ReferenceLine, float]] = ()
) -> list[Corridor]:
    """Split the traffic into streams, the one with the longest segment first.

    Args:
        segments: All traffic.
        known: Reference lines and speeds of streams found before; only traffic that fits none of
            them makes a new one.
    """
    owner = segments.owner
    step = np.append(0.0, step_m(*segments.xy.T))
    step[segments.offset[:-1]] = 0.0
    elapsed = np.append(0.0, np.diff(segments.time_s))
    elapsed[segments.offset[:-1]] = 0.0
    left = np.ones(len(owner), bool)
    corridors: list[Corridor] = []
    for line, speed_mps in known:
        corridor = place_nodes(line, speed_mps, segments, np.flatnonzero(left))
        left[corridor.node] = False
        if len(corridor.node):
            corridors.append(corridor)
    while left.any() and len(corridors) < MAX_CORRIDORS:
        remaining = np.bincount(owner, step * left, len(segments))
        if remaining.max() < MIN_TRAVEL_M or remaining.sum() < MIN_STREAM_M:
            break
        seed_segment = int(np.argmax(remaining * _straightness(segments, owner, left)))
        seed = np.flatnonzero(left & (owner == seed_segment))
        speed = step[seed].sum() / max(elapsed[seed].sum(), 1e-3)
        corridor = _corridor(segments, np.flatnonzero(left), seed, float(speed))
        left[seed] = False
        left[corridor.node] = False
        if len(corridor.node):
            corridors.append(corridor)
    return corridors


def _straightness(
    segments: TrajectorySegments, owner: NDArray[np.int64], left: NDArray[np.bool_]
) -> NDArray[np.float64]:
    """(P,) 1 for a segment that keeps its heading over its nodes `left`, 1/2 for one that turns.

    At a junction the road is what the traffic going straight follows; turns branch from it. And a
    track that went from one vehicle to the next is no guide.
    """
    node = np.flatnonzero(left)
    begin = np.searchsorted(owner[node], np.arange(len(segments)))
    end = np.searchsorted(owner[node], np.arange(len(segments)), side="right")
    some = end > begin
    first = segments.heading[np.repeat(node[begin[some]], (end - begin)[some])]
    away = np.abs(wrap_rad(segments.heading[node] - first))
    turn = np.maximum.reduceat(away, begin[some])
    result = np.zeros(len(segments))
    result[some] = 1.0 - 0.5 * np.minimum(turn / (0.5 * np.pi), 1.0)
    return result


def place_nodes(
    line: ReferenceLine, speed_mps: float, segments: TrajectorySegments, among: NDArray[np.int64]
) -> Corridor:
    """The corridor around `line`, with the nodes `among` (M,) that run along it."""
    among = among[line.may_run_along(segments.heading[among], MAX_ANGLE_RAD)]
    s, d = line.to_road(segments.xy[among])
    angle = wrap_rad(segments.heading[among] - line.heading_at(s))
    fits = (np.abs(angle) < MAX_ANGLE_RAD) & (np.abs(d) < MAX_OFFSET_M) & line.regular(s, d)
    fits &= (s >= 0.0) & (s <= line.s[-1])
    return Corridor(line, among[fits], s[fits], d[fits], speed_mps)


def _corridor(
    segments: TrajectorySegments, left: NDArray[np.int64], seed: NDArray[np.int64], speed_mps: float
) -> Corridor:
    line = trace_reference_line(segments.xy, segments.heading, left, seed, scale_m(speed_mps))
    corridor = place_nodes(line, speed_mps, segments, left)
    return replace(corridor, speed_mps=_median_speed_mps(segments, corridor.node, speed_mps))


def _median_speed_mps(
    segments: TrajectorySegments, node: NDArray[np.int64], otherwise_mps: float
) -> float:
    """Median speed of the segments with a whole stretch among `node` (M,), ascending."""
    owner = segments.owner[node]
    same = (np.diff(owner) == 0) & (np.diff(node) == 1)
    if not same.any():
        return otherwise_mps
    step = step_m(*segments.xy[node].T)[same]
    elapsed = np.diff(segments.time_s[node])[same]
    distance = np.bincount(owner[1:][same], step)
    duration = np.bincount(owner[1:][same], elapsed)
    return float(np.median(distance[duration > 0.0] / duration[duration > 0.0]))


def scale_m(speed_mps: float) -> float:
    """See `Corridor.scale_m`."""
    return float(np.clip(0.7 * speed_mps, 5.0, 20.0))
