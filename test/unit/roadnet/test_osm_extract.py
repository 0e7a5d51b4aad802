"""Extracts of any origin: used, repaired and told, or refused in one sentence."""

import bz2
import gzip
import json
import lzma
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from made_maps import BAVARIA, MadeExtract, road

from geoorbit_ros.cli.main import main
from geoorbit_ros.core.errors import GeoOrbitError
from geoorbit_ros.roadnet.map_build import BuiltMap, build_from_osm
from geoorbit_ros.roadnet.network_file import parse_xml
from geoorbit_ros.roadnet.osm_extract import OsmExtract, read_extract

TEXT = road(BAVARIA, {"lanes": "4"}).text()
NODE_1, NODE_2 = TEXT.index('<node id="1"'), TEXT.index('<node id="2"')
WAY = TEXT.index("<way")
HIGHWAY = '<tag k="highway" v="primary"/>'
CENTRE = f'<way id="11"><center lat="48.2" lon="11.5"/>{HIGHWAY}</way>'


def overpass(**more: Any) -> dict[str, Any]:
    """The same road as JSON of Overpass."""
    places = BAVARIA.to_geodetic([(0.0, -150.0), (0.0, 150.0)])
    nodes = [
        {"type": "node", "id": k, "lat": lat, "lon": lon} for k, (lat, lon) in enumerate(places, 1)
    ]
    tags = {"highway": "primary", "lanes": "4"}
    way = {"type": "way", "id": 10, "nodes": [1, 2], "tags": tags}
    return {"version": 0.6, "generator": "Overpass API", "elements": [*nodes, way], **more}


def with_geometry(refs: bool) -> dict[str, Any]:
    data = overpass()
    way = data["elements"][-1]
    way["geometry"] = [{"lat": n["lat"], "lon": n["lon"]} for n in data["elements"][:2]]
    if not refs:
        del way["nodes"]
    return data | {"elements": [way]}


def points_in_way(keep_ref: bool) -> str:
    """`out geom` of Overpass: no nodes, the points stand in the way."""
    text = TEXT[:NODE_1] + TEXT[WAY:]
    for number, (lat, lon) in enumerate(BAVARIA.to_geodetic([(0.0, -150.0), (0.0, 150.0)]), 1):
        ref = f'ref="{number}" ' if keep_ref else ""
        text = text.replace(f'<nd ref="{number}"/>', f'<nd {ref}lat="{lat:.8f}" lon="{lon:.8f}"/>')
    return text


def put_before_way(text: str) -> str:
    return TEXT[:WAY] + text + TEXT[WAY:]


FORWARD, BACKWARD = '<tag k="lanes:forward" v="{}"/>', '<tag k="lanes:backward" v="{}"/>'

