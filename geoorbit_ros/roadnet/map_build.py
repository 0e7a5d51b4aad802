"""A SUMO network and OpenDRIVE from OpenStreetMap or another network; networks moved as a whole."""

from __future__ import annotations

import json
from collections import Counter
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from tempfile import TemporaryDirectory
from xml.etree import ElementTree as Xml

import numpy as np
from numpy.typing import NDArray

from geoorbit_ros.calibration.datum import Datum
from geoorbit_ros.core.errors import ParameterError, RoadNetworkError
from geoorbit_ros.core.input_report import InputReport, Treatment
from geoorbit_ros.core.polylines import offset_line
from geoorbit_ros.roadnet.driving_side import DrivingSide, Side, choose_side, side_doubt
from geoorbit_ros.roadnet.lane_access import WayCounts, lane_plans, prepared
from geoorbit_ros.roadnet.netconvert import drop_header, netconvert, netconvert_version
from geoorbit_ros.roadnet.network import RoadNetwork, load_network
from geoorbit_ros.roadnet.network_file import ALL_CLASSES, BOTH_WAYS, allowed_classes, parse_xml
from geoorbit_ros.roadnet.osm_extract import OsmExtract, read_extract
from geoorbit_ros.roadnet.osm_file import roads_of, set_tags, tags_of


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
    names = {edge.attrib["id"] for edge in raw.findall("edge")}
    for edge in raw.findall("edge"):
        name = edge.attrib["id"]
        number = name.removeprefix("-").partition("#")[0]
        way, tags = roads.get(number, (None, {}))
        if way is None or edge.get("function", "normal") != "normal":
            continue
        lanes = sorted(edge.iter("lane"), key=lambda lane: int(lane.attrib["index"]))
        usual = [allowed_classes(lane) for lane in lanes]
        plans = lane_plans(number, tags, not name.startswith("-"), side, usual, counts)
        # netconvert spreads the lanes of a one-way road about its line, unless it is drawn against
        # its traffic (oneway=-1).
        alone = name.startswith("-") and name[1:] not in names
        where = {"spreadType": "center"} if alone else {}
        if [plan.allowed for plan in plans] == usual:
            if alone:
                Xml.SubElement(patch, "edge", where, id=name)
            continue
        outside = int(plans[0].width_m is not None)
        changed = Xml.SubElement(patch, "edge", where, id=name, numLanes=str(len(plans)))
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


Move = Callable[[NDArray[np.float64]], NDArray[np.float64]]
"""Takes points (N, 2) to where they are to be."""

_SHAPES = ("shape", "outlineShape")
NETWORK, OPENDRIVE, RECORD = "network.net.xml", "road.xodr", "map.json"
LANE_WIDTH_M = 3.5
"""For lanes whose width the map does not state: between the 3.66 m of US freeways (AASHTO, A Policy
on Geometric Design of Highways and Streets) and the 3.25 m of European city streets."""
_OSM_OPTIONS = (
    "--geometry.remove=true",
    "--roundabouts.guess=true",
    "--ramps.guess=true",
    "--junctions.join=true",
    "--no-turnarounds=true",
    "--keep-edges.by-vclass=passenger,bus",
    "--output.street-names=true",
    "--output.original-names=true",
    "--offset.disable-normalization=true",
    # The line of a way is the middle of its road (wiki, Key:placement), however its lanes part.
    "--default.spreadtype=roadCenter",
)
_RAW_OPTIONS = (
    "--keep-edges", "--offset", "--default", "--proj", "--lefthand", "--osm", "--output.original",
)  # fmt: skip
"""Options that decide which edges are made of a way."""


@dataclass(frozen=True, slots=True)
class BuiltMap:
    """What a build gave.

    Attributes:
        network: The network, its coordinates being the map frame at its datum.
        opendrive: Roads in the OpenDRIVE file.
        warnings: What netconvert warned of, one sentence each.
        said: What the user should know about the map, in sentences.
        report: What was repaired and left out.
    """

    network: RoadNetwork
    opendrive: int
    warnings: tuple[str, ...]
    said: tuple[str, ...]
    report: InputReport


