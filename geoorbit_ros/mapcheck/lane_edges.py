"""Which lanes of a network the lanes of a camera lie on, from end to end."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from geoorbit_ros.core.lanes import Lane
from geoorbit_ros.mapcheck.alignment import align
from geoorbit_ros.mapcheck.offsets import Partners, find_partners, lanes_near
from geoorbit_ros.roadnet.network import NO_LANE, RoadNetwork

SHORTEST_M = 10.0
"""A lane that lies on a lane of the network over less doesn't count there. Chosen: two cars'
lengths; less takes lanes that are crossed at a junction, more loses short edges."""
REACH_M = 25.0
"""A place belongs to the nearest stretch so far along its lane. Chosen: across a junction; farther
counts for edges that begin after others."""


@dataclass(frozen=True, slots=True)
class Stretch:
    """A part of a camera's lane that lies on one lane of the network.

    Attributes:
        begin_m: Where it begins, along the camera's lane.
        end_m: Where it ends.
        lane: Number of the network's lane.
        place_m: Where it begins, along the network's lane.
    """

    begin_m: float
    end_m: float
    lane: int
    place_m: float


@dataclass(frozen=True)
class LaneEdges:
    """A camera's lanes as lanes of a network; junctions are left out.

    Attributes:
        network: The network, in the camera's map frame.
        stretches: For each lane id, in travel order; none for a lane that the network lacks.
        shift_m: How far camera and network were moved against each other.
    """

    network: RoadNetwork
    stretches: Mapping[int, tuple[Stretch, ...]]
    shift_m: float

    def lane_at(self, lane_id: int, arc_m: float) -> int:
        """The network's lane at a place along a camera's lane; `NO_LANE` where it has none."""
        near = min(
            self.stretches[lane_id],
            key=lambda part: max(part.begin_m - arc_m, arc_m - part.end_m),
            default=None,
        )
        if near is None or max(near.begin_m - arc_m, arc_m - near.end_m) > REACH_M:
            return NO_LANE
        return near.lane

    def lanes_between(self, lane_id: int, begin_m: float, end_m: float) -> list[int]:
        """The network's lanes, in travel order, along a part of a camera's lane."""
        return [
            part.lane
            for part in self.stretches[lane_id]
            if part.begin_m <= end_m and part.end_m >= begin_m
        ]

    @cached_property
    def first_seen_m(self) -> Mapping[int, float]:
        """How far along each lane of the network the camera's lanes begin on it."""
        found: dict[int, float] = {}
        for part in (part for parts in self.stretches.values() for part in parts):
            found[part.lane] = min(part.place_m, found.get(part.lane, np.inf))
        return found

    def before(self, lane: int) -> list[int]:
        """The lanes that lead into a lane, across a junction."""
        return self._beyond(lane, self.network.predecessors)

    def onward(self, lane: int) -> int:
        """The lane after one, across a junction; `NO_LANE` unless it is one edge, and in view."""
        return self._only(lane, self.network.successors)

    def backward(self, lane: int) -> int:
        """The lane before one; `NO_LANE` unless it is one edge, and in view."""
        return self._only(lane, self.network.predecessors)

    def _beyond(self, lane: int, links: tuple[tuple[int, ...], ...]) -> list[int]:
        found, waiting = set[int](), list(links[lane])
        while waiting:
            k = waiting.pop()
            if self.network.internal[k]:
                waiting += links[k]
            else:
                found.add(k)
        return sorted(found)

    def _only(self, lane: int, links: tuple[tuple[int, ...], ...]) -> int:
        lanes = self._beyond(lane, links)
        if not lanes:  # it begins or ends beside others that go on
            beside = self.network.lanes_of[self.network.edge_id[lane]]
            lanes = sorted({k for other in beside for k in self._beyond(other, links)})
        edges = {self.network.edge_id[k] for k in lanes}
        return lanes[0] if len(edges) == 1 and edges <= self._edges_in_view else NO_LANE

    @cached_property
    def _edges_in_view(self) -> frozenset[str]:
        return frozenset(self.network.edge_id[lane] for lane in self.first_seen_m)

    @property
    def missing(self) -> tuple[int, ...]:
        """Ids of the lanes that the network lacks."""
        return tuple(lane for lane, parts in self.stretches.items() if not parts)


def match_edges(lanes: Sequence[Lane], network: RoadNetwork) -> LaneEdges:
    """Find the network's lanes under a camera's lanes, after camera and map are aligned.

    Args:
        lanes: In the map frame.
        network: In the same frame.

    Raises:
        RoadNetworkError: The network lies elsewhere.
    """
    number = lanes_near(network, lanes)
    lines, shift_m = [lane.centerline_m for lane in lanes], 0.0
    if any(lane.status == "confirmed" for lane in lanes):
        alignment = align(lanes, network).applied
        lines, shift_m = [alignment.points(line) for line in lines], alignment.size_m
    partners = find_partners(lines, network, number)
    found = {
        lane.lane_id: _stretches(partners, d, lane.length_m, network)
        for d, lane in enumerate(lanes)
    }
    return LaneEdges(network, found, shift_m)


def _stretches(
    partners: Partners, detected: int, length_m: float, network: RoadNetwork
) -> tuple[Stretch, ...]:
    mine = partners.detected == detected
    place = partners.arc_m[mine]
    lane: NDArray[np.int64] = np.where(partners.along[mine] > 0.0, partners.lane[mine], NO_LANE)
    piece_m = length_m / max(len(lane), 1)
    inside = np.array([k != NO_LANE and network.internal[k] for k in lane.tolist()], np.bool_)
    lane = np.where(inside, NO_LANE, lane)
    # Where two lanes of the map part or meet, samples may go to and fro: each lane is taken once.
    found = []
    for k in dict.fromkeys(lane[lane != NO_LANE].tolist()):
        at = np.flatnonzero(lane == k)
        if len(at) * piece_m >= min(SHORTEST_M, 0.5 * float(network.length_m[k])):
            ends = (float(at[0]) * piece_m, float(at[-1] + 1) * piece_m)
            found.append(Stretch(*ends, k, max(float(place[at[0]]) - 0.5 * piece_m, 0.0)))
    return tuple(sorted(found, key=lambda part: part.begin_m + part.end_m))
