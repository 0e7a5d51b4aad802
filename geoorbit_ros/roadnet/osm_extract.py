"""Reads OpenStreetMap extracts of any origin: XML, gzip or bzip2 of it, Overpass's JSON.

What one element says wrongly is repaired or left out, counted and told (`core/input_report.py`). A
file is refused when it has no road, or when most of its roads are bad.
"""

from __future__ import annotations

import re
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from xml.etree import ElementTree as Xml

import numpy as np
from numpy.typing import NDArray

from geoorbit_ros.calibration.datum import Datum
from geoorbit_ros.core.errors import RoadNetworkError
from geoorbit_ros.core.input_report import InputReport, Treatment
from geoorbit_ros.roadnet.driving_side import SIDES, MapEvidence, Side
from geoorbit_ros.roadnet.osm_file import EXPECTED, parse_osm, roads_of, set_tags, tags_of

ELE_SHARE = 0.5
"""Heights are used where at least this share of the points of roads have one. Chosen: smaller makes
cliffs at the points without, larger drops heights that a few points lack."""
MOST_LANES = 16
"""A road with more is a slip of the pen: the widest of all (Katy Freeway, Houston) has 13 each way
with its side roads, and maps draw each carriageway by itself."""
MOST_KMH = 200.0
"""A higher limit is a slip of the pen: the highest anywhere is 160 km/h. Chosen: in miles per hour
it is 322, so that no limit is lost."""
GAP_DEG = 1.0
"""Roads with nothing between them over so many degrees (111 km) lie at two places. Chosen: larger
takes two towns for one place, smaller parts a map along a desert road."""
_COUNTS = ("lanes", "lanes:forward", "lanes:backward", "lanes:both_ways")
_LIMITS = ("maxspeed", "maxspeed:forward", "maxspeed:backward")
_UNITS = {"": 1.0, "km/h": 1.0, "kmh": 1.0, "kph": 1.0, "mph": 1.609, "knots": 1.852}
_LIMIT = re.compile(r"(?P<number>\d+\.?\d*)\s*(?P<unit>[a-z/]*)")
_ONEWAY = ("yes", "no", "true", "false", "1", "0", "-1", "reverse")
_CHECKED = (*_COUNTS, *_LIMITS, "width", "oneway", "driving_side")
NARROWEST_M, WIDEST_M = 2.0, 60.0
"""Widths of whole roads: a farm track, and a motorway drawn as one line with all its lanes."""
_NARROW = ("footway", "path", "cycleway", "steps", "pedestrian", "bridleway", "track", "corridor")
"""Ways that may be narrower; no car drives there, so that their width says nothing of lanes."""
_TURNED = ("reversible", "alternating")
_MINI: dict[str, Side] = {"clockwise": "left", "anticlockwise": "right"}
"""Direction of a mini roundabout (wiki, highway=mini_roundabout), and the side of its traffic."""
_ORDER = {"node": 1, "way": 2, "relation": 3}
"""netconvert wants nodes before the ways that use them."""


@dataclass(frozen=True, slots=True)
class OsmExtract:
    """A cleaned extract.

    Attributes:
        root: Its `osm` element: every way has at least two points, all of them nodes with a place.
        report: What was repaired and left out.
        middle: Of the points of its roads, to seven decimals of a degree.
        evidence: What it says about the side on which traffic drives.
        has_heights: Whether its points have heights.
    """

    root: Xml.Element
    report: InputReport
    middle: Datum
    evidence: MapEvidence
    has_heights: bool

    def write(self, path: Path) -> None:
        """Write it as OSM XML."""
        Xml.ElementTree(self.root).write(path, encoding="utf-8", xml_declaration=True)