GOOD: dict[str, tuple[bytes | str, tuple[str, ...]]] = {
    "plain": (TEXT, ()),
    "gzip": (gzip.compress(TEXT.encode()), ()),
    "bzip2": (bz2.compress(TEXT.encode()), ()),
    "xz": (lzma.compress(TEXT.encode()), ()),
    "byte order mark": (b"\xef\xbb\xbf" + TEXT.encode(), ()),
    "UTF-16": (TEXT.replace("UTF-8", "UTF-16").encode("utf-16"), ()),
    "JSON of Overpass": (json.dumps(overpass()), ()),
    "JSON with geometry": (json.dumps(with_geometry(refs=True)), ()),
    "JSON with geometry alone": (json.dumps(with_geometry(refs=False)), ()),
    "out geom": (points_in_way(keep_ref=True), ()),
    "out geom without numbers": (points_in_way(keep_ref=False), ()),
    "ways before nodes": (
        TEXT[:NODE_1] + TEXT[WAY:].removesuffix("</osm>") + TEXT[NODE_1:WAY] + "</osm>",
        (),
    ),
    "notes of a server": (
        TEXT.replace("<node", "<note>data is ODbL</note><meta osm_base='x'/><node", 1),
        (),
    ),
    "a point at two places": (
        put_before_way('<node id="1" lat="12.0" lon="77.0"/>'),
        ("1 points are in the file at two places", "node 1"),
    ),
    "a road far away": (
        put_before_way(
            '<node id="8" lat="12.0" lon="77.0"/><node id="9" lat="12.1" lon="77.0"/>'
        ).replace("</osm>", f'<way id="11"><nd ref="8"/><nd ref="9"/>{HIGHWAY}</way></osm>'),
        ("1 of 2 roads left out: far from the other roads", "way 11 at 12.000, 77.000"),
    ),
    "a thousand lanes": (
        TEXT.replace('v="4"', 'v="1000"'),
        ("numbers of lanes that no road has are not used (first: way 10: lanes=1000)",),
    ),
    "two numbers of lanes": (
        TEXT.replace('v="4"', 'v="4;3"'),
        ("several values, of which the first is used (first: way 10: lanes=4;3)",),
    ),
    "a limit of 9999": (
        TEXT.replace(HIGHWAY, HIGHWAY + '<tag k="maxspeed" v="9999"/>'),
        ("speed limits that no road has are not used (first: way 10: maxspeed=9999)",),
    ),
    "a limit in miles": (TEXT.replace(HIGHWAY, HIGHWAY + '<tag k="maxspeed" v="85 mph"/>'), ()),
    "a limit below 0": (
        TEXT.replace(HIGHWAY, HIGHWAY + '<tag k="maxspeed" v="-10"/>'),
        ("speed limits that no road has are not used",),
    ),
    "a limit of 1e3": (
        TEXT.replace(HIGHWAY, HIGHWAY + '<tag k="maxspeed" v="1e3"/>'),
        ("speed limits that no road has are not used",),
    ),
    "no lanes": (
        TEXT.replace('v="4"', 'v="0"'),
        ("numbers of lanes that no road has are not used (first: way 10: lanes=0)",),
    ),
    "lanes that contradict those of both directions": (
        TEXT.replace(HIGHWAY, HIGHWAY + FORWARD.format(3) + BACKWARD.format(2)),
        (
            "numbers of lanes that contradict each other; those of each direction are used "
            "(first: way 10: lanes=4, lanes:forward=3, lanes:backward=2)",
        ),
    ),
    "lanes of both directions": (
        TEXT.replace(HIGHWAY, HIGHWAY + FORWARD.format(3) + BACKWARD.format(1)),
        (),
    ),
    "lanes that contradict those of a one-way road": (
        TEXT.replace(HIGHWAY, HIGHWAY + FORWARD.format(2) + '<tag k="oneway" v="yes"/>'),
        ("numbers of lanes that contradict each other",),
    ),
    "a width of half a metre": (
        TEXT.replace(HIGHWAY, HIGHWAY + '<tag k="width" v="0.5"/>'),
        ("widths that no road has are not used (first: way 10: width=0.5)",),
    ),
    "a narrow path beside the road": (
        TEXT.replace('v="primary"/>', 'v="footway"/><tag k="width" v="0.8"/>', 1),
        (),
    ),
    "an odd oneway": (
        TEXT.replace(HIGHWAY, HIGHWAY + '<tag k="oneway" v="maybe"/>'),
        ("neither yes, no nor -1, so not used",),
    ),
    "no limit": (TEXT.replace(HIGHWAY, HIGHWAY + '<tag k="maxspeed" v="none"/>'), ()),
    "a lane and a half": (TEXT.replace('v="4"', 'v="1.5"'), ()),
    "a road of both directions by turns": (
        TEXT.replace(HIGHWAY, HIGHWAY + '<tag k="oneway" v="reversible"/>'),
        ("direction changes with the hour",),
    ),
    "a driving side of no meaning": (
        TEXT.replace(HIGHWAY, HIGHWAY + '<tag k="driving_side" v="links"/>'),
        ("neither left nor right, so not used (first: way 10: driving_side=links)",),
    ),
    "a remark": (
        TEXT.replace("</osm>", "<remark>runtime error: Query timed out in 'query'</remark></osm>"),
        ("roads may be missing: runtime error: Query timed out",),
    ),
    "a remark in JSON": (
        json.dumps(overpass(remark="runtime error: out of memory")),
        ("roads may be missing: runtime error: out of memory",),
    ),
    "a deleted way": (
        TEXT.replace(
            "</osm>",
            '<way id="11" action="delete"><nd ref="1"/><nd ref="2"/><tag k="highway" v="primary"/>'
            "</way></osm>",
        ),
        ("deleted in an editor and left out: 1 ways, 0 others",),
    ),
    "an invisible way": (
        TEXT.replace(
            "</osm>",
            '<way id="11" visible="false"><nd ref="1"/><nd ref="2"/><tag k="highway" v="primary"/>'
            "</way></osm>",
        ),
        ("deleted in an editor and left out: 1 ways, 0 others",),
    ),
    "a deleted node": (
        put_before_way('<node id="9" lat="48.3" lon="11.5" action="delete"/>'),
        ("0 ways, 1 others",),
    ),
    "a new way": (
        TEXT.replace('<way id="10"', '<way id="-5"'),
        ("1 of 1 roads noted", "negative number", "way -5 is 1"),
    ),
    "a node without place": (
        put_before_way('<node id="3"/>').replace(
            '<nd ref="1"/><nd ref="2"/>', '<nd ref="1"/><nd ref="3"/><nd ref="2"/>'
        ),
        ("1 points without a place left out (first: node 3", "1 of 1 roads repaired"),
    ),
    "a node that is no number": (
        put_before_way('<node id="3" lat="north" lon="11.5"/>'),
        ("1 points without a place left out (first: node 3 at north, 11.5)",),
    ),
    "a node off the earth": (
        put_before_way('<node id="3" lat="148.2" lon="11.5"/>'),
        ("1 points without a place left out (first: node 3 at 148.2, 11.5)",),
    ),
    "a point that is not there": (
        TEXT.replace('<nd ref="2"/>', '<nd ref="2"/><nd ref="77"/>'),
        ("1 of 1 roads repaired: ends at the last point that is in the file (first: way 10)",),
    ),
    "a way twice": (
        TEXT.replace("</osm>", TEXT[WAY:].replace('version="1"', 'version="2"')),
        ("1 of 2 roads left out: the way is twice in the file (first: way 10)",),
    ),
    "a way without points": (
        TEXT.replace("</osm>", '<way id="11"><tag k="highway" v="primary"/></way></osm>'),
        ("1 of 2 roads left out: fewer than two of its points are in the file",),
    ),
    "a way of which only the middle is there": (
        TEXT.replace(
            "</osm>",
            f"{CENTRE}</osm>",
        ),
        ("1 of 2 roads left out: only its middle is in the file (out center",),
    ),
    "a height that is no number": (
        put_before_way('<node id="3" lat="48.2" lon="11.6"><tag k="ele" v="high"/></node>'),
        ("1 heights that are no numbers left out (first: node 3: high)",),
    ),
    "a height of a summit": (
        TEXT.replace('<node id="1" ', '<node id="1" x="" ').replace(
            "</node>", "</node><node id='3' lat='48.2' lon='11.6'><tag k='ele' v='520'/></node>", 1
        ),
        (),
    ),
}


