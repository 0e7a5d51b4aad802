"""Networks moved: into the map frame, so that coordinates are metres at the datum; on earth."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from xml.etree import ElementTree as Xml

import numpy as np
from numpy.typing import NDArray

from geoorbit_ros.roadnet.network import RoadNetwork
from geoorbit_ros.roadnet.network_file import parse_xml

Move = Callable[[NDArray[np.float64]], NDArray[np.float64]]
_SHAPES = ("shape", "outlineShape")


def write_reprojected(network: RoadNetwork, out: Path) -> None:
    """Write a network with all its coordinates in the map frame at `network.datum`.

    Ids, connections, widths and rules stay; so do SUMO's lane lengths, which a projection's scale
    changes by 4e-4 at most (UTM).
    """
    root = parse_xml(network.path).getroot()
    bounds = _move(root, network.plane.to_map.points)
    place = root.find("location")
    if place is None:
        place = Xml.SubElement(root, "location", origBoundary="0,0,0,0")
    place.set("netOffset", "0.00,0.00")
    place.set("convBoundary", bounds)
    place.set("projParameter", network.datum.proj_string)
    Xml.ElementTree(root).write(out, encoding="utf-8", xml_declaration=True)


def write_moved(network: RoadNetwork, move: Move, out: Path) -> None:
    """Write a network with all of it moved; its coordinates stay of the kind they are.

    Args:
        network: The network.
        move: Takes points (N, 2) of the map frame to where they are to be.
        out: The file.
    """
    root = parse_xml(network.path).getroot()
    plane = network.plane
    bounds = _move(root, lambda xy: plane.to_network.points(move(plane.to_map.points(xy))))
    if (place := root.find("location")) is not None:
        place.set("convBoundary", bounds)
    Xml.ElementTree(root).write(out, encoding="utf-8", xml_declaration=True)


def _move(root: Xml.Element, move: Move) -> str:
    """Move all coordinates; the boundary of the result as SUMO writes it."""
    points = []
    for element in root.iter():
        for name in _SHAPES:
            shape = element.get(name)
            if not shape:
                continue
            words = [word.split(",") for word in shape.split()]
            moved = move(np.array([[float(word[0]), float(word[1])] for word in words]))
            points.append(moved)
            rest = ["," + ",".join(word[2:]) if word[2:] else "" for word in words]
            text = (f"{x:.3f},{y:.3f}{z}" for (x, y), z in zip(moved, rest, strict=True))
            element.set(name, " ".join(text))
        if element.tag == "junction" and element.get("x") is not None:
            x, y = move(np.array([[float(element.attrib["x"]), float(element.attrib["y"])]]))[0]
            element.set("x", f"{x:.3f}")
            element.set("y", f"{y:.3f}")
    bounds = np.concatenate(points)
    corners = (*bounds.min(axis=0), *bounds.max(axis=0))
    return ",".join(f"{value:.2f}" for value in corners)