def read_extract(path: Path, strict: bool = False) -> OsmExtract:
    """Read and clean an extract.

    Args:
        path: The file.
        strict: Refuse a file with any fault.

    Raises:
        RoadNetworkError: No file, no extract, no road in it.
        InputFileError: Most of its roads are bad, or any of them, when `strict`.
    """
    root = parse_osm(path)
    report = InputReport(str(path), "roads")
    for remark in root.iter("remark"):
        text = " ".join((remark.text or "").split())
        report.note(Treatment.DOUBTFUL, f"the server broke off, so roads may be missing: {text}")
    _drop_deleted(root, report)
    _add_drawn_points(root)
    _drop_bad_nodes(root, report)
    _drop_bad_ways(root, report)
    _number_new_ways(root, report)
    root[:] = sorted(root, key=lambda element: _ORDER.get(element.tag, 0))
    roads = list(roads_of(root))
    if not roads:
        why = report.remarks[0].sentence(report.total, report.things) if report.remarks else ""
        found = "no road (way with the tag highway)" + (f"; {why}" if why else "")
        raise RoadNetworkError(str(path), found, EXPECTED)
    _check_tags(roads, report)
    places = {
        node.attrib["id"]: (float(node.attrib["lat"]), float(node.attrib["lon"]))
        for node in root.iter("node")
    }
    lines = [np.array([places[nd.attrib["ref"]] for nd in way.iter("nd")]) for way, _ in roads]
    roads, lines = _at_one_place(root, roads, lines, report)
    report.check(strict, EXPECTED)
    middle = _middle(np.concatenate(lines))
    metres = [_length_m(line, middle) for line in lines]
    tagged = {
        side: sum(m for m, (_, t) in zip(metres, roads, strict=True) if _side(t) == side)
        for side in SIDES
    }
    turns = [_ring_side(line, tags) for line, (_, tags) in zip(lines, roads, strict=True)]
    turns += [_MINI.get(tags_of(node).get("direction", "")) for node in _mini_roundabouts(root)]
    rings = {side: turns.count(side) for side in SIDES}
    heights = _check_heights(root, roads, report)
    return OsmExtract(root, report, middle, MapEvidence(tagged, rings, sum(metres)), heights)


def _drop_deleted(root: Xml.Element, report: InputReport) -> None:
    """Leave out what an editor has deleted: JOSM keeps it in the file until it is uploaded."""
    gone = [e for e in root if e.get("action") == "delete" or e.get("visible") == "false"]
    for element in gone:
        root.remove(element)
    roads = sum(element.tag == "way" for element in gone)
    if gone:
        text = f"deleted in an editor and left out: {roads} ways, {len(gone) - roads} others"
        report.note(Treatment.NOTED, text)


def _add_drawn_points(root: Xml.Element) -> None:
    """Make nodes of the points that ways carry themselves (`out geom` of Overpass)."""
    known = {node.get("id") for node in root.iter("node")}
    new: dict[tuple[str, str], str] = {}
    for nd in [nd for way in root.findall("way") for nd in way.findall("nd")]:
        place = (nd.attrib.pop("lat", ""), nd.attrib.pop("lon", ""))
        if not all(place) or nd.get("ref") in known:
            continue
        ref = nd.get("ref") or new.get(place) or f"-{10**15 + len(new)}"
        nd.set("ref", ref)
        new.setdefault(place, ref)
        if ref not in known:
            known.add(ref)
            root.append(Xml.Element("node", id=ref, lat=place[0], lon=place[1]))


