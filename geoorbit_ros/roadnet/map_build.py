"""A SUMO network and OpenDRIVE from OpenStreetMap or another network; networks moved as a whole."""

from __future__ import annotations

import gzip
import json
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from xml.etree import ElementTree as Xml

import numpy as np
from numpy.typing import NDArray

from geoorbit_ros.calibration.datum import Datum
from geoorbit_ros.core.errors import ParameterError
from geoorbit_ros.roadnet.driving_side import (
    SIDES,
    DrivingSide,
    Side,
    choose_side,
    side_doubt,
)
from geoorbit_ros.roadnet.errors import RoadNetworkError
from geoorbit_ros.roadnet.netconvert import drop_header, netconvert, netconvert_version
from geoorbit_ros.roadnet.network import RoadNetwork, load_network
from geoorbit_ros.roadnet.network_file import parse_xml

Move = Callable[[NDArray[np.float64]], NDArray[np.float64]]
"""Takes points (N, 2) to where they are to be."""

_SHAPES = ("shape", "outlineShape")
NETWORK, OPENDRIVE, RECORD = "network.net.xml", "road.xodr", "map.json"
LANE_WIDTH_M = 3.5
"""For lanes whose width the map does not state: between the 3.66 m of US freeways (AASHTO, A Policy
on Geometric Design of Highways and Streets) and the 3.25 m of European city streets."""
_OSM_EXPECTED = "an OpenStreetMap extract (.osm or .osm.gz)"
_OSM_OPTIONS = (
    "--geometry.remove=true",
    "--roundabouts.guess=true",
    "--ramps.guess=true",
    "--junctions.join=true",
    "--no-turnarounds=true",
    "--keep-edges.by-vclass=passenger",
    "--output.street-names=true",
    "--output.original-names=true",
    "--offset.disable-normalization=true",
)


@dataclass(frozen=True, slots=True)
class BuiltMap:
    """What a build gave.

    Attributes:
        network: The network, its coordinates being the map frame at its datum.
        opendrive: Roads in the OpenDRIVE file.
        warnings: What netconvert warned of, one sentence each.
        said: What the user should know about the map, in sentences.
    """

    network: RoadNetwork
    opendrive: int
    warnings: tuple[str, ...]
    said: tuple[str, ...] = ()


def build_from_osm(
    area: Path,
    folder: Path,
    datum: Datum | None = None,
    lane_width_m: float = LANE_WIDTH_M,
    side: Side | None = None,
) -> BuiltMap:
    """Write network, OpenDRIVE and record of an OpenStreetMap extract into a folder.

    Args:
        area: The extract.
        folder: Where the files go.
        datum: Origin of the coordinates; default: the middle of the extract's roads.
        lane_width_m: For lanes whose width the map doesn't state.
        side: Where traffic drives; default: by the map's tags, or by its place.

    Raises:
        RoadNetworkError: No map, no road in it, netconvert refuses it, or SUMO is not installed.
        ParameterError: The side of the road can't be known.
    """
    roads = _roads(area)
    chosen = choose_side(side, roads.tagged_m, roads.length_m, roads.middle, str(area))
    datum = datum or roads.middle
    source = area
    if area.suffix == ".gz":  # netconvert reads gzip by its name .osm.xml.gz alone
        source = folder / "area.osm.xml"
        source.write_bytes(gzip.decompress(area.read_bytes()))
    net = folder / NETWORK
    options = [
        *_OSM_OPTIONS,
        f"--default.lanewidth={lane_width_m:g}",
        f"--proj={datum.proj_string}",
        *(["--lefthand=true"] if chosen.side == "left" else []),
    ]
    warnings = netconvert([f"--osm-files={source}", f"--output-file={net}", *options], str(area))
    if source != area:
        source.unlink()
    return _finish(folder, datum, area, options, warnings, chosen)


def build_from_network(
    net: Path, folder: Path, datum: Datum | None = None, given: Side | None = None
) -> BuiltMap:
    """Write an existing network, moved into the map frame, its OpenDRIVE and the record.

    Args:
        net: A SUMO network with a projection.
        folder: Where the files go.
        datum: Origin of the coordinates; default: the middle of the network.
        given: Where traffic drives, as the user says; the network must say the same.

    Raises:
        RoadNetworkError: The network can't be used, netconvert refuses it, or SUMO is missing.
        ParameterError: The network's traffic drives on the other side.
    """
    network = load_network(net, datum)
    write_reprojected(network, folder / NETWORK)
    side: Side = "left" if network.left_hand else "right"
    if given not in (None, side):
        found = f"{given}, but the network's lanes are made for traffic on the {side}"
        raise ParameterError("option --driving-side", found, f"{side}, or an OpenStreetMap extract")
    doubt = side_doubt(side, network.datum)
    return _finish(
        folder, network.datum, net, [], (), DrivingSide(side, "as the network says", doubt)
    )


