"""Lane maps as OpenDRIVE 1.4: one road per lane, its reference line the lane's centreline.

One road per lane keeps each lane's own ends, width and heading; a road with several lanes would
need lane sections for that. Simulators read both (ADR 0027). Distances are metres in the plane of
the map's datum, which the header states as a transverse Mercator projection.
"""

from __future__ import annotations

from xml.etree import ElementTree as Xml

import numpy as np
from numpy.typing import NDArray

from geoorbit_ros.core.lanes import Lane, LaneEdge
from geoorbit_ros.exchange import file_facts, lane_facts
from geoorbit_ros.lanes.geojson import LaneFile

REVISION = ("1", "4")
"""What CARLA 0.9 and SUMO read."""
ROAD_MARKS = {"": "none", "solid": "solid", "dashed": "broken", "double": "solid solid"}
"""OpenDRIVE's names of markings (1.4, table 33)."""
MARK_WIDTH_M = 0.12
"""Of a line whose width isn't known: the usual one between lanes."""


def to_opendrive(file: LaneFile) -> str:
    """A lane map as the text of an `.xodr` file.

    Args:
        file: Lanes in metres around the file's datum, with boundaries beside their centrelines.
    """
    root = Xml.Element("OpenDRIVE")
    points = np.concatenate([lane.centerline_m for lane in file.lane_map.lanes])
    (west, south), (east, north) = points.min(axis=0), points.max(axis=0)
    header = Xml.SubElement(
        root,
        "header",
        revMajor=REVISION[0],
        revMinor=REVISION[1],
        name=file.camera_id,
        version="1.00",
        north=_number(north),
        south=_number(south),
        east=_number(east),
        west=_number(west),
    )
    Xml.SubElement(header, "geoReference").text = file.datum.proj_string
    for code, value in file_facts(file).items():
        Xml.SubElement(header, "userData", code=code, value=value)
    for lane in file.lane_map.lanes:
        _add_road(root, lane)
    Xml.indent(root)
    return Xml.tostring(root, encoding="unicode", xml_declaration=True) + "\n"


def _add_road(root: Xml.Element, lane: Lane) -> None:
    step = np.diff(lane.centerline_m, axis=0)
    length = np.hypot(step[:, 0], step[:, 1])
    s = np.append(0.0, np.cumsum(length))
    road = Xml.SubElement(
        root,
        "road",
        name=f"lane {lane.lane_id}",
        length=_number(s[-1]),
        id=str(lane.lane_id),
        junction="-1",
    )
    Xml.SubElement(road, "link")
    plan = Xml.SubElement(road, "planView")
    for k, (dx, dy) in enumerate(step):
        x, y = lane.centerline_m[k]
        line = Xml.SubElement(
            plan,
            "geometry",
            s=_number(s[k]),
            x=_number(x),
            y=_number(y),
            hdg=_number(np.arctan2(dy, dx)),
            length=_number(length[k]),
        )
        Xml.SubElement(line, "line")
    left, right = _side_distances(lane)
    lanes = Xml.SubElement(road, "lanes")
    # The lane lies right of the reference line, which is moved to the left boundary for that.
    _add_polynomials(lanes, "laneOffset", "s", s, left)
    section = Xml.SubElement(lanes, "laneSection", s="0")
    centre = Xml.SubElement(section, "center")
    border = Xml.SubElement(centre, "lane", id="0", type="none", level="false")
    _add_mark(border, lane.left_edge)
    side = Xml.SubElement(section, "right")
    driving = Xml.SubElement(side, "lane", id="-1", type="driving", level="false")
    _add_polynomials(driving, "width", "sOffset", s, left + right)
    _add_mark(driving, lane.right_edge)
    for code, value in lane_facts(lane).items():
        Xml.SubElement(driving, "userData", code=code, value=value)


def _add_mark(border: Xml.Element, edge: LaneEdge | None) -> None:
    """The painted line of a boundary, where the camera saw one (OpenDRIVE 1.4, 5.3.7.2.1.1.4)."""
    if edge is None or edge.source != "paint":
        return
    Xml.SubElement(
        border,
        "roadMark",
        sOffset="0",
        type=ROAD_MARKS[edge.marking],
        weight="standard",
        color="yellow" if edge.colour == "yellow" else "standard",
        width=_number(edge.marking_width_m if np.isfinite(edge.marking_width_m) else MARK_WIDTH_M),
        laneChange="both" if edge.marking == "dashed" else "none",
    )


def _side_distances(lane: Lane) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Distance of the left and right boundary at each point of the centreline, metres."""
    sides = (lane.left_m, lane.right_m)
    left, right = (np.hypot(*(side - lane.centerline_m).T) for side in sides)
    return np.asarray(left), np.asarray(right)


def _add_polynomials(
    parent: Xml.Element, tag: str, at: str, s: NDArray[np.float64], value: NDArray[np.float64]
) -> None:
    """A function of s as pieces a + b ds; one where it is constant to a millimetre."""
    constant = np.ptp(value) < 1e-3
    knots = [0] if constant else range(len(s) - 1)
    for k in knots:
        slope = 0.0 if constant else (value[k + 1] - value[k]) / (s[k + 1] - s[k])
        level = float(np.mean(value)) if constant else value[k]
        pieces = {at: _number(s[k]), "a": _number(level), "b": _number(slope), "c": "0", "d": "0"}
        Xml.SubElement(parent, tag, pieces)


def _number(value: float) -> str:
    return f"{float(value):.9g}"
