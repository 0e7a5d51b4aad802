"""Lane files: written and read back nothing moves; anything wrong is one sentence."""

from __future__ import annotations

import copy
import json
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from pyproj import Transformer

from geoorbit_ros.calibration.datum import Datum
from geoorbit_ros.core.errors import InputFileError
from geoorbit_ros.core.lanes import CrossSection, Lane, LaneEdge, LaneMap
from geoorbit_ros.core.polylines import offset_line
from geoorbit_ros.lanes.geojson import (
    dumps_lanes,
    lanes_to_geojson,
    read_lane_file,
    read_lanes,
    write_lanes,
)

DATUM = Datum(43.0439, -89.3424)
DOCUMENTED = {
    "lane_id",
    "role",
    "status",
    "confidence",
    "width_m",
    "width_sigma_m",
    "heading_deg",
    "vehicles",
}


def lane(lane_id: int = 1, heading_deg: float = 90.0, offset_m: float = 0.0) -> Lane:
    """A gently bent lane, 120 m long."""
    along = np.linspace(-60.0, 60.0, 41)
    bent = np.column_stack((along, 0.0008 * along**2 + offset_m))
    turn = np.radians(90.0 - heading_deg)
    center = bent @ np.array(
        [[np.cos(turn), np.sin(turn)], [-np.sin(turn), np.cos(turn)]], dtype=np.float64
    )
    return Lane(
        lane_id=lane_id,
        centerline_m=center,
        left_m=offset_line(center, 1.8),
        right_m=offset_line(center, -1.8),
        width_m=3.6,
        width_sigma_m=0.08,
        confidence=0.97,
        status="confirmed",
        vehicles=21.0,
        sigma_m=0.06,
    )


def lane_map() -> LaneMap:
    section = CrossSection(90.0, np.arange(4.0), np.array([0.0, 1.0, 0.5, 0.0]), np.array([1.0]))
    corners = np.array([[-70.0, -10.0], [-70.0, 20.0], [70.0, 20.0], [70.0, -10.0]])
    return LaneMap(1_500_000_000, (lane(1), lane(4, offset_m=3.6)), (section,), corners)


def collection() -> dict[str, Any]:
    return json.loads(dumps_lanes(lane_map(), DATUM))  # type: ignore[no-any-return]


def put(path: Path, data: object) -> Path:
    path.write_text(json.dumps(data), encoding="utf-8")
    return path


def furthest_m(a: np.ndarray, b: np.ndarray) -> float:
    return float(np.hypot(*(a - b).T).max())


@settings(max_examples=40, deadline=None)
@given(
    latitude=st.floats(-84.0, 84.0),
    longitude=st.floats(-180.0, 180.0),
    heading=st.floats(0.0, 359.0),
    offset=st.floats(-500.0, 500.0),
)
def test_round_trip_is_within_a_millimetre_anywhere(
    tmp_path_factory: pytest.TempPathFactory,
    latitude: float,
    longitude: float,
    heading: float,
    offset: float,
) -> None:
    datum = Datum(latitude, longitude)
    before = lane(7, heading, offset)
    path = tmp_path_factory.mktemp("lanes") / "lanes.geojson"
    write_lanes(path, LaneMap(5, (before,)), datum)
    after = read_lanes(path).lanes[0]
    for name in ("centerline_m", "left_m", "right_m"):
        assert furthest_m(getattr(before, name), getattr(after, name)) < 1e-3


def test_round_trip_keeps_everything_else(tmp_path: Path) -> None:
    before = lane_map()
    write_lanes(tmp_path / "l.geojson", before, DATUM, camera_id="pole_3", estimator="curvilinear")
    file = read_lane_file(tmp_path / "l.geojson")
    after = file.lane_map
    assert (file.camera_id, file.estimator, file.datum) == ("pole_3", "curvilinear", DATUM)
    assert after.stamp_ns == before.stamp_ns
    for a, b in zip(before.lanes, after.lanes, strict=True):
        for key in ("lane_id", "width_m", "width_sigma_m", "confidence", "status", "vehicles"):
            assert getattr(a, key) == pytest.approx(getattr(b, key))
    np.testing.assert_allclose(after.cross_sections[0].density, before.cross_sections[0].density)
    corners = {tuple(np.round(p, 2)) for p in after.visible_m}
    assert corners == {tuple(p) for p in before.visible_m}


