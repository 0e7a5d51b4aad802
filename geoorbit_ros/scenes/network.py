"""The scene's roads as a SUMO network, made by SUMO's own netconvert."""

from __future__ import annotations

from pathlib import Path
from xml.etree import ElementTree as Xml

import numpy as np
from numpy.typing import NDArray

from geoorbit_ros.calibration.datum import Datum
from geoorbit_ros.roadnet.netconvert import netconvert
from geoorbit_ros.scenes.roads import PlacedRoad, successors


def write_network(placed: dict[str, PlacedRoad], folder: Path, datum: Datum | None = None) -> Path:
    """Write plain XML, run netconvert, return the path of `net.xml`.

    Args:
        placed: The roads, in the map frame.
        folder: Where the files go.
        datum: Origin of the map frame; with it the network says where on earth it lies.

    Raises:
        RoadNetworkError: netconvert is not there, refuses the roads or does not end.
    """
    for stem, tree in _plain_xml(placed).items():
        Xml.ElementTree(tree).write(folder / f"scene.{stem}.xml", encoding="utf-8")
    net = _netconvert(folder)
    if datum is not None:
        text = net.read_text(encoding="utf-8")
        origin = f'projParameter="{datum.proj_string}"'
        net.write_text(text.replace('projParameter="!"', origin, 1), encoding="utf-8")
    return net


def _plain_xml(placed: dict[str, PlacedRoad]) -> dict[str, Xml.Element]:
    """SUMO's nodes (`nod`), edges (`edg`) and connections (`con`)."""
    nodes, edges = Xml.Element("nodes"), Xml.Element("edges")
    connections = Xml.Element("connections")
    start = {name: _start_node(name, p) for name, p in placed.items()}
    end = {name: _end_node(name, p, start) for name, p in placed.items()}
    positions: dict[str, NDArray[np.float64]] = {}
    for name, place in placed.items():
        positions.setdefault(end[name], place.border_m[-1])
        if start[name] == f"{name}_start":
            positions[start[name]] = place.border_m[0]
    for node, (x, y) in sorted(positions.items()):
        Xml.SubElement(nodes, "node", id=node, x=f"{x:.4f}", y=f"{y:.4f}", keepClear="false")
    for name, place in placed.items():
        shape = " ".join(f"{x:.4f},{y:.4f}" for x, y in place.border_m)
        Xml.SubElement(
            edges,
            "edge",
            {"id": name, "from": start[name], "to": end[name]},
            numLanes=str(place.road.lanes),
            width=f"{place.width_m:.3f}",
            speed=f"{place.road.speed_kmh / 3.6:.3f}",
            shape=shape,
            spreadType="right",
        )
    for (road, lane), nexts in successors(placed).items():
        for next_road, next_lane in nexts:
            Xml.SubElement(
                connections,
                "connection",
                {"from": road, "to": next_road},
                fromLane=str(lane),
                toLane=str(next_lane),
            )
    return {"nod": nodes, "edg": edges, "con": connections}


def _netconvert(folder: Path) -> Path:
    """The network that netconvert makes of the plain XML in a folder."""
    net = folder / "scene.net.xml"
    netconvert(
        [
            f"--node-files={folder / 'scene.nod.xml'}",
            f"--edge-files={folder / 'scene.edg.xml'}",
            f"--connection-files={folder / 'scene.con.xml'}",
            f"--output-file={net}",
            "--offset.disable-normalization=true",
            "--no-turnarounds=true",
            "--junctions.limit-turn-speed=-1",
            "--geometry.max-angle.fix=false",
        ],
        "the scene's roads",
    )
    return net


def _start_node(name: str, place: PlacedRoad) -> str:
    if place.road.follows:
        return f"{place.road.follows}_end"
    if place.road.leaves:
        return f"{place.road.leaves.road}_end"
    return f"{name}_start"


def _end_node(name: str, place: PlacedRoad, start: dict[str, str]) -> str:
    """A ramp ends at the node where the road that it joins begins."""
    return start[place.road.joins.road] if place.road.joins else f"{name}_end"
