"""The elements of an OpenStreetMap file: XML, packed or not, or JSON of Overpass.

What is no such file is named in one sentence, with what to do.
"""

from __future__ import annotations

import json
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any
from xml.etree import ElementTree as Xml

from geoorbit_ros.core.errors import RoadNetworkError
from geoorbit_ros.roadnet.network_file import read_unpacked

EXPECTED = "an OpenStreetMap extract (.osm, .osm.gz, .osm.bz2, or JSON of Overpass)"
_OTHERS: tuple[tuple[bytes, str, str], ...] = (
    (
        b"OSMHeader",
        "an extract in the binary format .osm.pbf",
        "OSM XML: osmium cat area.osm.pbf -o area.osm (or osmconvert, or JOSM)",
    ),
    (b"PK\x03\x04", "a zip archive", "the extract in it: unzip it first"),
    (b"\xff\xe0\x04o5m2", "an extract in o5m", "OSM XML: osmconvert area.o5m -o=area.osm"),
    (b"SQLite format 3", "an SQLite database", EXPECTED),
)
_ROOTS = {
    "net": ("a SUMO network", "an extract; a network is given with --net"),
    "OpenDRIVE": ("an OpenDRIVE road", f"{EXPECTED}; netconvert --opendrive makes a network of it"),
    "osmChange": ("changes of a map (osmChange)", EXPECTED),
    "gpx": ("a GPX track", EXPECTED),
    "kml": ("a KML file", EXPECTED),
    "html": ("a web page, maybe a server's error message", EXPECTED),
}


def tags_of(element: Xml.Element) -> dict[str, str]:
    """The tags of a node, way or relation."""
    return {tag.get("k", ""): tag.get("v", "") for tag in element.iter("tag")}


def set_tags(element: Xml.Element, tags: Mapping[str, str]) -> None:
    """Replace the tags of a node, way or relation."""
    for tag in element.findall("tag"):
        element.remove(tag)
    for key, value in tags.items():
        Xml.SubElement(element, "tag", k=key, v=value)


def roads_of(root: Xml.Element) -> Iterator[tuple[Xml.Element, dict[str, str]]]:
    """The ways with the tag highway, with their tags."""
    for way in root.iter("way"):
        tags = tags_of(way)
        if "highway" in tags:
            yield way, tags


def parse_osm(path: Path) -> Xml.Element:
    """The tree of a file, whatever it is packed in.

    Raises:
        RoadNetworkError: No file, or none of an extract.
    """
    place, data = str(path), read_unpacked(path, EXPECTED)
    text = data.lstrip(b"\xef\xbb\xbf \t\r\n")
    for begin, found, expected in _OTHERS:
        if begin in data[: 32 + len(begin)]:
            raise RoadNetworkError(place, found, expected)
    if not text:
        raise RoadNetworkError(place, "an empty file", EXPECTED)
    if text[:1] in (b"{", b"["):
        return _tree_of_json(text, place)
    try:
        root = Xml.fromstring(data)
    except Xml.ParseError as error:
        page = text[:200].lower().startswith((b"<!doctype html", b"<html"))
        found, expected = _ROOTS["html"] if page else (f"broken XML ({error})", EXPECTED)
        raise RoadNetworkError(place, found, expected) from error
    tag = root.tag.rpartition("}")[2]
    if tag != "osm":
        found, expected = _ROOTS.get(tag, (f"a file of <{tag}>", EXPECTED))
        raise RoadNetworkError(place, found, expected)
    return root


def _tree_of_json(text: bytes, place: str) -> Xml.Element:
    """The XML of Overpass's JSON.

    Raises:
        RoadNetworkError: No JSON, or JSON of something else.
    """
    try:
        data: Any = json.loads(text)
    except (ValueError, RecursionError, MemoryError) as error:
        raise RoadNetworkError(place, f"broken JSON ({error})", EXPECTED) from error
    kind = data.get("type") if isinstance(data, dict) else None
    if kind in ("FeatureCollection", "Feature", "GeometryCollection"):
        found = f"GeoJSON (a {kind}), which has no road network"
        raise RoadNetworkError(place, found, EXPECTED)
    elements = data.get("elements") if isinstance(data, dict) else None
    if not isinstance(elements, list):
        raise RoadNetworkError(place, "JSON that is no answer of Overpass", EXPECTED)
    root = Xml.Element("osm", version="0.6")
    if data.get("remark"):
        Xml.SubElement(root, "remark").text = str(data["remark"])
    for given in elements:
        if not isinstance(given, dict) or given.get("type") not in ("node", "way", "relation"):
            continue
        names = {k: str(given[k]) for k in ("id", "lat", "lon", "version") if k in given}
        element = Xml.SubElement(root, given["type"], names)
        drawn = given.get("geometry") or []
        refs = given.get("nodes") or [None] * len(drawn)
        for k, ref in enumerate(refs):
            point = drawn[k] if k < len(drawn) and isinstance(drawn[k], dict) else {}
            nd = {} if ref is None else {"ref": str(ref)}
            Xml.SubElement(
                element, "nd", nd | {a: str(point[a]) for a in ("lat", "lon") if a in point}
            )
        if isinstance(given.get("center"), dict):
            Xml.SubElement(element, "center")
        for member in given.get("members") or []:
            parts = {k: str(member[k]) for k in ("type", "ref", "role") if k in member}
            Xml.SubElement(element, "member", parts)
        for key, value in (given.get("tags") or {}).items():
            Xml.SubElement(element, "tag", k=str(key), v=str(value))
    return root
