"""The copy of a network that SUMO simulates: the same lanes with fewer points, in shorter edges.

`moveToXY` looks several times at every point of every lane near the vehicle: on a motorway drawn
every 2 m it costs 260 µs per vehicle and step. So shapes are thinned to two centimetres, and edges
that still have many points are cut into pieces joined end to end
(docs/adr/0017-running-network.md). Pieces are named `<edge>~1`, `<edge>~2`, …; only
`sumo_simulation.py` sees those names.
"""

from __future__ import annotations

from bisect import bisect_right
from collections.abc import Container, Iterator
from copy import deepcopy
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from xml.etree import ElementTree as Xml

import numpy as np
from numpy.typing import NDArray

from geoorbit_ros.roadnet.network_file import parse_xml

TOLERANCE_M = 0.02
"""No lane moves by more. netconvert rounds coordinates to half of it: a tighter tolerance keeps
points of straight lanes that only the rounding made (ADR 0017)."""
MAX_POINTS = 4
"""Points per lane of a piece, more only where it would be shorter than `MIN_PIECE_M`. Measured (ADR
0017; benchmarks/twin.py times a step): a change of piece costs SUMO as much as three points."""
MIN_PIECE_M = 8.0
"""Least length of a piece. Chosen: two vehicle lengths; shorter makes vehicles change pieces in
every step."""
MARK = "~"
"""Between an edge's id and the number of its piece."""


def thin(line: NDArray[np.float64], tolerance_m: float) -> list[int]:
    """Points of a line (K, 2) to keep, first and last included (Douglas and Peucker 1973).

    No point of the line is farther from the thinned one than `tolerance_m`.
    """
    kept, waiting = {0, len(line) - 1}, [(0, len(line) - 1)]
    while waiting:
        a, b = waiting.pop()
        if b <= a + 1:
            continue
        chord, rest = line[b] - line[a], line[a + 1 : b] - line[a]
        length = max(float(np.hypot(*chord)), 1e-12)
        across = (chord[0] * rest[:, 1] - chord[1] * rest[:, 0]) / length
        along = rest @ chord / length
        # Beyond the chord's ends the distance is that to the end.
        away = np.hypot(across, np.maximum(np.maximum(-along, along - length), 0.0))
        farthest = int(np.argmax(away))
        if away[farthest] > tolerance_m:
            k = a + 1 + farthest
            kept.add(k)
            waiting += [(a, k), (k, b)]
    return sorted(kept)


@dataclass(frozen=True)
class RunningNetwork:
    """How the simulated network differs from the file.

    Attributes:
        cuts: For each edge that was cut, the shares of its length at which its pieces begin, the
            first being 0.
    """

    cuts: dict[str, tuple[float, ...]]

    def piece(self, edge: str, share: float) -> str:
        """The piece of an edge at a share of its length."""
        begins = self.cuts.get(edge)
        return edge if begins is None else self._names[edge][max(bisect_right(begins, share), 1)]

    def pieces(self, edge: str) -> list[str]:
        """All pieces of an edge, in travel order."""
        return list(self._names.get(edge, ("", edge))[1:])

    @cached_property
    def _names(self) -> dict[str, tuple[str, ...]]:
        """Names of the pieces of each edge that was cut, counted from 1."""
        return {
            edge: ("", *(f"{edge}{MARK}{k + 1}" for k in range(len(begins))))
            for edge, begins in self.cuts.items()
        }

    @cached_property
    def of_lane(self) -> RunningLanes:
        """For each simulated lane its lane in the file and its edge in the simulation."""
        return RunningLanes(self.cuts)


class RunningLanes(dict[str, tuple[str, str]]):
    """By the id of a simulated lane: the lane's id in the file, and the simulated edge."""

    def __init__(self, cuts: Container[str]) -> None:
        super().__init__()
        self._cuts = cuts

    def __missing__(self, lane: str) -> tuple[str, str]:
        """Computed once per lane, because it is asked for every vehicle in every step."""
        piece, _, index = lane.rpartition("_")
        edge = piece.rpartition(MARK)[0]
        self[lane] = (f"{edge}_{index}" if edge in self._cuts else lane, piece)
        return self[lane]


def write_running_network(path: Path, out: Path) -> RunningNetwork:
    """Write the copy of a network that is simulated.

    Raises:
        RoadNetworkError: The file can't be read.
    """
    tree = parse_xml(path)
    root = tree.getroot()
    for element in root.iter():
        if element.tag == "lane":
            # moveToXY takes a lane's origId for its name: of a map from OSM that of the way.
            for given in [p for p in element.findall("param") if p.get("key") == "origId"]:
                element.remove(given)
        shape = element.get("shape")
        if shape and element.tag in ("lane", "edge"):
            points = shape.split()
            kept = thin(_points(points), TOLERANCE_M)
            element.set("shape", " ".join(points[k] for k in kept))
    cuts: dict[str, tuple[float, ...]] = {}
    whole = set(_edges_to_leave(root))
    for place, edge in reversed(list(enumerate(root))):
        if edge.tag == "edge" and edge.get("function", "normal") == "normal":
            begins = _begins(edge)
            if len(begins) > 1 and edge.attrib["id"] not in whole:
                cuts[edge.attrib["id"]] = begins
                root[place : place + 1] = _cut(root, edge, begins)
    _rename_ends(root, cuts)
    tree.write(out, encoding="utf-8", xml_declaration=True)
    return RunningNetwork(cuts)


