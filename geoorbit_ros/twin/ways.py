"""Ways over a network, from edge to edge."""

from __future__ import annotations

from collections import deque

from geoorbit_ros.twin.network import RoadNetwork

MAX_EDGES = 50
"""No camera misses more edges between two places that it sees."""


class Ways:
    """Ways between edges over edges that no camera saw.

    Args:
        network: The roads.
    """

    def __init__(self, network: RoadNetwork) -> None:
        self._network = network
        self._lanes: dict[str, list[int]] = {}
        self._after: dict[str, set[str]] = {}
        for lane in range(len(network)):
            edge = network.edge_id[lane]
            self._lanes.setdefault(edge, []).append(lane)
            for after in network.successors[lane]:
                self._after.setdefault(edge, set()).add(network.edge_id[after])
        self._internal = {
            edge for edge, inside in zip(network.edge_id, network.internal, strict=True) if inside
        }

    def complete(self, edges: list[str]) -> list[str] | None:
        """The edges with those between them; None where no way leads on."""
        way = edges[:1]
        for target in edges[1:]:
            between = self._shortest(way[-1], target)
            if between is None:
                return None
            way += [edge for edge in between if edge not in self._internal]
        return way

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

    def _shortest(self, begin: str, end: str) -> list[str] | None:
        waiting = deque([[begin]])
        seen = {begin}
        while waiting:
            way = waiting.popleft()
            if way[-1] == end:
                return way[1:]
            if len(way) <= MAX_EDGES:
                for edge in sorted(self._after.get(way[-1], set()) - seen):
                    seen.add(edge)
                    waiting.append([*way, edge])
        return None
