"""Corridors: streams of traffic that run side by side in one direction of travel.

A carriageway with its ramps is one corridor; the opposite carriageway, a side street and the branch
of a turn are others. Within a corridor every node has road coordinates.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from geoorbit_ros.lanes.estimators.curvilinear.reference_line import Spine, trace_spine
from geoorbit_ros.lanes.estimators.curvilinear.trajectory_segments import (
    MIN_TRAVEL_M,
    TrajectorySegments,
    step_m,
    wrap_rad,
)

MAX_CORRIDORS = 16
MIN_STREAM_M = 40.0
"""Travel of all vehicles together; less is what remains of some that left their streams."""
MAX_OFFSET_M = 40.0
MAX_ANGLE_RAD = 0.45
"""Between a vehicle and its corridor: ramps leave at less, turning vehicles at more."""


@dataclass(frozen=True, slots=True)
class Corridor:
    """One stream and the nodes in it.

    Attributes:
        spine: Its reference curve.
        node: (M,) indices into the nodes of the passes.
        s: (M,) arc length of each node, metres.
        d: (M,) offset to the left, metres.
        speed_mps: Speed of the stream.
    """

    spine: Spine
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
    passes: TrajectorySegments, known: Sequence[tuple[Spine, float]] = ()
) -> list[Corridor]:
    """Split the traffic into streams, the one with the longest pass first.

    Args:
        passes: All traffic.
        known: Reference curves and speeds of streams found before; only traffic that fits none of
            them makes a new one.
    """
    owner = passes.owner
    step = np.append(0.0, step_m(*passes.xy.T))
    step[passes.offset[:-1]] = 0.0
    elapsed = np.append(0.0, np.diff(passes.time_s))
    elapsed[passes.offset[:-1]] = 0.0
    left = np.ones(len(owner), bool)
    corridors: list[Corridor] = []
    for spine, speed_mps in known:
        corridor = place_nodes(spine, speed_mps, passes, np.flatnonzero(left))
        left[corridor.node] = False
        if len(corridor.node):
            corridors.append(corridor)
    while left.any() and len(corridors) < MAX_CORRIDORS:
        remaining = np.bincount(owner, step * left, len(passes))
        if remaining.max() < MIN_TRAVEL_M or remaining.sum() < MIN_STREAM_M:
            break
        seed_pass = int(np.argmax(remaining * _straightness(passes, owner, left)))
        seed = np.flatnonzero(left & (owner == seed_pass))
        speed = step[seed].sum() / max(elapsed[seed].sum(), 1e-3)
        corridor = _corridor(passes, np.flatnonzero(left), seed, float(speed))
        left[seed] = False
        left[corridor.node] = False
        if len(corridor.node):
            corridors.append(corridor)
    return corridors


def _straightness(
    passes: TrajectorySegments, owner: NDArray[np.int64], left: NDArray[np.bool_]
) -> NDArray[np.float64]:
    """(P,) 1 for a pass that keeps its heading over its nodes `left`, 1/2 for one that turns off.

    At a junction the road is what the traffic going straight follows; turns branch from it. And a
    track that went from one vehicle to the next is no guide.
    """
    node = np.flatnonzero(left)
    begin = np.searchsorted(owner[node], np.arange(len(passes)))
    end = np.searchsorted(owner[node], np.arange(len(passes)), side="right")
    some = end > begin
    first = passes.heading[np.repeat(node[begin[some]], (end - begin)[some])]
    away = np.abs(wrap_rad(passes.heading[node] - first))
    turn = np.maximum.reduceat(away, begin[some])
    result = np.zeros(len(passes))
    result[some] = 1.0 - 0.5 * np.minimum(turn / (0.5 * np.pi), 1.0)
    return result


def place_nodes(
    spine: Spine, speed_mps: float, passes: TrajectorySegments, among: NDArray[np.int64]
) -> Corridor:
    """The corridor around `spine`, with the nodes `among` (M,) that run along it."""
    among = among[spine.may_run_along(passes.heading[among], MAX_ANGLE_RAD)]
    s, d = spine.to_road(passes.xy[among])
    angle = wrap_rad(passes.heading[among] - spine.heading_at(s))
    fits = (np.abs(angle) < MAX_ANGLE_RAD) & (np.abs(d) < MAX_OFFSET_M) & spine.regular(s, d)
    fits &= (s >= 0.0) & (s <= spine.s[-1])
    return Corridor(spine, among[fits], s[fits], d[fits], speed_mps)


def _corridor(
    passes: TrajectorySegments, left: NDArray[np.int64], seed: NDArray[np.int64], speed_mps: float
) -> Corridor:
    spine = trace_spine(passes.xy, passes.heading, left, seed, scale_m(speed_mps))
    corridor = place_nodes(spine, speed_mps, passes, left)
    return replace(corridor, speed_mps=_median_speed_mps(passes, corridor.node, speed_mps))


def _median_speed_mps(
    passes: TrajectorySegments, node: NDArray[np.int64], otherwise_mps: float
) -> float:
    """Median speed of the passes with a whole stretch among `node` (M,), ascending."""
    owner = passes.owner[node]
    same = (np.diff(owner) == 0) & (np.diff(node) == 1)
    if not same.any():
        return otherwise_mps
    step = step_m(*passes.xy[node].T)[same]
    elapsed = np.diff(passes.time_s[node])[same]
    distance = np.bincount(owner[1:][same], step)
    duration = np.bincount(owner[1:][same], elapsed)
    return float(np.median(distance[duration > 0.0] / duration[duration > 0.0]))


def scale_m(speed_mps: float) -> float:
    """See `Corridor.scale_m`."""
    return float(np.clip(0.7 * speed_mps, 5.0, 20.0))