def _edges_to_leave(root: Xml.Element) -> Iterator[str]:
    """Edges that are not cut, because other elements refer to them by name."""
    for edge in root.iter("edge"):
        if edge.get("bidi"):
            yield edge.attrib["id"]
        yield from edge.get("crossingEdges", "").split()
    for ring in root.iter("roundabout"):
        yield from ring.get("edges", "").split()


def _begins(edge: Xml.Element) -> tuple[float, ...]:
    """Where an edge is cut, as shares of its length, by the points of its densest lane."""
    lines = [_points(lane.get("shape", "").split()) for lane in edge.iter("lane")]
    arc = _arc(max(lines, key=len)) if lines else np.zeros(1)
    begins, at = [0], MAX_POINTS - 1
    while at < len(arc) - 1:
        if arc[at] - arc[begins[-1]] >= MIN_PIECE_M:
            begins.append(at)
            at += MAX_POINTS - 1
        else:
            at += 1
    if len(begins) > 1 and arc[-1] - arc[begins[-1]] < MIN_PIECE_M:
        begins.pop()
    return tuple((arc[begins] / max(arc[-1], 1e-9)).tolist())


def _cut(root: Xml.Element, edge: Xml.Element, begins: tuple[float, ...]) -> list[Xml.Element]:
    """The pieces of an edge; their junctions and connections are added to the network."""
    count = len(begins)
    name, lanes = edge.attrib["id"], [lane.attrib["index"] for lane in edge.iter("lane")]
    pieces = []
    for k, (begin, end) in enumerate(zip(begins, (*begins[1:], 1.0), strict=True), start=1):
        piece = deepcopy(edge)
        piece.set("id", f"{name}{MARK}{k}")
        piece.attrib.pop("shape", None)
        if k > 1:
            piece.set("from", f"{name}{MARK}{k}")
        if k < count:
            piece.set("to", f"{name}{MARK}{k + 1}")
        for lane in piece.iter("lane"):
            lane.set("id", f"{name}{MARK}{k}_{lane.attrib['index']}")
            lane.set("length", f"{float(lane.attrib['length']) * (end - begin):.3f}")
            part = _part(_points(lane.attrib["shape"].split()), begin, end)
            lane.set("shape", " ".join(f"{x:.3f},{y:.3f}" for x, y in part))
        pieces.append(piece)
        if k > 1:
            _join(root, f"{name}{MARK}{k - 1}", piece, lanes)
    return pieces


def _join(root: Xml.Element, before: str, piece: Xml.Element, lanes: list[str]) -> None:
    """A junction without internal lanes where a piece begins: every lane goes straight on."""
    name = piece.attrib["id"]
    starts = [lane.attrib["shape"].split()[0] for lane in piece.iter("lane")]
    x, y = starts[0].split(",")
    junction = Xml.SubElement(
        root,
        "junction",
        id=name,
        type="priority",
        x=x,
        y=y,
        incLanes=" ".join(f"{before}_{index}" for index in lanes),
        intLanes="",
        shape=f"{starts[0]} {starts[-1]}",
    )
    for number, index in enumerate(lanes):
        none = "0" * len(lanes)
        Xml.SubElement(junction, "request", index=str(number), response=none, foes=none, cont="0")
        Xml.SubElement(
            root,
            "connection",
            {"from": before, "to": name},
            fromLane=index,
            toLane=index,
            dir="s",
            state="M",
        )


def _rename_ends(root: Xml.Element, cuts: dict[str, tuple[float, ...]]) -> None:
    """Connections and junctions of the file refer to the first or the last piece."""
    for connection in root.iter("connection"):
        source, target = connection.get("from", ""), connection.get("to", "")
        if source in cuts:
            connection.set("from", f"{source}{MARK}{len(cuts[source])}")
        if target in cuts:
            connection.set("to", f"{target}{MARK}1")
    for junction in root.iter("junction"):
        names = junction.get("incLanes", "").split()
        for k, lane in enumerate(names):
            edge, _, index = lane.rpartition("_")
            if edge in cuts:
                names[k] = f"{edge}{MARK}{len(cuts[edge])}_{index}"
        junction.set("incLanes", " ".join(names))


def _part(line: NDArray[np.float64], begin: float, end: float) -> NDArray[np.float64]:
    """The part of a line (K, 2) between two shares of its length."""
    arc = _arc(line)
    low, high = begin * arc[-1], end * arc[-1]
    within = (arc > low + 1e-3) & (arc < high - 1e-3)
    ends = np.column_stack([np.interp([low, high], arc, line[:, k]) for k in range(2)])
    return np.concatenate([ends[:1], line[within], ends[1:]])


def _arc(line: NDArray[np.float64]) -> NDArray[np.float64]:
    """(K,) distance of each point of a line from its beginning."""
    return np.append(0.0, np.cumsum(np.hypot(*np.diff(line, axis=0).T)))


def _points(texts: list[str]) -> NDArray[np.float64]:
    return np.array([[float(v) for v in text.split(",")[:2]] for text in texts])