def _finish(
    folder: Path,
    datum: Datum,
    source: Path,
    options: list[str],
    warnings: tuple[str, ...],
    side: DrivingSide,
) -> BuiltMap:
    network = load_network(folder / NETWORK, datum)
    opendrive = folder / OPENDRIVE
    export = ["--opendrive-output.straight-threshold=0.00000001"]
    warnings += netconvert(
        [f"--sumo-net-file={folder / NETWORK}", f"--opendrive-output={opendrive}", *export],
        str(source),
    )
    roads = _check_opendrive(opendrive, datum)
    for file in (folder / NETWORK, opendrive):
        drop_header(file)
    record = {
        "source": source.name,
        "datum": {"latitude_deg": datum.latitude_deg, "longitude_deg": datum.longitude_deg},
        "projection": datum.proj_string,
        "driving_side": {"side": side.side, "why": side.why, "doubt": side.doubt},
        "netconvert": {
            "version": netconvert_version(),
            "network_options": options,
            "opendrive_options": export,
            "warnings": list(warnings),
        },
        "lanes": int(np.count_nonzero(~network.internal)),
        "edges": len({e for e, i in zip(network.edge_id, network.internal, strict=True) if not i}),
    }
    text = json.dumps(record, indent=2, ensure_ascii=False)
    (folder / RECORD).write_text(text + "\n", encoding="utf-8")
    return BuiltMap(network, roads, warnings, (side.sentence,))


@dataclass(frozen=True, slots=True)
class _Roads:
    """The roads of an extract.

    Attributes:
        middle: To seven decimals of a degree.
        length_m: Of all.
        tagged_m: Of those whose tags say on which side traffic drives.
    """

    middle: Datum
    length_m: float
    tagged_m: dict[Side, float]


def _roads(area: Path) -> _Roads:
    """Read what decides where and how a network is made of an extract.

    Raises:
        RoadNetworkError: No map, or no road in it.
    """
    root = parse_xml(area, _OSM_EXPECTED).getroot()
    if root.tag != "osm":
        raise RoadNetworkError(str(area), f"a file of <{root.tag}>", _OSM_EXPECTED)
    ways = {
        way: {tag.get("k", ""): tag.get("v", "") for tag in way.iter("tag")}
        for way in root.iter("way")
    }
    roads = {way: tags for way, tags in ways.items() if "highway" in tags}
    used = {node.get("ref") for way in roads for node in way.iter("nd")}
    try:
        places = {
            node.attrib["id"]: (float(node.attrib["lat"]), float(node.attrib["lon"]))
            for node in root.iter("node")
            if node.get("id") in used
        }
    except (KeyError, ValueError) as error:
        raise RoadNetworkError(str(area), f"a node without {error}", _OSM_EXPECTED) from error
    if not places:
        raise RoadNetworkError(str(area), "no road (way with the tag highway)", _OSM_EXPECTED)
    corners = np.array(list(places.values()))
    latitude, longitude = 0.5 * (corners.min(axis=0) + corners.max(axis=0))
    middle = Datum(round(float(latitude), 7), round(float(longitude), 7))
    length_m, tagged_m = 0.0, dict.fromkeys(SIDES, 0.0)
    for way, tags in roads.items():
        line = np.array([places[ref] for nd in way.iter("nd") if (ref := nd.get("ref")) in places])
        if len(line) > 1:
            metres = float(np.hypot(*np.diff(middle.to_local(*line.T), axis=0).T).sum())
            length_m += metres
            if (side := tags.get("driving_side")) in tagged_m:
                tagged_m[side] += metres
    return _Roads(middle, length_m, tagged_m)


def _check_opendrive(path: Path, datum: Datum) -> int:
    """Check the georeference that CARLA reads; the number of roads outside junctions.

    CARLA 0.9.16 reads `+proj=tmerc` with `lat_0` and `lon_0`; with UTM the road is misplaced.
    """
    root = parse_xml(path, "the OpenDRIVE file that netconvert wrote").getroot()
    reference = root.findtext("header/geoReference", "").strip()
    if reference != datum.proj_string:
        found = f"georeference '{reference}'"
        raise RoadNetworkError(str(path), found, f"'{datum.proj_string}'")
    return sum(road.get("junction") == "-1" for road in root.iter("road"))


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
    """Write a network with all its coordinates moved; its projection stays the same.

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
            points_of = [point.split(",") for point in shape.split()]
            moved = move(np.array([[float(point[0]), float(point[1])] for point in points_of]))
            points.append(moved)
            rest = ["," + ",".join(point[2:]) if point[2:] else "" for point in points_of]
            text = (f"{x:.3f},{y:.3f}{z}" for (x, y), z in zip(moved, rest, strict=True))
            element.set(name, " ".join(text))
        if element.tag == "junction" and element.get("x") is not None:
            x, y = move(np.array([[float(element.attrib["x"]), float(element.attrib["y"])]]))[0]
            element.set("x", f"{x:.3f}")
            element.set("y", f"{y:.3f}")
    bounds = np.concatenate(points)
    corners = (*bounds.min(axis=0), *bounds.max(axis=0))
    return ",".join(f"{value:.2f}" for value in corners)
