"""Lane maps as SUMO networks: one edge per carriageway, made by SUMO's netconvert."""

from __future__ import annotations

import tempfile
from collections.abc import Mapping, Sequence
from pathlib import Path
from xml.etree import ElementTree as Xml

import numpy as np
import scipy
from numpy.typing import NDArray

from geoorbit_ros.core.lanes import Lane
from geoorbit_ros.core.polylines import project, sample
from geoorbit_ros.exchange import file_facts, lane_facts
from geoorbit_ros.lanes.geojson import LaneFile
from geoorbit_ros.roadnet.driving_side import Side
from geoorbit_ros.roadnet.netconvert import netconvert

MAX_GAP_M = 1.0
"""Between the boundaries of neighbouring lanes. Chosen: larger joins lanes beside a reserve or a
missing lane, smaller separates lanes of uncertain width."""
MAX_TURN_RAD = np.radians(20.0)
"""Between the directions of neighbouring lanes. Chosen: larger joins ramps to the road, smaller
separates lanes in bends."""
MIN_SHARE = 0.6
"""Of the longer lane's length, this share lies beside the shorter one. Chosen: larger separates
lanes that are seen over different lengths, smaller makes edges whose lanes end far apart."""
STEP_M = 2.0
"""Between points at which lanes are compared. Chosen: smaller costs time."""
MAY_CROSS = "emergency authority"
"""SUMO's classes of vehicles that may cross a solid line."""
SPEED_MPS = 13.89
"""50 km/h for all lanes, because a lane map has no limits. Chosen: the usual limit in towns."""


def carriageways(lanes: Sequence[Lane], side: Side = "right") -> list[list[Lane]]:
    """Groups of neighbouring lanes of one direction and similar length, the outermost first.

    Args:
        lanes: In the map frame.
        side: Where traffic drives: the outermost lane is the rightmost, or the leftmost.
    """
    outwards = 1.0 if side == "right" else -1.0
    pairs = [
        (i, j)
        for i, a in enumerate(lanes)
        for j, b in enumerate(lanes)
        if i != j and _neighbours(a, b)
    ]
    rows, columns = np.array(pairs, dtype=np.int64).reshape(-1, 2).T
    linked = scipy.sparse.coo_array(
        (np.ones(len(pairs)), (rows, columns)), shape=(len(lanes), len(lanes))
    )
    _, label = scipy.sparse.csgraph.connected_components(linked, directed=False)
    groups = [
        [lane for lane, k in zip(lanes, label, strict=True) if k == wanted]
        for wanted in np.unique(label)
    ]
    return [
        sorted(group, key=lambda lane: outwards * _offset_m(lane, group[0])) for group in groups
    ]


def _neighbours(a: Lane, b: Lane) -> bool:
    """Whether `b` lies directly left or right of `a`; asked in both orders."""
    points = sample(a.centerline_m, STEP_M)
    beside = project(points.point_m, b.centerline_m)
    if not beside.inside.any() or beside.inside.mean() < MIN_SHARE:
        return False
    inside = beside.inside
    cosine = np.sum(points.tangent[inside] * beside.tangent[inside], axis=1)
    gap_m = np.abs(beside.offset_m[inside]) - 0.5 * (a.width_m + b.width_m)
    return bool(
        np.median(cosine) > np.cos(MAX_TURN_RAD) and abs(float(np.median(gap_m))) <= MAX_GAP_M
    )


def _offset_m(lane: Lane, reference: Lane) -> float:
    """How far left of the reference a lane lies, at its middle."""
    x, y, _ = lane.middle
    return float(project(np.array([[x, y]]), reference.centerline_m).offset_m[0])


def to_sumo(file: LaneFile, side: Side = "right") -> str:
    """A lane map as the text of a `.net.xml` file.

    Args:
        file: The lane map.
        side: Where traffic drives.

    Raises:
        RoadNetworkError: SUMO is not installed, or netconvert refuses the lanes.
    """
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        nodes, edges = _plain_xml(file, side)
        for plain, root in (("lanes.nod.xml", nodes), ("lanes.edg.xml", edges)):
            Xml.ElementTree(root).write(folder / plain, encoding="utf-8", xml_declaration=True)
        netconvert(
            [
                *("--node-files", "lanes.nod.xml", "--edge-files", "lanes.edg.xml"),
                *("--output-file", "lanes.net.xml", "--offset.disable-normalization"),
                *("--precision", "4", "--no-internal-links", "--no-turnarounds"),
                *(["--lefthand"] if side == "left" else []),
            ],
            f"lanes of '{file.camera_id}'",
            folder,
        )
        return (folder / "lanes.net.xml").read_text(encoding="utf-8")


def _plain_xml(file: LaneFile, side: Side) -> tuple[Xml.Element, Xml.Element]:
    nodes, edges = Xml.Element("nodes"), Xml.Element("edges")
    points = np.concatenate([lane.centerline_m for lane in file.lane_map.lanes])
    bounds = ",".join(f"{value:.4f}" for value in (*points.min(axis=0), *points.max(axis=0)))
    Xml.SubElement(
        nodes,
        "location",
        netOffset="0,0",
        convBoundary=bounds,
        origBoundary=bounds,
        projParameter=file.datum.proj_string,
    )
    for group in carriageways(file.lane_map.lanes, side):
        name = f"lanes_{'_'.join(str(lane.lane_id) for lane in group)}"
        reference_line = group[len(group) // 2].centerline_m
        for end, (x, y) in (("start", reference_line[0]), ("end", reference_line[-1])):
            Xml.SubElement(nodes, "node", id=f"{name}_{end}", x=f"{x:.4f}", y=f"{y:.4f}")
        edge = Xml.SubElement(
            edges,
            "edge",
            {"id": name, "from": f"{name}_start", "to": f"{name}_end"},
            numLanes=str(len(group)),
            speed=f"{SPEED_MPS}",
            shape=_shape(reference_line),
            spreadType="center",
        )
        for index, lane in enumerate(group):
            changes = _changes(lane, index, len(group)) if side == "right" else {}
            _add_lane(edge, index, lane, changes)
        _add_facts(edge, file_facts(file))
    return nodes, edges


def _changes(lane: Lane, index: int, lanes: int) -> dict[str, str]:
    """Who may change to a neighbour: over a solid line only those who may do so anywhere.

    Only where vehicles drive on the right: there SUMO's lanes count from the right.
    """
    sides = {"changeLeft": (lane.left_edge, index + 1 < lanes)}
    sides["changeRight"] = (lane.right_edge, index > 0)
    return {
        name: MAY_CROSS
        for name, (edge, neighbour) in sides.items()
        if neighbour and edge is not None and edge.marking in ("solid", "double")
    }


def _add_lane(edge: Xml.Element, index: int, lane: Lane, changes: dict[str, str]) -> None:
    element = Xml.SubElement(
        edge,
        "lane",
        changes,
        index=str(index),
        width=f"{lane.width_m:.3f}",
        shape=_shape(lane.centerline_m),
    )
    _add_facts(element, lane_facts(lane))


def _add_facts(element: Xml.Element, facts: Mapping[str, str]) -> None:
    for key, value in facts.items():
        Xml.SubElement(element, "param", key=key, value=value)


def _shape(points_m: NDArray[np.float64]) -> str:
    return " ".join(f"{x:.4f},{y:.4f}" for x, y in points_m)