def _drop_bad_nodes(root: Xml.Element, report: InputReport) -> None:
    """Leave out nodes without a place on earth, whose ways lose a point, and repeated ones."""
    best: dict[str, Xml.Element] = {}
    twice = []
    for node in root.findall("node"):
        known = best.setdefault(node.get("id", ""), node)
        if known is node:
            continue
        older = node
        if _version(node) > _version(known):
            best[node.get("id", "")], older = node, known
        if any(node.get(name) != known.get(name) for name in ("lat", "lon")):
            twice.append(f"node {node.get('id')}")
        root.remove(older)
    if twice:
        text = f"{len(twice)} points are in the file at two places; the latest version is used"
        report.note(Treatment.NOTED, f"{text}, or else the first", twice[0])
    bad = []
    for node in root.findall("node"):
        try:
            good = abs(float(node.get("lat", "nan"))) <= 90.0
            good &= abs(float(node.get("lon", "nan"))) <= 180.0
        except ValueError:
            good = False
        if not good or not node.get("id"):
            bad.append(node)
            root.remove(node)
    if bad:
        first = f"node {bad[0].get('id')} at {bad[0].get('lat')}, {bad[0].get('lon')}"
        report.note(Treatment.NOTED, f"{len(bad)} points without a place left out", first)


def _drop_bad_ways(root: Xml.Element, report: InputReport) -> None:
    """Leave out ways twice in the file, and ways with fewer than two points that are known."""
    known = {node.get("id") for node in root.iter("node")}
    best: dict[str, Xml.Element] = {}
    twice: list[str] = []
    for way in root.findall("way"):
        number = way.get("id", "")
        if number in best:
            twice.append(number)
        if number not in best or _version(way) > _version(best[number]):
            best[number] = way
    cut: list[str] = []
    short: list[str] = []
    lone: list[str] = []
    for way in root.findall("way"):
        points = way.findall("nd")
        lost = [nd for nd in points if nd.get("ref") not in known]
        for nd in lost:
            way.remove(nd)
        road = any(tag.get("k") == "highway" for tag in way.iter("tag"))
        report.total += road
        number = way.get("id", "")
        if best[number] is not way:
            root.remove(way)
        elif len({nd.get("ref") for nd in points} & known) < 2:
            root.remove(way)
            (lone if way.find("center") is not None and not points else short).extend(
                [number] * road
            )
        elif lost and road:
            cut.append(number)
    left_out = Treatment.LEFT_OUT
    report.add(left_out, len(twice), "the way is twice in the file", _first(twice))
    text = "only its middle is in the file (out center of Overpass; out geom has the points)"
    report.add(left_out, len(lone), text, _first(lone))
    text = "fewer than two of its points are in the file (Overpass: (._;>;); out;)"
    report.add(left_out, len(short), text, _first(short))
    text = "ends at the last point that is in the file"
    report.add(Treatment.REPAIRED, len(cut), text, _first(cut))


def _number_new_ways(root: Xml.Element, report: InputReport) -> None:
    """Give new ways of an editor, which have negative numbers, numbers that no other way has.

    In a network -5 is the way back along road 5.
    """
    ways = {way.get("id", ""): way for way in root.iter("way")}
    new = [number for number in ways if not number.isascii() or not number.isdigit()]
    free = max((int(number) for number in ways if number not in new), default=0) + 1
    names = {number: str(free + k) for k, number in enumerate(new)}
    for number, name in names.items():
        ways[number].set("id", name)
    for member in root.iter("member"):
        if member.get("type") == "way" and member.get("ref") in names:
            member.set("ref", names[member.attrib["ref"]])
    roads = [n for n in new if any(t.get("k") == "highway" for t in ways[n].iter("tag"))]
    text = "new in an editor, with a negative number; it gets a number of its own"
    example = f"way {roads[0]} is {names[roads[0]]}" if roads else ""
    report.add(Treatment.NOTED, len(roads), text, example)


