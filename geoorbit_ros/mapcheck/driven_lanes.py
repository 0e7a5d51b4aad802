"""A network with its lanes moved to where vehicles drive.

On a map whose lanes have the wrong width or place, a vehicle that keeps its lane would be counted
to the next one. So vehicles are counted to the lanes where the cameras see them driven.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import dataclass, replace

import numpy as np
import scipy
from numpy.typing import NDArray

from geoorbit_ros.core.polylines import offset_line
from geoorbit_ros.roadnet.lane_index import LaneIndex
from geoorbit_ros.roadnet.network import RoadNetwork

Array = NDArray[np.float64]

POINT_M = 5.0
"""Between points of a moved lane. Chosen: smaller costs time, larger cuts bends."""
SMOOTH = 11
"""Samples of the median filter along a lane, 20 m at 2 m each. Chosen: larger flattens bends,
smaller follows the noise of the detected lane."""


@dataclass(frozen=True, slots=True)
class DrivenLane:
    """Where a lane of a network is driven.

    Attributes:
        arc_m: (N,) metres along it, ascending; N >= 1.
        left_m: (N,) how far to the left of its centre line it is driven there.
        width_m: Its width.
    """

    arc_m: Array
    left_m: Array
    width_m: float

    @property
    def middle_m(self) -> float:
        """How far to the left it is driven, the median of all samples."""
        return float(np.median(self.left_m))

    def left_at(self, arc_m: Array) -> Array:
        """How far to the left at (P,) metres along it, smoothed; beyond the ends as at the ends."""
        smooth = scipy.ndimage.median_filter(self.left_m, SMOOTH, mode="nearest")
        return np.asarray(np.interp(arc_m, self.arc_m, smooth))


@dataclass(frozen=True, slots=True)
class DrivenNetwork:
    """A network whose lanes lie where they are driven.

    Attributes:
        network: With the same lanes under the same numbers.
        index: Of those lanes.
        largest_m: The greatest distance by which a lane is moved.
    """

    network: RoadNetwork
    index: LaneIndex
    largest_m: float = 0.0


def merged(parts: Iterable[Mapping[str, DrivenLane]]) -> dict[str, DrivenLane]:
    """Driven lanes of several cameras by lane id; a lane that several see has all samples."""
    found: dict[str, DrivenLane] = {}
    for part in parts:
        for name, lane in part.items():
            if (other := found.get(name)) is not None:
                arc = np.concatenate((other.arc_m, lane.arc_m))
                left = np.concatenate((other.left_m, lane.left_m))
                order = np.argsort(arc, kind="stable")
                lane = DrivenLane(arc[order], left[order], 0.5 * (other.width_m + lane.width_m))
            found[name] = lane
    return found


def as_driven(network: RoadNetwork, driven: Mapping[str, DrivenLane]) -> DrivenNetwork:
    """A network with its lanes where they are driven.

    Lanes of the same edge that no camera saw keep their place between the lanes beside them; lanes
    inside junctions join the ends.

    Args:
        network: The network.
        driven: By SUMO's lane ids.
    """
    moves: dict[int, tuple[Array, Array]] = {}  # places along a lane, and moves to the left there
    width = network.width_m.copy()
    seen = {network.number[name]: lane for name, lane in driven.items()}
    edges = {network.edge_id[k] for k in seen}
    for k in range(len(network)) if edges else ():
        if network.edge_id[k] not in edges:
            continue
        at = places_along(network, k)
        moves[k] = (at, _left_of(network, k, seen, at))
        if k in seen:
            width[k] = seen[k].width_m
    ends = {k: (float(left[0]), float(left[-1])) for k, (_, left) in moves.items()}
    for k in {j for i in ends for j in (*network.successors[i], *network.predecessors[i])}:
        if network.internal[k]:
            before = [ends[i][1] for i in network.predecessors[k] if i in ends]
            after = [ends[i][0] for i in network.successors[k] if i in ends]
            at = places_along(network, k)
            share = at / max(at[-1], 1e-9)
            left = (1.0 - share) * _mean(before) + share * _mean(after)
            moves[k] = (at, left)
    lines = [
        moved_line(network, k, *moves[k]) if k in moves else network.line(k)
        for k in range(len(network))
    ]
    moved = replace(
        network,
        width_m=width,
        length_m=np.array([np.hypot(*np.diff(line, axis=0).T).sum() for line in lines]),
        start=np.append(0, np.cumsum([len(line) for line in lines])).astype(np.int64),
        point_m=np.concatenate(lines),
    )
    largest = max((float(np.abs(left).max()) for _, left in moves.values()), default=0.0)
    return DrivenNetwork(moved, LaneIndex(moved), largest)


def moved_line(network: RoadNetwork, k: int, arc_m: Array, left_m: Array) -> Array:
    """(P, 2) lane k's line at places `arc_m` (P,), moved to the left by `left_m` (P,)."""
    line, arc = network.line(k), network.arc(k)
    base = np.column_stack([np.interp(arc_m, arc, line[:, j]) for j in range(2)])
    return np.asarray(base + left_m[:, None] * (offset_line(base, 1.0) - base))


def places_along(network: RoadNetwork, k: int) -> Array:
    """(P,) metres along a lane: at its own points, and at least every `POINT_M`."""
    arc = network.arc(k)
    return np.unique(np.append(arc, np.arange(0.0, arc[-1], POINT_M)))


def _left_of(network: RoadNetwork, k: int, seen: Mapping[int, DrivenLane], arc_m: Array) -> Array:
    """(P,) how far lane k moves to the left: as seen, or as the lanes beside it that were seen."""
    if k in seen:
        return seen[k].left_at(arc_m)
    right, left = (_next(side, k, seen) for side in (network.right, network.left))
    share = arc_m / max(float(network.length_m[k]), 1e-9)
    known = {
        j: seen[j].left_at(share * network.length_m[j]) for j in (right, left) if j is not None
    }
    if right is None or left is None:
        return next(iter(known.values()))
    place, low, high = (int(network.index[j]) for j in (k, right, left))
    weight = (place - low) / (high - low)
    return np.asarray((1.0 - weight) * known[right] + weight * known[left])


def _next(side: NDArray[np.int64], k: int, seen: Mapping[int, DrivenLane]) -> int | None:
    """The nearest lane on a side of lane k that was seen."""
    while (k := int(side[k])) >= 0:
        if k in seen:
            return k
    return None


def _mean(values: list[float]) -> float:
    return sum(values) / len(values) if values else 0.0