def test_features_carry_the_documented_properties() -> None:
    data = lanes_to_geojson(lane_map(), DATUM)
    assert [f["properties"]["role"] for f in data["features"]] == [
        "centerline",
        "left",
        "right",
    ] * 2
    for feature in data["features"]:
        assert set(feature["properties"]) >= DOCUMENTED
        assert feature["geometry"]["type"] == "LineString"


SIGMA_ALONG_M = tuple(np.linspace(0.02, 0.04, len(lane().left_m)).round(3).tolist())
SOLID = LaneEdge("paint", 0.03, "solid", "yellow", 0.95, 0.25, SIGMA_ALONG_M)
PAINTED = replace(lane(), left_edge=SOLID, right_edge=LaneEdge("traffic", 0.2))


def test_what_bounds_a_lane_goes_along(tmp_path: Path) -> None:
    path = tmp_path / "lanes.geojson"
    write_lanes(path, LaneMap(1, (replace(PAINTED, driven_offset_m=-0.24),)), DATUM)
    features = {
        feature["properties"]["role"]: feature["properties"]
        for feature in json.loads(path.read_text())["features"]
    }
    assert features["left"]["marking"] == "solid"
    assert features["left"]["boundary_source"] == "paint"
    assert features["right"]["boundary_source"] == "traffic"
    assert "marking" not in features["right"]
    assert features["centerline"]["driven_offset_m"] == -0.24
    (back,) = read_lanes(path).lanes
    assert (back.left_edge, back.driven_offset_m) == (SOLID, -0.24)
    assert back.right_edge is not None
    assert (back.right_edge.source, back.right_edge.sigma_m) == ("traffic", 0.2)


def test_an_error_that_is_not_known_is_null(tmp_path: Path) -> None:
    edge = replace(SOLID, sigma_along_m=(float("nan"), *SIGMA_ALONG_M[1:]))
    write_lanes(tmp_path / "l.geojson", LaneMap(1, (replace(PAINTED, left_edge=edge),)), DATUM)
    (back,) = read_lanes(tmp_path / "l.geojson").lanes
    assert back.left_edge is not None


def test_edges_change_sides_with_boundaries_that_are_exchanged(tmp_path: Path) -> None:
    path = tmp_path / "lanes.geojson"
    write_lanes(path, LaneMap(1, (PAINTED,)), DATUM)
    swap = {"left": "right", "right": "left", "centerline": "centerline"}
    data = json.loads(path.read_text())
    for feature in data["features"]:
        feature["properties"]["role"] = swap[feature["properties"]["role"]]
    path.write_text(json.dumps(data))
    (back,) = read_lanes(path).lanes
    assert back.left_edge == SOLID


def read_with_left(folder: Path, words: dict[str, object], *, turned: bool = False) -> Lane:
    """The painted lane from a file that says something else of its left boundary."""
    path = folder / "lanes.geojson"
    write_lanes(path, LaneMap(1, (PAINTED,)), DATUM)
    data = json.loads(path.read_text())
    for feature in data["features"]:
        if feature["properties"]["role"] == "left":
            feature["properties"].update(words)
            if turned:
                feature["geometry"]["coordinates"].reverse()
    path.write_text(json.dumps(data))
    (back,) = read_lanes(path).lanes
    return back


@pytest.mark.parametrize(
    "words", [{"marking": "zigzag"}, {"boundary_source": "survey"}, {"marking_colour": 7}]
)
def test_words_of_other_programs_about_a_boundary_say_nothing(
    tmp_path: Path, words: dict[str, object]
) -> None:
    back = read_with_left(tmp_path, words)
    assert back.left_edge is None
    assert np.allclose(back.left_m, PAINTED.left_m, atol=1e-3)


@pytest.mark.parametrize("given", [[0.1, 0.2], "0.1", [None] * 400, {}])
def test_errors_along_a_boundary_that_are_not_one_for_each_point_say_nothing(
    tmp_path: Path, given: object
) -> None:
    back = read_with_left(tmp_path, {"boundary_sigma_along_m": given})
    assert back.left_edge == replace(SOLID, sigma_along_m=())


def test_a_boundary_drawn_the_other_way_round_has_its_errors_at_the_same_places(
    tmp_path: Path,
) -> None:
    back = read_with_left(tmp_path, {}, turned=True)
    assert np.allclose(back.left_m, PAINTED.left_m, atol=1e-3)
    assert back.left_edge == replace(SOLID, sigma_along_m=SIGMA_ALONG_M[::-1])