def write(path: Path, content: bytes | str) -> Path:
    path.write_bytes(content.encode() if isinstance(content, str) else content)
    return path


@pytest.mark.parametrize("kind", GOOD)
def test_what_can_be_used_is_used_and_told(tmp_path: Path, kind: str) -> None:
    content, told = GOOD[kind]
    found = read_extract(write(tmp_path / "area.osm", content))
    assert (found.middle.latitude_deg, found.middle.longitude_deg) == pytest.approx(
        (48.2, 11.5), abs=1e-6
    )
    assert found.evidence.roads_m == pytest.approx(300.0, abs=0.1)
    assert sum(1 for _ in found.root.iter("way")) == 1
    said = " | ".join(found.report.sentences())
    for text in told:
        assert text in said
    assert bool(said) == bool(told)


BAD: dict[str, tuple[bytes | str, tuple[str, ...]]] = {
    "nothing": ("", ("an empty file",)),
    "blanks": (" \n\n", ("an empty file",)),
    "cut off": (TEXT[:200], ("broken XML",)),
    "cut gzip": (gzip.compress(TEXT.encode())[:80], ("broken gzip",)),
    "cut bzip2": (bz2.compress(TEXT.encode())[:80], ("broken bzip2",)),
    "binary": (
        b"\x00\x00\x00\x0d\n\x09OSMHeader\x18\x7c\x10\x71",
        (".osm.pbf", "osmium cat area.osm.pbf -o area.osm"),
    ),
    "o5m": (b"\xff\xe0\x04o5m2\xff", ("o5m", "osmconvert")),
    "zip": (b"PK\x03\x04\x14\x00", ("a zip archive", "unzip it first")),
    "GeoJSON": ('{"type": "FeatureCollection", "features": []}', ("GeoJSON",)),
    "other JSON": ('{"roads": []}', ("JSON that is no answer of Overpass",)),
    "broken JSON": ('{"elements": [', ("broken JSON",)),
    "a web page": (
        "<!DOCTYPE html><html><p>504 Gateway<br>Timeout</html>",
        ("a web page, maybe a server's error message",),
    ),
    "a good web page": ("<html><body/></html>", ("a web page",)),
    "a network": ("<net/>", ("a SUMO network", "--net")),
    "OpenDRIVE": ("<OpenDRIVE/>", ("an OpenDRIVE road", "netconvert")),
    "changes": ('<osmChange version="0.6"/>', ("changes of a map",)),
    "a GPX track": ("<gpx/>", ("a GPX track",)),
    "a namespace": ('<kml xmlns="http://www.opengis.net/kml/2.2"/>', ("a KML file",)),
    "text": ("id,highway\n10,primary\n", ("broken XML",)),
    "an empty extract": ('<osm version="0.6"/>', ("no road (way with the tag highway)",)),
    "an empty answer": (json.dumps(overpass(elements=[])), ("no road",)),
    "an answer that broke off": (
        '<osm><remark>runtime error: Query timed out in "query" at line 3</remark></osm>',
        ("no road", "Query timed out"),
    ),
    "only deleted roads": (
        TEXT.replace("<way ", '<way action="delete" '),
        ("no road", "deleted in an editor"),
    ),
    "only buildings": (TEXT.replace("highway", "building"), ("no road",)),
    "out center": (
        f"<osm>{CENTRE}</osm>",
        ("no road", "only its middle is in the file (out center of Overpass"),
    ),
    "ways without their nodes": (
        TEXT[:NODE_1] + TEXT[WAY:],
        ("no road", "fewer than two of its points are in the file"),
    ),
    "most of it bad": (
        TEXT.replace(
            "</osm>",
            "".join(
                f'<way id="{k}"><nd ref="{k}1"/><nd ref="{k}2"/>{HIGHWAY}</way>'
                for k in range(20, 25)
            )
            + "</osm>",
        ),
        ("5 of 6 roads left out",),
    ),
}