def build_from_osm(
    area: Path,
    folder: Path,
    datum: Datum | None = None,
    lane_width_m: float = LANE_WIDTH_M,
    side: Side | None = None,
    strict: bool = False,
) -> BuiltMap:
    """Write network, OpenDRIVE and record of an OpenStreetMap extract into a folder.

    Args:
        area: The extract.
        folder: Where the files go.
        datum: Origin of the coordinates; default: the middle of the extract's roads.
        lane_width_m: For lanes whose width the map doesn't state.
        side: Where traffic drives; default: by the map's tags, or by its place.
        strict: Refuse an extract that has any fault.

    Raises:
        RoadNetworkError: No map, no road in it, netconvert refuses it, or SUMO is not installed.
        InputFileError: Most of its roads are bad, or any, when `strict`.
        ParameterError: The side of the road can't be known.
    """
    extract = read_extract(area, strict)
    chosen = choose_side(side, extract.evidence, extract.middle, str(area))
    datum = datum or extract.middle
    options = [
        *_OSM_OPTIONS,
        f"--default.lanewidth={lane_width_m:g}",
        f"--proj={datum.proj_string}",
        *(["--lefthand=true"] if chosen.side == "left" else []),
        *(["--osm.elevation=true"] if extract.has_heights else []),
    ]
    with TemporaryDirectory() as name:
        warnings = _convert(extract, Path(name), folder / NETWORK, options, lane_width_m, chosen)
    return _finish(folder, datum, area, options, warnings, chosen, extract.report)


def _convert(
    extract: OsmExtract,
    folder: Path,
    net: Path,
    options: list[str],
    lane_width_m: float,
    side: DrivingSide,
) -> tuple[str, ...]:
    """Make the network in two runs: edge by edge, and whole with the lanes' users; the warnings.

    netconvert numbers the edges of a way; what is changed in them must be known before it joins
    edges and makes connections.

    Raises:
        RoadNetworkError: netconvert refuses the extract.
    """
    place, counts = extract.report.place, WayCounts()
    source, raw, changes = (folder / n for n in ("area.osm.xml", "raw.net.xml", "patch.edg.xml"))
    given = {way: tags for way, tags in roads_of(extract.root)}
    for way, tags in given.items():
        set_tags(way, prepared(tags))
    extract.write(source)
    for way, tags in given.items():
        set_tags(way, tags)
    files = [f"--osm-files={source}"]
    once = [option for option in options if option.startswith(_RAW_OPTIONS)]
    netconvert([*files, f"--output-file={raw}", "--no-internal-links=true", *once], place)
    patch = edge_patch(extract, parse_xml(raw).getroot(), side.side, lane_width_m, counts)
    if patch is not None:
        Xml.ElementTree(patch).write(changes, encoding="utf-8", xml_declaration=True)
        files.append(f"--edge-files={changes}")
    warnings = netconvert([*files, f"--output-file={net}", *options], place)
    for ways, text in (
        (counts.unclear, "lists of lanes that don't fit the number of lanes are not used"),
        (counts.hours, "rules for certain hours (:conditional) are not read"),
        (counts.cycle_lanes, "a cycle lane between other lanes or against the traffic is left out"),
    ):
        found = list(dict.fromkeys(ways))
        extract.report.add(Treatment.NOTED, len(found), text, f"way {found[0]}" if found else "")
    return warnings


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
    known = DrivingSide(side, "as the network says", side_doubt(side, network.datum))
    report = InputReport(str(net), "lanes", len(network))
    return _finish(folder, network.datum, net, [], (), known, report)


def _finish(
    folder: Path,
    datum: Datum,
    source: Path,
    options: list[str],
    warnings: tuple[str, ...],
    side: DrivingSide,
    report: InputReport,
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
        "remarks": list(report.sentences()),
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
    said = (side.sentence, *filter(None, (_reserved_lanes(network),)))
    return BuiltMap(network, roads, warnings, said, report)


def _reserved_lanes(network: RoadNetwork) -> str:
    """How many lanes are not for all cars, as a sentence; empty for none."""
    outside = np.flatnonzero(~network.internal).tolist()
    counts = Counter(users for k in outside if (users := network.users(k)))
    lanes = [f"{count} for {users}" for users, count in sorted(counts.items())]
    return f"Lanes that are not for all cars: {'; '.join(lanes)}." if lanes else ""


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
