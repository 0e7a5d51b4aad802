"""A network moved into the map frame, so that its coordinates are metres at the datum."""

from __future__ import annotations

from pathlib import Path
from xml.etree import ElementTree as Xml

import numpy as np

from geoorbit_ros.twin.network import RoadNetwork
from geoorbit_ros.twin.network_file import parse_xml

_SHAPES = ("shape", "customShape", "outlineShape")


def write_reprojected(network: RoadNetwork, out: Path) -> None:
    """Write a network with all its coordinates in the map frame at `network.datum`.

    Ids, connections, widths and rules stay; so do SUMO's lane lengths, which a projection's scale
    changes by 4e-4 at most (UTM).
    """
    tree = parse_xml(network.path)
    root = tree.getroot()
    move = network.plane.to_map.points
    points = []
    for element in root.iter():
        for name in _SHAPES:
            shape = element.get(name)
            if not shape:
                continue
            words = [word.split(",") for word in shape.split()]
            moved = move([[float(word[0]), float(word[1])] for word in words])
            points.append(moved)
            rest = ["," + ",".join(word[2:]) if word[2:] else "" for word in words]
            text = (f"{x:.3f},{y:.3f}{z}" for (x, y), z in zip(moved, rest, strict=True))
            element.set(name, " ".join(text))
        if element.tag == "junction" and element.get("x") is not None:
            x, y = move([[float(element.attrib["x"]), float(element.attrib["y"])]])[0]
            element.set("x", f"{x:.3f}")
            element.set("y", f"{y:.3f}")
    place = root.find("location")
    if place is None:
        place = Xml.SubElement(root, "location", origBoundary="0,0,0,0")
    bounds = np.concatenate(points)
    corners = (*bounds.min(axis=0), *bounds.max(axis=0))
    place.set("netOffset", "0.00,0.00")
    place.set("convBoundary", ",".join(f"{value:.2f}" for value in corners))
    place.set("projParameter", network.datum.proj_string)
    tree.write(out, encoding="utf-8", xml_declaration=True)