@pytest.mark.parametrize("kind", BAD)
def test_what_can_t_be_used_is_one_sentence(tmp_path: Path, kind: str) -> None:
    content, words = BAD[kind]
    path = write(tmp_path / "area.osm", content)
    with pytest.raises(GeoOrbitError) as caught:
        read_extract(path)
    message = str(caught.value)
    assert "\n" not in message
    assert "area.osm" in message
    for word in words:
        assert word in message


def test_no_file_is_one_sentence(tmp_path: Path) -> None:
    with pytest.raises(GeoOrbitError, match="no such file"):
        read_extract(tmp_path / "none.osm")


@pytest.mark.parametrize("kind", ["a point that is not there", "a way twice", "a remark"])
def test_strict_refuses_what_is_repaired(tmp_path: Path, kind: str) -> None:
    path = write(tmp_path / "area.osm", GOOD[kind][0])
    with pytest.raises(GeoOrbitError, match="not accepted with --strict"):
        read_extract(path, strict=True)


def build(folder: Path, extract: MadeExtract) -> BuiltMap:
    (folder / "map").mkdir()
    return build_from_osm(extract.write(folder / "a.osm"), folder / "map", extract.datum)


def heights(found: OsmExtract) -> list[float]:
    nodes = {node.get("id"): node for node in found.root.iter("node")}
    refs = [nd.get("ref") for nd in next(found.root.iter("way")).iter("nd")]
    return [float(nodes[ref].findall("tag")[-1].attrib["v"]) for ref in refs]


