"""Reads a SUMO network file: its lanes, connections and location, which is all the twin needs."""

from __future__ import annotations

import bz2
import gzip
import lzma
import re
import zlib
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from xml.etree import ElementTree as Xml

import numpy as np
from numpy.typing import NDArray

from geoorbit_ros.core.errors import RoadNetworkError

DEFAULT_WIDTH_M = 3.2
"""SUMO's default, where a lane states no width (SUMO user documentation, SUMO Road Networks)."""
CARS = frozenset({"passenger", "private", "hov", "evehicle"})
"""SUMO's classes of which a camera says only that they are cars."""
MOTOR_CLASSES = CARS | {
    "taxi", "bus", "coach", "delivery", "truck", "trailer", "motorcycle", "moped",
}  # fmt: skip
ALL_CLASSES = MOTOR_CLASSES | {
    "emergency", "authority", "army", "vip", "pedestrian", "bicycle", "tram", "rail_urban", "rail",
    "rail_electric", "rail_fast", "ship", "container", "cable_car", "subway", "aircraft",
    "wheelchair", "scooter", "drone", "custom1", "custom2", "ignoring",
}  # fmt: skip
"""All of SUMO's vehicle classes (SUMO user documentation, Abstract Vehicle Class)."""
BOTH_WAYS = "both_ways"
"""Parameter of a lane in the middle of the road for turns from both sides (`lane_access`)."""
_TURNAROUND = frozenset({"t", "T"})
"""Directions of a connection that turns round, in right-hand and left-hand networks (SUMO user
documentation, SUMO Road Networks)."""
_PACKERS: tuple[tuple[str, bytes, Callable[[bytes], bytes]], ...] = (
    ("gzip", b"\x1f\x8b", gzip.decompress),
    ("bzip2", b"BZh", bz2.decompress),
    ("xz", b"\xfd7zXZ\x00", lzma.decompress),
)
_EXPECTED = "a SUMO network (.net.xml or .net.xml.gz)"


@dataclass(frozen=True, slots=True)
class LaneRecord:
    """One lane as the file states it, in the network's own coordinates.

    Attributes:
        lane_id: SUMO's id.
        edge_id: Of the edge that it belongs to.
        index: 0 is the outermost: the rightmost, where traffic drives on the right.
        internal: Whether it crosses a junction.
        speed_mps: Speed limit.
        width_m: Its width.
        length_m: Length as the file states it, which may differ from the shape's.
        shape: (K, 2) centre line in travel order, K >= 2.
        allowed: SUMO's vehicle classes that may use it.
        both_ways: Whether it is the middle of the road, for turns from both sides.
    """

    lane_id: str
    edge_id: str
    index: int
    internal: bool
    speed_mps: float
    width_m: float
    length_m: float
    shape: NDArray[np.float64]
    allowed: frozenset[str]
    both_ways: bool


@dataclass(frozen=True, slots=True)
class Link:
    """A connection from one lane to the next, by their ids.

    Attributes:
        source: Where it begins.
        target: Where it leads; an internal lane where the connection passes one.
        turns_round: Whether it leads back along the same road.
    """

    source: str
    target: str
    turns_round: bool


@dataclass(frozen=True, slots=True)
class NetworkContent:
    """What a network file holds.

    Attributes:
        lanes: Lanes that road vehicles or bicycles may use.
        links: Connections, through internal lanes where there are any.
        projection: PROJ definition; empty when the network has none.
        net_offset: (x, y) added to projected coordinates.
        left_hand: Whether traffic drives on the left.
    """

    lanes: tuple[LaneRecord, ...]
    links: tuple[Link, ...]
    projection: str
    net_offset: tuple[float, float]
    left_hand: bool


def read_unpacked(path: str | Path, expected: str) -> bytes:
    """The content of a file, unpacked where it is packed with gzip, bzip2 or xz.

    Raises:
        RoadNetworkError: No such file, or a broken archive.
    """
    try:
        data = Path(path).read_bytes()
    except OSError as error:
        found = (error.strerror or str(error)).lower()
        raise RoadNetworkError(str(path), found, expected) from error
    for name, begin, unpack in _PACKERS:
        if data.startswith(begin):
            try:
                return unpack(data)
            except (OSError, EOFError, ValueError, zlib.error, lzma.LZMAError) as error:
                raise RoadNetworkError(str(path), f"broken {name} ({error})", expected) from error
    return data


