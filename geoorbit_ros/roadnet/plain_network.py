"""Edits the edges of a SUMO network: to plain XML, and back to a network through netconvert.

Changed edges and connections go to `patch.edg.xml` and `patch.con.xml`, so that the patch can be
read and kept; the rest of the network goes to `base.….xml`. netconvert makes the network of both.
"""

from __future__ import annotations

import copy
from dataclasses import dataclass, field
from pathlib import Path
from xml.etree import ElementTree as Xml

import numpy as np
from numpy.typing import NDArray

from geoorbit_ros.core.errors import RoadNetworkError
from geoorbit_ros.roadnet.netconvert import netconvert
from geoorbit_ros.roadnet.network_file import DEFAULT_WIDTH_M, parse_xml

BASE, PATCH = "base", "patch"
_PARTS = {"nod": "node", "edg": "edge", "con": "connection", "tll": "tllogic"}
MEET_M = 40.0
"""A lane continues in one that begins within this distance, over a junction. Chosen: larger joins
lanes of other junctions, smaller loses those over wide ones."""
MEET_SHARE = 0.6
"""A lane continues in one that begins less than this share of its width beside it. Chosen: half a
lane and a little; more joins a lane to its neighbour, less misses lanes that shift at a
junction."""
MEET_RAD = np.radians(30.0)
"""A lane continues in one whose direction differs by less. Chosen: larger takes turns for lanes
that go straight on, smaller loses bends inside junctions."""
BEGIN_BEFORE_M = 5.0
"""A lane may begin this far before the other ends. Chosen: larger joins lanes that run side by
side, smaller loses edges that overlap at a junction."""
END_M = 15.0
"""A lane's direction at its end is taken over this length. Chosen: longer flattens bends, shorter
follows single points of the drawing."""
_OF_SHAPE = frozenset({"id", "index", "shape", "width", "length"})
"""Attributes of a lane that follow from its place; all others are kept."""
_PLAIN = "the plain XML that netconvert wrote"


@dataclass(slots=True)
class LaneEdit:
    """A lane that can be changed.

    Attributes:
        origin: Its index in the unchanged edge; None for a new lane.
        shape_m: (K, 2) centre line in travel order, in the network's own coordinates.
        width_m: Its width.
        rules: Its other attributes in the file: speed, permitted vehicle classes.
        profile: (N, 2) shares of its length, ascending, and heights there; empty in a flat network.
    """

    origin: int | None
    shape_m: NDArray[np.float64]
    width_m: float
    rules: dict[str, str]
    profile: NDArray[np.float64] = field(default_factory=lambda: np.empty((0, 2)))

    @property
    def points(self) -> NDArray[np.float64]:
        """(K, 2 or 3) its centre line, with heights where the network has them."""
        if not len(self.profile):
            return self.shape_m
        arc = np.append(0.0, np.cumsum(np.hypot(*np.diff(self.shape_m, axis=0).T)))
        height = np.interp(arc / max(arc[-1], 1e-9), *self.profile.T)
        return np.column_stack((self.shape_m, height))


@dataclass(slots=True)
class EdgeEdit:
    """An edge that can be changed; its lanes are ordered by index, the outermost first."""

    edge_id: str
    lanes: list[LaneEdit]
    reversed: bool = False

    def reverse(self) -> None:
        """Make all lanes run the other way."""
        self.reversed = not self.reversed
        for lane in self.lanes:
            lane.shape_m = lane.shape_m[::-1]
            lane.profile = lane.profile[::-1] * [-1.0, 1.0] + [1.0, 0.0]
        self.lanes.reverse()


