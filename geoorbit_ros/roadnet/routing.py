"""Routes between edges, and positions some metres ahead of a position in a lane."""

from __future__ import annotations

from collections import deque
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from geoorbit_ros.roadnet.network import RoadNetwork

MAX_EDGES = 50
"""Longest route that is looked for. Chosen: larger takes longer where there is no route, smaller
loses vehicles that pass many edges between two views."""


class RouteFinder:
    """Finds routes between edges over edges that no camera saw.

    Args:
        network: The roads.
    """

    def __init__(self, network: RoadNetwork) -> None:
        self._network = network
        self._lanes: dict[str, list[int]] = {}
        self._after: dict[str, set[str]] = {}
        self._around: dict[str, set[str]] = {}
        for lane in range(len(network)):
            edge = network.edge_id[lane]
            self._lanes.setdefault(edge, []).append(lane)
            for after in network.successors[lane]:
                self._after.setdefault(edge, set()).add(network.edge_id[after])
            for after in network.turnarounds[lane]:
                self._around.setdefault(edge, set()).update(self._beyond(after))
        self._internal = {
            edge for edge, inside in zip(network.edge_id, network.internal, strict=True) if inside
        }

    def complete(self, edges: list[str]) -> list[str] | None:
        """The edges with those between them; None where no route leads on.

        Turnarounds count only where both of their edges are among the given ones.
        """
        route = edges[:1]
        for target in edges[1:]:
            between = self._shortest(route[-1], target)
            if between is None and target in self._around.get(route[-1], ()):
                between = [target]
            if between is None:
                return None
            route += [edge for edge in between if edge not in self._internal]
        return route

    def branches(self, edge: str) -> dict[str, int]:
        """The edges after one, beyond the junction, and by how many lanes each is reached."""
        found: dict[str, int] = {}
        waiting = [k for lane in self._lanes[edge] for k in self._network.successors[lane]]
        while waiting:
            lane = waiting.pop()
            if self._network.internal[lane]:
                waiting += self._network.successors[lane]
            else:
                after = self._network.edge_id[lane]
                found[after] = found.get(after, 0) + 1
        return dict(sorted(found.items()))

    def _beyond(self, lane: int) -> set[str]:
        """Edges that a lane belongs or leads to, beyond the junction that it may lie in."""
        network = self._network
        if not network.internal[lane]:
            return {network.edge_id[lane]}
        nexts = (*network.successors[lane], *network.turnarounds[lane])
        return {edge for after in nexts for edge in self._beyond(after)}

    def _shortest(self, begin: str, end: str) -> list[str] | None:
        waiting = deque([[begin]])
        seen = {begin}
        while waiting:
            route = waiting.popleft()
            if route[-1] == end:
                return route[1:]
            if len(route) <= MAX_EDGES:
                for edge in sorted(self._after.get(route[-1], set()) - seen):
                    seen.add(edge)
                    waiting.append([*route, edge])
        return None


@dataclass(frozen=True, slots=True)
class LanePosition:
    """A position in the network.

    Attributes:
        lane: Number of the lane.
        arc_m: Metres along it.
        xy: (2,) the point, in the map frame.
        heading_rad: The lane's direction there, counter-clockwise from east.
        ended: Whether the network ends before it.
    """

    lane: int
    arc_m: float
    xy: NDArray[np.float64]
    heading_rad: float
    ended: bool


def position_ahead(
    network: RoadNetwork,
    lane: int,
    arc_m: float,
    offset_m: float,
    towards: NDArray[np.float64] | None = None,
) -> LanePosition:
    """The position at `arc_m` of a lane, which may lie beyond its end in a lane after it.

    Where lanes part, the one that leads nearest to `towards` is taken; without it, the one straight
    ahead. It never turns round: that only a simulator does where the network ends.

    Args:
        network: The network.
        lane: The lane.
        arc_m: Metres from the lane's beginning.
        offset_m: Metres to the left of the middle.
        towards: (2,) point that the position should be near.

    Returns:
        The position; where the network ends before it (`ended`), straight on beyond the end.
    """
    while arc_m > network.length_m[lane] and network.successors[lane]:
        arc_m -= float(network.length_m[lane])
        choice = network.successors[lane]
        if towards is None or len(choice) == 1:
            lane = network.straight_on[lane]
        else:
            ends = [position_ahead(network, c, arc_m, 0.0, towards).xy for c in choice]
            lane = choice[int(np.argmin([np.hypot(*(end - towards)) for end in ends]))]
    line, arc = network.line(lane), network.arc(lane)
    k = min(max(int(np.searchsorted(arc, arc_m, side="right")) - 1, 0), len(line) - 2)
    step = line[k + 1] - line[k]
    unit = step / max(float(np.hypot(*step)), 1e-9)
    xy = line[k] + (arc_m - arc[k]) * unit + offset_m * np.array([-unit[1], unit[0]])
    heading = float(np.arctan2(unit[1], unit[0]))
    return LanePosition(lane, arc_m, xy, heading, bool(arc_m > network.length_m[lane]))
