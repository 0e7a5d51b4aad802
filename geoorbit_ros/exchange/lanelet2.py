"""Lane maps as Lanelet2 maps in OSM XML: one lanelet per lane, with its boundaries as ways.

Tags follow Lanelet2's documentation (LaneletAndAreaTagging.md). Neighbouring lanelets don't share
a boundary: each keeps its measured one.
"""

from __future__ import annotations

from itertools import count
from xml.etree import ElementTree as Xml

import numpy as np
from numpy.typing import NDArray

from geoorbit_ros.core.lanes import LaneEdge
from geoorbit_ros.exchange import file_facts, lane_facts
from geoorbit_ros.lanes.geojson import LaneFile

SUBTYPES = {"": "", "solid": "solid", "dashed": "dashed", "double": "solid_solid"}
"""Lanelet2's names of markings (LinestringsAndPolygonsTagging)."""
THICK_M = 0.2
"""Width from which a line is thick. Chosen: between that of lane lines (0.10 to 0.15 m) and of edge
lines (0.25 to 0.30 m)."""
DECIMALS = 11
"""Of degrees: steps of 1 micrometre. Chosen: fewer move points that lie close together."""


def to_lanelet2(file: LaneFile) -> str:
    """A lane map as the text of an `.osm` file."""
    root = Xml.Element("osm", version="0.6", generator=file_facts(file)["geoorbit:generator"])
    ids = count(1)
    nodes: list[Xml.Element] = []
    ways: list[Xml.Element] = []
    relations: list[Xml.Element] = []

    def add_way(points_m: NDArray[np.float64], edge: LaneEdge | None) -> str:
        way = _element("way", next(ids))
        for latitude, longitude in file.datum.to_geodetic(points_m):
            node = _element("node", next(ids))
            node.set("lat", f"{latitude:.{DECIMALS}f}")
            node.set("lon", f"{longitude:.{DECIMALS}f}")
            nodes.append(node)
            Xml.SubElement(way, "nd", ref=node.attrib["id"])
        _tag(way, _line_tags(edge))
        ways.append(way)
        return way.attrib["id"]

    for lane in file.lane_map.lanes:
        members = {
            "left": add_way(lane.left_m, lane.left_edge),
            "right": add_way(lane.right_m, lane.right_edge),
        }
        relation = _element("relation", next(ids))
        for role, way_id in members.items():
            Xml.SubElement(relation, "member", type="way", ref=way_id, role=role)
        _tag(
            relation,
            {
                "type": "lanelet",
                "subtype": "road",
                "location": "urban",
                "one_way": "yes",
                "participant:vehicle": "yes",
                **lane_facts(lane),
                **file_facts(file),
            },
        )
        relations.append(relation)
    root.extend([*nodes, *ways, *relations])
    Xml.indent(root)
    return Xml.tostring(root, encoding="unicode", xml_declaration=True) + "\n"


def _line_tags(edge: LaneEdge | None) -> dict[str, str]:
    """Type of a boundary: a painted line, or a virtual one where only vehicles were seen."""
    if edge is None or edge.source != "paint":
        return {"type": "virtual"}
    thick = edge.marking_width_m > THICK_M and edge.marking != "double"
    kind = "line_thick" if thick else "line_thin"
    return {"type": kind, "subtype": SUBTYPES[edge.marking], "color": edge.colour}


def _element(kind: str, number: int) -> Xml.Element:
    return Xml.Element(kind, id=str(number), visible="true", version="1")


def _tag(element: Xml.Element, tags: dict[str, str]) -> None:
    for key, value in tags.items():
        Xml.SubElement(element, "tag", k=key, v=value)