class PlainNetwork:
    """The plain XML of a network in a folder.

    Args:
        net: The network.
        folder: Where the plain files go.

    Raises:
        RoadNetworkError: netconvert refuses the network.
    """

    def __init__(self, net: Path, folder: Path) -> None:
        self._net, self._folder = net, folder
        self.options = ["--precision", "4", "--plain-output.lanes", "true"]
        netconvert(
            [f"--sumo-net-file={net}", f"--plain-output-prefix={folder / BASE}", *self.options],
            str(net),
        )
        self._root = {part: parse_xml(self._file(BASE, part), _PLAIN).getroot() for part in _PARTS}
        self._edges = {e.attrib["id"]: e for e in self._root["edg"].findall("edge")}
        self._lanes = _lanes_of(net)
        self._outlines = _outlines_of(net)
        self.changed: dict[str, EdgeEdit] = {}

    def edge(self, edge_id: str) -> EdgeEdit:
        """An edge to change."""
        if edge_id not in self.changed:
            self.changed[edge_id] = EdgeEdit(edge_id, [self._lane(a) for a in self._of(edge_id)])
        return self.changed[edge_id]

    def write(self, net: Path) -> tuple[tuple[str, ...], tuple[str, ...]]:
        """Make the changed network; what netconvert warned of, and its options.

        Raises:
            RoadNetworkError: netconvert refuses the changes.
        """
        self._split_edges()
        self._split_connections()
        self._keep_junctions()
        files = {
            "node": [self._file(BASE, "nod")],
            "edge": [self._file(BASE, "edg"), self._file(PATCH, "edg")],
            "connection": [self._file(BASE, "con"), self._file(PATCH, "con")],
            "tllogic": [self._file(BASE, "tll")],
        }
        options = [
            f"--configuration-file={self._folder / BASE}.netccfg",
            *(f"--{kind}-files={','.join(map(str, paths))}" for kind, paths in files.items()),
            "--plain-output.lanes=false",
            "--precision=3",
        ]
        warnings = netconvert([*options, f"--output-file={net}"], str(self._net))
        return warnings, tuple(option.replace(f"{self._folder}/", "") for option in options)

    def _file(self, stem: str, part: str) -> Path:
        return self._folder / f"{stem}.{part}.xml"

    def _of(self, edge_id: str) -> list[dict[str, str]]:
        if edge_id not in self._edges or edge_id not in self._lanes:
            raise RoadNetworkError(str(self._net), f"no edge '{edge_id}'", "an edge of the network")
        return self._lanes[edge_id]

    def _lane(self, attributes: dict[str, str]) -> LaneEdit:
        points = np.array([[float(v) for v in p.split(",")] for p in attributes["shape"].split()])
        shape, profile = points[:, :2], np.empty((0, 2))
        if points.shape[1] > 2:
            arc = np.append(0.0, np.cumsum(np.hypot(*np.diff(shape, axis=0).T)))
            profile = np.column_stack((arc / max(arc[-1], 1e-9), points[:, 2]))
        return LaneEdit(
            int(attributes["index"]),
            shape,
            float(attributes.get("width", DEFAULT_WIDTH_M)),
            {name: value for name, value in attributes.items() if name not in _OF_SHAPE},
            profile,
        )

    def _split_edges(self) -> None:
        base, patch = copy.deepcopy(self._root["edg"]), Xml.Element("edges")
        if (place := base.find("location")) is not None:
            patch.append(place)
        for element in base.findall("edge"):
            edit = self.changed.get(element.attrib["id"])
            if edit is not None:
                base.remove(element)
                patch.append(_edge_element(element, edit))
        self._save(base, BASE, "edg")
        self._save(patch, PATCH, "edg")

    def _split_connections(self) -> None:
        base, patch = copy.deepcopy(self._root["con"]), Xml.Element("connections")
        touched = {e for e in self._edges if e in self.changed} | {
            c.attrib["from"] for c in base if c.get("to") in self.changed
        }
        touched |= {a for a, b in self._meeting() if a in self.changed or b in self.changed}
        kept: dict[tuple[str, str, str, str], dict[str, str]] = {}
        lost: list[Xml.Element] = []
        for c in base.findall("connection"):
            if c.attrib["from"] in touched:
                base.remove(c)
                found = self._renumbered(c)
                kept |= found
                lost += [] if found else [c]
        joined = {(a, b) for a, b, *_ in kept}
        for c in lost:  # a way that only a removed lane led on: the lane beside it leads there now
            if (c.attrib["from"], c.get("to", "")) not in joined:
                kept |= self._renumbered(c, beside=True)
        for key in self._new_connections():
            kept.setdefault(key, {})
        for (a, b, i, j), rest in kept.items():
            Xml.SubElement(
                patch, "connection", {"from": a, "to": b, "fromLane": i, "toLane": j, **rest}
            )
        for edge in sorted(touched - {a for a, *_ in kept}):
            Xml.SubElement(
                patch, "connection", {"from": edge}
            )  # no connection: netconvert must not guess any
        self._save(base, BASE, "con")
        self._save(patch, PATCH, "con")
        signals = copy.deepcopy(self._root["tll"])
        for c in signals.findall("connection"):
            if c.get("from") in touched:
                signals.remove(c)  # its number may have changed; netconvert numbers them again
        self._save(signals, BASE, "tll")

    def _keep_junctions(self) -> None:
        """Junctions at changed edges keep their outlines.

        Where edges meet at a small angle, netconvert would make a junction tens of metres longer
        for some decimetres to the side, and cut the edges by that.
        """
        nodes = copy.deepcopy(self._root["nod"])
        ends = {self._edges[e].attrib[end] for e in self.changed for end in ("from", "to")}
        for node in nodes.findall("node"):
            name = node.attrib["id"]
            if name in ends and name in self._outlines:
                node.set("shape", self._outlines[name])
        self._save(nodes, BASE, "nod")

    def _renumbered(
        self, c: Xml.Element, beside: bool = False
    ) -> dict[tuple[str, str, str, str], dict[str, str]]:
        """A connection with the new indices of its lanes.

        Empty where a lane is gone; with `beside`, the nearest lane takes its place.
        """
        a, b = c.attrib["from"], c.get("to")
        if b is None or c.get("fromLane") is None:
            return {}
        i = self._new_index(a, int(c.attrib["fromLane"]), beside)
        j = self._new_index(b, int(c.attrib["toLane"]), beside)
        if i is None or j is None:
            return {}
        skip = {"from", "to", "fromLane", "toLane", "shape", "linkIndex", "linkIndex2"}
        rest = {name: value for name, value in c.attrib.items() if name not in skip}
        return {(a, b, str(i), str(j)): rest}

    def _new_index(self, edge_id: str, index: int, beside: bool) -> int | None:
        edit = self.changed.get(edge_id)
        if edit is None:
            return index
        if edit.reversed:
            return None
        away = {
            k: abs(lane.origin - index)
            for k, lane in enumerate(edit.lanes)
            if lane.origin is not None and (beside or lane.origin == index)
        }
        return min(away, key=lambda k: away[k], default=None)

    def _new_connections(self) -> list[tuple[str, str, str, str]]:
        """Connections of new lanes and reversed edges to the lanes straight ahead."""
        found = []
        for a, b in self._meeting():
            for i, one in enumerate(self._lanes_now(a)):
                for j, other in enumerate(self._lanes_now(b)):
                    new = self._is_new(a, one) or self._is_new(b, other)
                    if new and _continues_in(one, other):
                        found.append((a, b, str(i), str(j)))
        return found

    def _meeting(self) -> list[tuple[str, str]]:
        """Pairs of edges, one ending where the other begins, at least one of them changed."""
        ends = {e: self._ends(e) for e in self._edges if e in self._lanes}
        begins: dict[str, list[str]] = {}
        for edge_id, (first, _) in ends.items():
            begins.setdefault(first, []).append(edge_id)
        return [
            (a, b)
            for a, (_, last) in ends.items()
            for b in begins.get(last, [])
            if a != b and (a in self.changed or b in self.changed)
        ]

    def _ends(self, edge_id: str) -> tuple[str, str]:
        element = self._edges[edge_id]
        ends = (element.attrib["from"], element.attrib["to"])
        edit = self.changed.get(edge_id)
        return ends[::-1] if edit is not None and edit.reversed else ends

    def _lanes_now(self, edge_id: str) -> list[LaneEdit]:
        edit = self.changed.get(edge_id)
        return edit.lanes if edit else [self._lane(a) for a in self._lanes[edge_id]]

    def _is_new(self, edge_id: str, lane: LaneEdit) -> bool:
        edit = self.changed.get(edge_id)
        return edit is not None and (edit.reversed or lane.origin is None)

    def _save(self, root: Xml.Element, stem: str, part: str) -> None:
        Xml.indent(root)
        tree = Xml.ElementTree(root)
        tree.write(self._file(stem, part), encoding="utf-8", xml_declaration=True)