def _check_tags(roads: list[tuple[Xml.Element, dict[str, str]]], report: InputReport) -> None:
    """Leave out values that no road has; of several values the first is used."""
    wrong: dict[str, list[str]] = {}
    for way, tags in roads:
        before = dict(tags)
        narrow = tags["highway"] in _NARROW
        for key in [k for k in _CHECKED if k in tags and not (narrow and k == "width")]:
            value, *others = (part.strip() for part in tags.pop(key).split(";"))
            told = ["several values, of which the first is used"] if others else []
            found, fault = _right_value(key, value)
            if found is not None:
                tags[key] = found
            for text in [*told, *([fault] if fault else [])]:
                wrong.setdefault(text, []).append(f"way {way.get('id')}: {key}={before[key]}"[:80])
        if example := _agree_on_lanes(tags):
            text = "numbers of lanes that contradict each other; those of each direction are used"
            wrong.setdefault(text, []).append(f"way {way.get('id')}: {example}")
        if tags != before:
            set_tags(way, tags)
    for text, places in wrong.items():
        report.add(Treatment.NOTED, len(places), text, places[0])


def _agree_on_lanes(tags: dict[str, str]) -> str:
    """Make `lanes` the sum of those of both directions; what contradicts it, empty for nothing."""
    one_way = tags.get("oneway") in ("yes", "true", "1", "-1", "reverse")
    ways = ["lanes:forward"] if one_way else ["lanes:forward", "lanes:backward"]
    if "lanes" not in tags or not all(key in tags for key in ways):
        return ""
    total = sum(int(tags.get(key, "0")) for key in [*ways, "lanes:both_ways"])
    if total == int(tags["lanes"]) or not total:
        return ""
    example = ", ".join(f"{key}={tags[key]}" for key in ["lanes", *ways])
    tags["lanes"] = str(total)
    return example


def _right_value(key: str, value: str) -> tuple[str | None, str]:
    """A tag's value as it is to be used, None for not at all, and what is wrong with it."""
    fault = ""
    if key in _COUNTS:
        count = _number(value)
        least = 0.0 if ":" in key else 0.5  # lanes:both_ways=0 says something, lanes=0 does not
        if count is not None and least <= count <= MOST_LANES:
            return str(max(int(count), int(count > 0.0))), ""  # 1.5: cars meet with care
        fault = "numbers of lanes that no road has are not used"
    elif key in _LIMITS:
        limit = _LIMIT.fullmatch(value.lower())
        unit = _UNITS.get(limit["unit"]) if limit else None
        words = re.match(r"[a-z]", value.lower())  # none, walk, signals, DE:urban
        if not words and not (limit and unit and 0.0 < float(limit["number"]) * unit <= MOST_KMH):
            fault = "speed limits that no road has are not used"
    elif key == "width":
        width = _number(value.lower().removesuffix("m").strip())
        if width is not None and not NARROWEST_M <= width <= WIDEST_M:
            fault = "widths that no road has are not used"
    elif key == "oneway":
        if value in _TURNED:
            return "yes", "direction changes with the hour; built in the direction of its line"
        if value.lower() not in _ONEWAY:
            fault = "neither yes, no nor -1, so not used"
    elif value.lower() not in SIDES:  # driving_side
        fault = "neither left nor right, so not used"
    return (None if fault else value), fault


def _number(text: str) -> float | None:
    try:
        return float(text)
    except ValueError:
        return None


def _at_one_place(
    root: Xml.Element,
    roads: list[tuple[Xml.Element, dict[str, str]]],
    lines: list[NDArray[np.float64]],
    report: InputReport,
) -> tuple[list[tuple[Xml.Element, dict[str, str]]], list[NDArray[np.float64]]]:
    """The roads of the place with most of them; a plane that touches two of them fits neither."""
    begin = np.array([line[0] for line in lines])
    kept = np.arange(len(lines))
    for axis in (0, 1, 0):
        order = kept[np.argsort(begin[kept, axis])]
        width = np.cos(np.radians(begin[order[:-1], 0])) if axis else 1.0
        apart = np.flatnonzero(np.diff(begin[order, axis]) * width > GAP_DEG) + 1
        kept = np.sort(max(np.split(order, apart), key=lambda part: (len(part), -part.min())))
    if len(kept) == len(lines):
        return roads, lines
    others = np.setdiff1d(np.arange(len(lines)), kept)
    far = [roads[k][0] for k in others]
    for way in far:
        root.remove(way)
    text = "far from the other roads: a map is of one place"
    place = ", ".join(f"{value:.3f}" for value in begin[others[0]])
    report.add(Treatment.LEFT_OUT, len(far), text, f"way {far[0].get('id')} at {place}")
    return [roads[k] for k in kept], [lines[k] for k in kept]