@pytest.mark.parametrize("heading", [0.0, 45.0, 90.0, 200.0, 355.0])
def test_heading_is_the_compass_direction_of_travel(heading: float) -> None:
    data = lanes_to_geojson(LaneMap(0, (lane(1, heading),)), DATUM)
    written = data["features"][0]["properties"]["heading_deg"]
    assert 0.0 <= written < 360.0
    assert (written - heading + 180.0) % 360.0 == pytest.approx(180.0, abs=0.3)
    (lon0, lat0), (lon1, lat1) = np.array(data["features"][0]["geometry"]["coordinates"])[[0, -1]]
    east = (lon1 - lon0) * np.cos(np.radians(lat0))
    compass = np.degrees(np.arctan2(east, lat1 - lat0)) % 360.0
    assert (compass - heading + 180.0) % 360.0 == pytest.approx(180.0, abs=0.5)


def test_unknown_values_are_null_not_nan() -> None:
    unknown = lane()
    object.__setattr__(unknown, "width_sigma_m", float("nan"))
    text = dumps_lanes(LaneMap(0, (unknown,)), DATUM)
    assert "NaN" not in text
    assert json.loads(text)["features"][0]["properties"]["width_sigma_m"] is None


def test_centrelines_and_ids_alone_are_enough(tmp_path: Path) -> None:
    data = collection()
    features = [f for f in data["features"] if f["properties"]["role"] == "centerline"]
    for feature in features:
        feature["properties"] = {"lane_id": feature["properties"]["lane_id"]}
    path = put(tmp_path / "truth.geojson", {"type": "FeatureCollection", "features": features})
    lanes = read_lanes(path, DATUM).lanes
    assert [x.lane_id for x in lanes] == [1, 4]
    assert furthest_m(lanes[0].centerline_m, lane(1).centerline_m) < 1e-3
    assert np.isnan(lanes[0].width_m)
    assert np.isnan(lanes[0].vehicles)
    assert lanes[0].status == "confirmed"


def test_boundaries_with_other_vertices_are_brought_beside_the_centreline(tmp_path: Path) -> None:
    data = collection()
    for feature in data["features"]:
        del feature["properties"]["width_m"]
        if feature["properties"]["role"] != "centerline":
            feature["geometry"]["coordinates"] = feature["geometry"]["coordinates"][::2]
    read = read_lanes(put(tmp_path / "l.geojson", data)).lanes[0]
    assert read.left_m.shape == read.centerline_m.shape
    assert read.width_m == pytest.approx(3.6, abs=0.02)


def first(data: dict[str, Any], key: str, value: object) -> dict[str, Any]:
    changed = copy.deepcopy(data)
    changed["features"][0]["properties"][key] = value
    return changed


def points(data: dict[str, Any], value: object) -> dict[str, Any]:
    changed = copy.deepcopy(data)
    changed["features"][0]["geometry"]["coordinates"] = value
    return changed


def geometry(data: dict[str, Any], kind: str | None, value: object) -> dict[str, Any]:
    changed = copy.deepcopy(data)
    shape = None if kind is None else {"type": kind, "coordinates": value}
    changed["features"][0]["geometry"] = shape
    return changed


def swapped(data: dict[str, Any]) -> dict[str, Any]:
    changed = copy.deepcopy(data)
    for feature in changed["features"]:
        line = feature["geometry"]["coordinates"]
        feature["geometry"]["coordinates"] = [[lat, lon] for lon, lat in line]
    return changed