def _lanes_of(net: Path) -> dict[str, list[dict[str, str]]]:
    """Attributes of all lanes by edge, in the order of their indices."""
    found: dict[str, list[dict[str, str]]] = {}
    for edge in parse_xml(net).getroot().iter("edge"):
        if edge.get("function", "normal") == "normal":
            lanes = [dict(lane.attrib) for lane in edge.iter("lane")]
            found[edge.attrib["id"]] = sorted(lanes, key=lambda a: int(a["index"]))
    return found


def _outlines_of(net: Path) -> dict[str, str]:
    """Outlines of the junctions by their ids; dead ends, which have a line only, are left out."""
    junctions = parse_xml(net).getroot().iter("junction")
    shapes = {j.attrib["id"]: j.get("shape", "") for j in junctions}
    return {name: shape for name, shape in shapes.items() if len(shape.split()) >= 3}


def _edge_element(element: Xml.Element, edit: EdgeEdit) -> Xml.Element:
    attributes = dict(element.attrib)
    attributes["numLanes"] = str(len(edit.lanes))
    if edit.reversed:
        attributes["from"], attributes["to"] = attributes["to"], attributes["from"]
        if "shape" in attributes:
            attributes["shape"] = " ".join(reversed(attributes["shape"].split()))
    new = Xml.Element("edge", attributes)
    for param in element.findall("param"):
        new.append(param)
    given = {lane.get("index"): list(lane) for lane in element.findall("lane")}
    for index, lane in enumerate(edit.lanes):
        added = Xml.SubElement(
            new,
            "lane",
            {**lane.rules, "index": str(index), "width": f"{lane.width_m:.2f}"},
            shape=" ".join(",".join(f"{v:.4f}" for v in point) for point in lane.points),
        )
        added.extend(given.get(str(lane.origin), []))
    return new


def _continues_in(one: LaneEdit, other: LaneEdit) -> bool:
    """Whether a lane leads straight into another."""
    heading = _heading(one.shape_m[::-1]) + np.pi
    turn = (_heading(other.shape_m) - heading + np.pi) % (2 * np.pi) - np.pi
    chord = heading + 0.5 * turn  # fits bends as well as straight roads
    gap = other.shape_m[0] - one.shape_m[-1]
    along = gap[0] * np.cos(chord) + gap[1] * np.sin(chord)
    across = gap[1] * np.cos(chord) - gap[0] * np.sin(chord)
    reach = MEET_SHARE * min(one.width_m, other.width_m)
    return bool(
        -BEGIN_BEFORE_M <= along <= MEET_M and abs(across) <= reach and abs(turn) <= MEET_RAD
    )


def _heading(line: NDArray[np.float64]) -> float:
    """Direction of a line over its first `END_M`."""
    away = np.hypot(*(line - line[0]).T)
    end = line[int(np.argmax(away >= END_M))] if away.max() >= END_M else line[-1]
    return float(np.arctan2(*(end - line[0])[::-1]))