def _check_heights(
    root: Xml.Element, roads: list[tuple[Xml.Element, dict[str, str]]], report: InputReport
) -> bool:
    """Whether most points of roads have a height in metres; the others get one between them."""
    nodes = {node.attrib["id"]: node for node in root.iter("node")}
    height: dict[str, float] = {}
    bad = []
    for name, node in nodes.items():
        for tag in [t for t in node.findall("tag") if t.get("k") == "ele"]:
            try:
                height[name] = float(tag.get("v", "").removesuffix("m"))
                tag.set("v", f"{height[name]:g}")
            except ValueError:
                node.remove(tag)
                bad.append(f"node {name}: {tag.get('v')}")
    if bad:
        report.note(Treatment.NOTED, f"{len(bad)} heights that are no numbers left out", bad[0])
    lines = [[nd.attrib["ref"] for nd in way.iter("nd")] for way, _ in roads]
    used = {ref for line in lines for ref in line}
    given = used & height.keys()
    if len(given) < ELE_SHARE * len(used):
        if given:
            few = f"{len(given)} of {len(used)} points of roads have a height (ele)"
            report.note(Treatment.NOTED, f"{few}: too few, not used")
        return False
    if lacking := used - given:
        usual = float(np.median([height[ref] for ref in given]))
        for line in lines:
            there = [k for k, ref in enumerate(line) if ref in given]
            for k in [k for k, ref in enumerate(line) if ref in lacking]:
                between = [height[line[j]] for j in there]
                metres = float(np.interp(k, there, between)) if there else usual
                Xml.SubElement(nodes[line[k]], "tag", k="ele", v=f"{metres:g}")
                lacking.discard(line[k])
        text = f"{len(used) - len(given)} of {len(used)} points of roads have no height (ele)"
        report.note(Treatment.NOTED, f"{text}: they get one between their neighbours'")
    return True


def _side(tags: dict[str, str]) -> str:
    return tags.get("driving_side", "").strip().lower()


def _ring_side(lat_lon: NDArray[np.float64], tags: dict[str, str]) -> Side | None:
    """The side on which one drives round a closed roundabout as it is drawn."""
    closed = len(lat_lon) > 3 and bool((lat_lon[0] == lat_lon[-1]).all())
    if not closed or tags.get("junction") not in ("roundabout", "circular"):
        return None
    (y, x), (dy, dx) = (lat_lon[:-1] - lat_lon[0]).T, np.diff(lat_lon, axis=0).T
    turns_left = float((x * dy - y * dx).sum()) > 0.0
    return "right" if turns_left != (tags.get("oneway") == "-1") else "left"


def _mini_roundabouts(root: Xml.Element) -> Iterator[Xml.Element]:
    for node in root.iter("node"):
        if any(t.get("k") == "highway" and t.get("v") == "mini_roundabout" for t in node):
            yield node


def _version(way: Xml.Element) -> int:
    text = way.get("version", "0")
    return int(text) if text.isascii() and text.isdigit() else 0


def _first(numbers: list[str]) -> str:
    return f"way {numbers[0]}" if numbers else ""


def _middle(lat_lon: NDArray[np.float64]) -> Datum:
    latitude, longitude = 0.5 * (lat_lon.min(axis=0) + lat_lon.max(axis=0))
    return Datum(round(float(latitude), 7), round(float(longitude), 7))


def _length_m(lat_lon: NDArray[np.float64], middle: Datum) -> float:
    return float(np.hypot(*np.diff(middle.to_local(*lat_lon.T), axis=0).T).sum())