WRONG: list[tuple[str, Any, tuple[str, ...]]] = [
    ("not an object", lambda _: [1], ("'type'", "list", "FeatureCollection")),
    ("no features", lambda _: {"type": "FeatureCollection"}, ("'features'", "None")),
    ("id missing", lambda d: first(d, "lane_id", None), ("feature 0", "'lane_id'", "whole")),
    ("a point", lambda d: geometry(d, "Point", [1.0, 2.0]), ("'Point'", "a LineString")),
    ("no geometry", lambda d: geometry(d, None, None), ("'geometry'", "a LineString")),
    (
        "parts",
        lambda d: geometry(d, "MultiLineString", [[[1, 2], [1, 3]], [[5, 2], [5, 3]]]),
        ("'MultiLineString'", "a LineString"),
    ),
    ("system", lambda d: {**d, "crs": {"properties": {"name": "nowhere"}}}, ("'crs'", "nowhere")),
    ("id text", lambda d: first(d, "lane_id", "A"), ("feature 0", "'lane_id'", "'A'")),
    ("role", lambda d: first(d, "role", "middle"), ("'role'", "'middle'", "'centerline'")),
    ("status", lambda d: first(d, "status", "sure"), ("'status'", "'sure'", "confirmed")),
    (
        "confidence",
        lambda d: first(d, "confidence", 1.7),
        ("'confidence'", "1.7", "outside 0 to 1"),
    ),
    ("width", lambda d: first(d, "width_m", "wide"), ("'width_m'", "'wide'", "not used")),
    ("twice", lambda d: first(d, "role", "left"), ("feature 1", "second left of lane 1")),
    ("one point", lambda d: points(d, [[1.0, 2.0]]), ("'coordinates'", "1 points", "two points")),
    ("text point", lambda d: points(d, [["a", 2], [1, 2]]), ("point 0", "['a', 2]", "numbers")),
    ("latitude 95", lambda d: points(d, [[1, 95], [1, 2]]), ("point 0", "[1, 95]", "-90..90")),
    ("no length", lambda d: points(d, [[-89.3424, 43.0439]] * 2), ("without length",)),
    ("far", lambda d: points(d, [[2.0, 48.0], [2.1, 48.0]]), ("point 0", "[2.0, 48.0]", "20 km")),
    ("swapped", swapped, ("feature 0", "latitude stands first")),
    ("version", lambda d: {**d, "geoorbit": {"format": 9}}, ("geoorbit.format", "9", "format 1")),
    ("datum", lambda d: {**d, "geoorbit": {"datum": {"latitude": 1}}}, ("geoorbit.datum",)),
]


@pytest.mark.parametrize(("change", "words"), [w[1:] for w in WRONG], ids=[w[0] for w in WRONG])
def test_wrong_files_are_one_sentence_with_place_and_value(
    tmp_path: Path, change: Any, words: tuple[str, ...]
) -> None:
    path = put(tmp_path / "wrong.geojson", change(collection()))
    with pytest.raises(InputFileError) as caught:
        read_lane_file(path, strict=True)
    message = str(caught.value)
    assert "wrong.geojson" in message
    assert "\n" not in message
    for word in words:
        assert word in message


@pytest.mark.parametrize("text", [b"", b"{", b"\xff\xfe\x00", b"[" * 100_000])
def test_not_json(tmp_path: Path, text: bytes) -> None:
    path = tmp_path / "broken.geojson"
    path.write_bytes(text)
    with pytest.raises(InputFileError, match=r"broken\.geojson.*expected a GeoJSON file"):
        read_lanes(path)


def test_numbers_that_no_float_holds_are_one_sentence(tmp_path: Path) -> None:
    path = tmp_path / "lanes.geojson"
    for value in ("9" * 400, "-" + "9" * 400):
        data = {"type": "FeatureCollection", "features": [_line([[8.5, 47.3], [8.5, 0.0]])]}
        path.write_text(json.dumps(data).replace("0.0]", f"{value}]"))
        with pytest.raises(InputFileError):
            read_lanes(path)


def _line(coordinates: list[list[float]]) -> dict[str, Any]:
    geometry = {"type": "LineString", "coordinates": coordinates}
    return {"type": "Feature", "geometry": geometry, "properties": {"lane_id": 1}}


def each_property(data: dict[str, Any], key: str, value: object) -> dict[str, Any]:
    changed = copy.deepcopy(data)
    for feature in changed["features"]:
        if value is None:
            del feature["properties"][key]
        else:
            feature["properties"][key] = value
    return changed


def in_parts(data: dict[str, Any]) -> dict[str, Any]:
    changed = copy.deepcopy(data)
    for feature in changed["features"]:
        line = feature["geometry"]["coordinates"]
        parts = {"type": "MultiLineString", "coordinates": [line[:20], line[19:]]}
        feature["geometry"] = parts
    return changed


def turned(data: dict[str, Any]) -> dict[str, Any]:
    """Boundaries drawn against the direction of travel."""
    changed = copy.deepcopy(data)
    for feature in changed["features"]:
        if feature["properties"]["role"] != "centerline":
            feature["geometry"]["coordinates"].reverse()
    return changed


def sides_exchanged(data: dict[str, Any]) -> dict[str, Any]:
    changed = copy.deepcopy(data)
    other = {"left": "right", "right": "left", "centerline": "centerline"}
    for feature in changed["features"]:
        feature["properties"]["role"] = other[feature["properties"]["role"]]
    return changed