def is_network(path: str | Path) -> bool:
    """Whether a file, packed or not, is a SUMO network; else it may be a map to build one of.

    Raises:
        RoadNetworkError: No such file, or a broken archive.
    """
    expected = f"{_EXPECTED}, or an OpenStreetMap extract"
    return re.search(rb"<net[\s>]", read_unpacked(path, expected)) is not None


def parse_xml(path: str | Path, expected: str = _EXPECTED) -> Xml.ElementTree[Xml.Element]:
    """The tree of an XML file, packed or not.

    Raises:
        RoadNetworkError: No such file, or no XML.
    """
    try:
        return Xml.ElementTree(Xml.fromstring(read_unpacked(path, expected)))
    except Xml.ParseError as error:
        raise RoadNetworkError(str(path), f"broken XML ({error})", expected) from error


def read_network_file(path: str | Path) -> NetworkContent:
    """Read a network.

    Raises:
        RoadNetworkError: No file, no SUMO network, a value that is no number, or no road in it.
    """
    place = str(path)
    root = parse_xml(path).getroot()
    if root.tag != "net":
        raise RoadNetworkError(place, f"a file of <{root.tag}>", _EXPECTED)
    location = root.find("location")
    values = {} if location is None else location.attrib
    try:
        lanes = tuple(_lanes(root))
        x, y = (float(part) for part in values.get("netOffset", "0,0").split(","))
    except (ValueError, KeyError) as error:
        raise RoadNetworkError(place, f"{error}", "numbers and ids as SUMO writes them") from error
    if not lanes:
        raise RoadNetworkError(place, "no lane for road vehicles", "a network with roads")
    projection = values.get("projParameter", "!")
    return NetworkContent(
        lanes,
        tuple(_links(root, {lane.lane_id for lane in lanes})),
        "" if projection in ("!", "-", ".") else projection,
        (x, y),
        root.get("lefthand", "false").lower() in ("true", "1", "yes"),
    )


def _lanes(root: Xml.Element) -> list[LaneRecord]:
    found = []
    for edge in root.iter("edge"):
        function = edge.get("function", "normal")
        if function not in ("normal", "internal", "connector"):
            continue  # crossings and walking areas
        for lane in edge.iter("lane"):
            points = [[float(v) for v in p.split(",")[:2]] for p in lane.attrib["shape"].split()]
            if not np.isfinite(points).all():
                raise ValueError(f"a shape of lane '{lane.get('id')}' that is not finite")
            allowed = allowed_classes(lane)
            both_ways = any(p.get("key") == BOTH_WAYS for p in lane.iter("param"))
            if len(points) < 2 or not (both_ways or allowed & (MOTOR_CLASSES | {"bicycle"})):
                continue
            found.append(
                LaneRecord(
                    lane.attrib["id"],
                    edge.attrib["id"],
                    int(lane.attrib["index"]),
                    function == "internal",
                    float(lane.attrib["speed"]),
                    float(lane.get("width", DEFAULT_WIDTH_M)),
                    float(lane.attrib["length"]),
                    np.array(points),
                    allowed,
                    both_ways,
                )
            )
    return found


def allowed_classes(lane: Xml.Element) -> frozenset[str]:
    """SUMO's vehicle classes that may use a lane, by its attributes `allow` and `disallow`."""
    allow, disallow = lane.get("allow"), lane.get("disallow")
    if allow is not None:
        return ALL_CLASSES if allow == "all" else frozenset(allow.split())
    if disallow is None:
        return ALL_CLASSES
    return frozenset() if disallow == "all" else ALL_CLASSES - set(disallow.split())


def _links(root: Xml.Element, known: set[str]) -> list[Link]:
    """Each connection as two links where it passes an internal lane that is in the file.

    The file also lists the connections from internal lanes on, so each is taken up to its `via`.
    """
    links = []
    for c in root.iter("connection"):
        source, target = f"{c.get('from')}_{c.get('fromLane')}", f"{c.get('to')}_{c.get('toLane')}"
        via = c.get("via", "")
        for end in (via,) if via in known else (target,):
            if source in known and end in known:
                links.append(Link(source, end, c.get("dir") in _TURNAROUND))
    return links