def hill(given: dict[float, str]) -> MadeExtract:
    extract = MadeExtract(BAVARIA)
    for y, ele in given.items():
        extract.node((0.0, y), ele=ele)
    line = [(0.0, y) for y in (-150.0, -50.0, 50.0, 150.0)]
    extract.way(10, line, {"highway": "primary", "lanes": "2"})
    return extract


def test_heights_are_kept(tmp_path: Path) -> None:
    built = build(tmp_path, hill({-150.0: "500", -50.0: "502 m", 50.0: "508", 150.0: "514"}))
    lanes = parse_xml(built.network.path).getroot().iter("lane")
    lane = next(lane for lane in lanes if lane.get("id") == "10_0")
    z = [float(point.split(",")[2]) for point in lane.attrib["shape"].split()]
    assert (z[0], z[-1]) == pytest.approx((500.0, 514.0), abs=0.1)
    assert np.diff(z).min() >= 0.0
    assert built.network.length_m[built.network.number["10_0"]] == pytest.approx(300.0, abs=0.2)
    profile = parse_xml(tmp_path / "map" / "road.xodr").getroot().iter("elevation")
    assert max(float(e.attrib["a"]) for e in profile) > 500.0


def test_a_height_that_is_missing_lies_between_its_neighbours(tmp_path: Path) -> None:
    extract = hill({-150.0: "500", -50.0: "502", 150.0: "510"})
    found = read_extract(extract.write(tmp_path / "a.osm"))
    assert found.has_heights
    assert heights(found) == [500.0, 502.0, 506.0, 510.0]
    assert "1 of 4 points of roads have no height" in " ".join(found.report.sentences())


def test_a_few_heights_are_not_used(tmp_path: Path) -> None:
    found = read_extract(hill({50.0: "508"}).write(tmp_path / "a.osm"))
    assert not found.has_heights
    assert "1 of 4 points of roads have a height" in " ".join(found.report.sentences())


ORIGINS: dict[str, Callable[[], bytes | str]] = {
    "new ways": lambda: TEXT.replace('<way id="10"', '<way id="-10"'),
    "JSON": lambda: json.dumps(with_geometry(refs=False)),
    "bzip2": lambda: bz2.compress(TEXT.encode()),
    "ways first": lambda: GOOD["ways before nodes"][0],
}


@pytest.mark.parametrize("kind", ORIGINS)
def test_the_command_takes_them_and_tells(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], kind: str
) -> None:
    area = write(tmp_path / "area.any", ORIGINS[kind]())
    assert main(["map", "build", str(area), "--out", str(tmp_path / "out")]) == 0
    said = " ".join(capsys.readouterr().out.split())
    assert "3.50 4 1.20" in said  # four lanes of 300 m
    assert ("negative number" in said) == (kind == "new ways")
    record = json.loads((tmp_path / "out" / "map.json").read_text())
    assert bool(record["remarks"]) == (kind == "new ways")
    assert sorted(p.name for p in (tmp_path / "out").iterdir()) == [
        "map.json",
        "map.png",
        "network.net.xml",
        "road.xodr",
    ]


def test_a_new_way_and_the_way_back_along_another_are_two_roads(tmp_path: Path) -> None:
    """-5 would be both."""
    extract = road(BAVARIA, {"lanes": "2"})
    extract.way(-10, [(30.0, -150.0), (30.0, 150.0)], {"highway": "primary", "lanes": "2"})
    network = build(tmp_path, extract).network
    outside = np.flatnonzero(~network.internal).tolist()
    xs = sorted(round(float(network.line(k)[0, 0]), 2) for k in outside)
    assert xs == [-1.75, 1.75, 28.25, 31.75]