def utm(data: dict[str, Any]) -> dict[str, Any]:
    changed = copy.deepcopy(data)
    to_utm = Transformer.from_crs("EPSG:4326", "EPSG:32616", always_xy=True)
    for feature in changed["features"]:
        x, y = to_utm.transform(*np.array(feature["geometry"]["coordinates"]).T)
        feature["geometry"]["coordinates"] = np.column_stack((x, y)).tolist()
    changed["crs"] = {"type": "name", "properties": {"name": "urn:ogc:def:crs:EPSG::32616"}}
    return changed


def without_centrelines(data: dict[str, Any]) -> dict[str, Any]:
    roles = ("left", "right")
    return {**data, "features": [f for f in data["features"] if f["properties"]["role"] in roles]}


SAME: list[tuple[str, Any, str]] = [
    ("swapped", swapped, "latitude stands first"),
    ("in parts", in_parts, "MultiLineString"),
    ("boundaries turned", turned, ""),
    ("sides exchanged", sides_exchanged, "left and right"),
    ("UTM", utm, "EPSG::32616"),
    ("only boundaries", without_centrelines, "between its boundaries"),
    ("odd status", lambda d: each_property(d, "status", "sure"), "taken as confirmed"),
    ("Confirmed", lambda d: each_property(d, "status", " Confirmed"), ""),
    ("confidence in percent", lambda d: each_property(d, "confidence", 97), "'confidence'"),
    ("altitudes", lambda d: points(d, [[*p, 12.5] for p in
     d["features"][0]["geometry"]["coordinates"]]), ""),
    ("a point without number", lambda d: points(d, [
        *d["features"][0]["geometry"]["coordinates"], [None, 1.0]]), "no numbers"),
    ("other things in the file", lambda d: {**d, "features": [
        *d["features"], {"type": "Feature", "properties": {}, "geometry": {
            "type": "Point", "coordinates": [1, 2]}}, None]}, "left out"),
    ("a lane twice", lambda d: {**d, "features": [*d["features"], d["features"][0]]}, "a second"),
    ("a lane far away", lambda d: {**d, "features": [*d["features"], {
        "type": "Feature", "properties": {"lane_id": 9}, "geometry": {
            "type": "LineString", "coordinates": [[2, 48], [2.1, 48]]}}]}, "20 km"),
]  # fmt: skip
"""Files that give the same two lanes, and what is said of them."""


@pytest.mark.parametrize(("change", "said"), [x[1:] for x in SAME], ids=[x[0] for x in SAME])
def test_odd_files_give_the_same_lanes_and_tell_it(tmp_path: Path, change: Any, said: str) -> None:
    file = read_lane_file(put(tmp_path / "odd.geojson", change(collection())))
    told = " | ".join(file.report.sentences())
    assert said in told
    assert bool(told) == bool(said)
    assert [lane.lane_id for lane in file.lane_map.lanes] == [1, 4]
    for found, true in zip(file.lane_map.lanes, lane_map().lanes, strict=True):
        assert found.status == "confirmed"
        for name in ("centerline_m", "left_m", "right_m"):
            assert furthest_m(getattr(found, name), getattr(true, name)) < 0.02


def test_lanes_without_numbers_are_numbered_in_their_order(tmp_path: Path) -> None:
    data = collection()
    lines = [f for f in data["features"] if f["properties"]["role"] == "centerline"]
    for feature in lines:
        feature["properties"] = {"name": "a lane"}
    file = read_lane_file(put(tmp_path / "l.geojson", {**data, "features": lines}))
    assert [lane.lane_id for lane in file.lane_map.lanes] == [1, 2]
    assert "numbered in their order" in " ".join(file.report.sentences())


def test_a_single_feature_is_a_file_of_one_lane(tmp_path: Path) -> None:
    file = read_lane_file(put(tmp_path / "l.geojson", collection()["features"][0]))
    assert [lane.lane_id for lane in file.lane_map.lanes] == [1]


def test_a_file_most_of_which_is_no_lanes_is_refused(tmp_path: Path) -> None:
    point = {"type": "Feature", "properties": {}, "geometry": {"type": "Point", "coordinates": []}}
    data = collection()
    path = put(tmp_path / "l.geojson", {**data, "features": [*data["features"], *[point] * 7]})
    with pytest.raises(InputFileError, match=r"7 of 13 features left out: .*LineString"):
        read_lane_file(path)


def test_missing_file(tmp_path: Path) -> None:
    with pytest.raises(InputFileError, match=r"absent\.geojson: found No such file"):
        read_lanes(tmp_path / "absent.geojson")
