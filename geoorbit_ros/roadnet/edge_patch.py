"""What netconvert is to change in the edges that it makes of OpenStreetMap.

The users of lanes, cycle lanes, lanes in the middle of the road.
"""

from __future__ import annotations

from xml.etree import ElementTree as Xml

import numpy as np
from numpy.typing import NDArray

from geoorbit_ros.calibration.datum import Datum
from geoorbit_ros.core.polylines import offset_line
from geoorbit_ros.roadnet.driving_side import Side
from geoorbit_ros.roadnet.lane_access import WayCounts, lane_plans
from geoorbit_ros.roadnet.network_file import ALL_CLASSES, BOTH_WAYS, allowed_classes
from geoorbit_ros.roadnet.osm_extract import OsmExtract
from geoorbit_ros.roadnet.osm_file import roads_of, tags_of


def edge_patch(
    extract: OsmExtract, raw: Xml.Element, side: Side, lane_width_m: float, counts: WayCounts
) -> Xml.Element | None:
    """What is to be changed in the edges that netconvert makes of an extract, as its plain XML.

    Args:
        extract: The map, with all tags.
        raw: The network that netconvert makes of it edge by edge, with `prepared` tags.
        side: Where traffic drives.
        lane_width_m: Of lanes that are added.
        counts: Gets the ways whose tags can't be followed.

    Returns:
        None where nothing is to be changed.
    """
    roads = {way.get("id", ""): (way, tags) for way, tags in roads_of(extract.root)}
    patch = Xml.Element("edges")
    for edge in raw.findall("edge"):
        name = edge.attrib["id"]
        number = name.removeprefix("-").partition("#")[0]
        way, tags = roads.get(number, (None, {}))
        if way is None or edge.get("function", "normal") != "normal":
            continue
        lanes = sorted(edge.iter("lane"), key=lambda lane: int(lane.attrib["index"]))
        usual = [allowed_classes(lane) for lane in lanes]
        plans = lane_plans(number, tags, not name.startswith("-"), side, usual, counts)
        if [plan.allowed for plan in plans] == usual:
            continue
        outside = int(plans[0].width_m is not None)
        changed = Xml.SubElement(patch, "edge", id=name, numLanes=str(len(plans)))
        for index, plan in enumerate(plans):
            own = index - outside
            there = (
                float(lanes[own].get("width", lane_width_m)) if own in range(len(lanes)) else None
            )
            width = plan.width_m or there or lane_width_m
            allow = " ".join(sorted(plan.allowed & ALL_CLASSES))
            text = {"index": str(index), "allow": allow, "width": f"{width:g}"}
            lane = Xml.SubElement(changed, "lane", text)
            if plan.both_ways:
                Xml.SubElement(lane, "param", key=BOTH_WAYS, value="yes")
        if plans[-1].both_ways:
            line = _between(extract, way, edge)
            if line is None:
                counts.unclear.append(number)
            else:  # netconvert lets the lanes begin beside the line: half of the middle to its side
                changed.set("shape", _moved(line, 0.5 * lane_width_m, side, extract.middle))
    return patch if len(patch) else None


def _between(
    extract: OsmExtract, way: Xml.Element, edge: Xml.Element
) -> NDArray[np.float64] | None:
    """(K, 2 or 3) latitude, longitude and height of the points of a way that an edge is made of."""
    refs = [nd.attrib["ref"] for nd in way.iter("nd")]
    ends = (edge.attrib["from"], edge.attrib["to"])
    if any(refs.count(end) != 1 for end in ends):
        return None
    first, last = (refs.index(end) for end in ends)
    chosen = refs[first : last + 1] if first < last else refs[last : first + 1][::-1]
    nodes = {n.get("id"): n for n in extract.root.iter("node") if n.get("id") in set(chosen)}
    rows = []
    for ref in chosen:
        row = [float(nodes[ref].attrib["lat"]), float(nodes[ref].attrib["lon"])]
        rows.append(row + ([float(tags_of(nodes[ref])["ele"])] if extract.has_heights else []))
    return np.array(rows)


def _moved(line: NDArray[np.float64], inwards_m: float, side: Side, middle: Datum) -> str:
    """A line (K, 2 or 3) of `_between`, moved towards the middle of the road, for netconvert."""
    left_m = inwards_m if side == "right" else -inwards_m
    moved = middle.to_geodetic(offset_line(middle.to_local(line[:, 0], line[:, 1]), left_m))
    points = np.column_stack((moved[:, ::-1], line[:, 2:]))
    return " ".join(",".join(f"{value:.9f}" for value in point) for point in points)
