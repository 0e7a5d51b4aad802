"""Exported lane maps, read back by each format's own library."""

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from xml.etree import ElementTree as Xml

import carla
import lanelet2
import numpy as np
import pytest
import sumolib
from numpy.typing import NDArray

from geoorbit_ros.calibration.datum import Datum
from geoorbit_ros.core.lanes import Lane, LaneEdge, LaneMap
from geoorbit_ros.exchange.lanelet2 import to_lanelet2
from geoorbit_ros.exchange.opendrive import to_opendrive
from geoorbit_ros.exchange.sumo import carriageways, to_sumo
from geoorbit_ros.lanes.geojson import LaneFile

DATUM = Datum(43.05, -89.35)
RADIUS_M = 200.0


def bend(offset_m: float, turn: NDArray[np.float64]) -> NDArray[np.float64]:
    """A left bend, `offset_m` to the driver's left of the reference."""
    radius = RADIUS_M - offset_m
    return np.column_stack([radius * np.sin(turn), RADIUS_M - radius * np.cos(turn)])


def make_lane(number: int, offset_m: float, width_m: float, *, backwards: bool = False) -> Lane:
    turn = np.linspace(0.0, 0.5, 40)
    sides = [bend(offset_m + shift * width_m, turn) for shift in (0.0, 0.5, -0.5)]
    if backwards:
        centre, right, left = (side[::-1] for side in sides)
    else:
        centre, left, right = sides
    return Lane(number, centre, left, right, width_m, 0.1, 0.93, "confirmed", 41.0)


@pytest.fixture
def lanes() -> LaneFile:
    found = (
        make_lane(1, 0.0, 3.5),
        make_lane(2, 3.6, 3.7),
        make_lane(5, 12.0, 3.4, backwards=True),
    )
    return LaneFile(LaneMap(60_000_000_000, found), DATUM, "north", "curvilinear")


def test_neighbours_of_one_direction_are_one_carriageway(lanes: LaneFile) -> None:
    groups = carriageways(lanes.lane_map.lanes)
    assert [[lane.lane_id for lane in group] for group in groups] == [[1, 2], [5]]
    swapped = carriageways(lanes.lane_map.lanes[::-1])
    assert {tuple(lane.lane_id for lane in group) for group in swapped} == {(1, 2), (5,)}


def test_carla_reads_the_opendrive_with_every_lane_its_width_and_its_place(
    lanes: LaneFile,
) -> None:
    road_map = carla.Map("lanes", to_opendrive(lanes))
    points = road_map.generate_waypoints(2.0)
    assert {(point.road_id, point.lane_id) for point in points} == {(1, -1), (2, -1), (5, -1)}
    for lane in lanes.lane_map.lanes:
        for x, y in lane.centerline_m[3:-3:6]:
            # CARLA's y axis points south.
            point = road_map.get_waypoint(carla.Location(x=float(x), y=-float(y), z=0.0))
            assert point.road_id == lane.lane_id
            assert point.lane_width == pytest.approx(lane.width_m, abs=0.02)
            found = point.transform.location
            assert np.hypot(found.x - x, found.y + y) < 0.05
    origin = road_map.transform_to_geolocation(carla.Location(0.0, 0.0, 0.0))
    assert origin.latitude == pytest.approx(DATUM.latitude_deg, abs=1e-6)
    assert origin.longitude == pytest.approx(DATUM.longitude_deg, abs=1e-6)


def test_opendrive_lanes_run_in_the_direction_of_travel(lanes: LaneFile) -> None:
    road_map = carla.Map("lanes", to_opendrive(lanes))
    for lane in lanes.lane_map.lanes:
        x, y, heading_rad = lane.middle
        point = road_map.get_waypoint(carla.Location(x=x, y=-y, z=0.0))
        turn = np.radians(-point.transform.rotation.yaw) - heading_rad
        assert abs((turn + np.pi) % (2 * np.pi) - np.pi) < np.radians(2.0)


def test_sumolib_reads_the_network_with_every_lane_its_width_and_its_place(
    lanes: LaneFile, tmp_path: Path
) -> None:
    file = tmp_path / "lanes.net.xml"
    file.write_text(to_sumo(lanes))
    net = sumolib.net.readNet(str(file))
    edges = {edge.getID(): edge for edge in net.getEdges()}
    assert {name: edge.getLaneNumber() for name, edge in edges.items()} == {
        "lanes_1_2": 2,
        "lanes_5": 1,
    }
    for edge in edges.values():
        for found in edge.getLanes():
            lane_id = int(found.getParam("geoorbit:lane_id"))
            lane = next(lane for lane in lanes.lane_map.lanes if lane.lane_id == lane_id)
            assert found.getWidth() == pytest.approx(lane.width_m, abs=0.006)
            assert found.getParam("geoorbit:confidence") == "0.930000"
            x, y, _ = lane.middle
            _, distance_m = found.getClosestLanePosAndDist((x, y))
            assert distance_m < 0.02
    longitude, latitude = net.convertXY2LonLat(0.0, 0.0)
    assert (latitude, longitude) == pytest.approx((43.05, -89.35), abs=1e-7)


def test_lanelet2_reads_every_lanelet_its_width_and_its_place(
    lanes: LaneFile, tmp_path: Path
) -> None:
    file = tmp_path / "lanes.osm"
    file.write_text(to_lanelet2(lanes))
    origin = lanelet2.io.Origin(DATUM.latitude_deg, DATUM.longitude_deg)
    found = lanelet2.io.load(str(file), lanelet2.projection.LocalCartesianProjector(origin))
    assert len(found.laneletLayer) == 3
    for lanelet in found.laneletLayer:
        lane_id = int(lanelet.attributes["geoorbit:lane_id"])
        lane = next(lane for lane in lanes.lane_map.lanes if lane.lane_id == lane_id)
        for side, points_m in (("leftBound", lane.left_m), ("rightBound", lane.right_m)):
            read = np.array([(p.x, p.y) for p in getattr(lanelet, side)])
            assert np.abs(read - points_m).max() < 0.02
        assert lanelet.attributes["geoorbit:status"] == "confirmed"
        assert lanelet2.geometry.inside(lanelet, lanelet2.core.BasicPoint2d(*lane.middle[:2]))


@pytest.mark.parametrize("write", [to_opendrive, to_lanelet2, to_sumo])
def test_who_found_the_lanes_and_when_goes_along(
    lanes: LaneFile, write: Callable[[LaneFile], str]
) -> None:
    text = write(lanes)
    Xml.fromstring(text)
    for fact in ("north", "curvilinear", "60000000000", "0.93", "41.0"):
        assert fact in text


def test_a_lane_that_widens_keeps_its_widths(lanes: LaneFile) -> None:
    lane = lanes.lane_map.lanes[0]
    wider = np.linspace(1.0, 1.5, len(lane.left_m))[:, None]
    left = lane.centerline_m + (lane.left_m - lane.centerline_m) * wider
    file = replace(lanes, lane_map=LaneMap(1, (replace(lane, left_m=left),)))
    road_map = carla.Map("lanes", to_opendrive(file))
    for k in (5, 20, 35):
        x, y = lane.centerline_m[k]
        point = road_map.get_waypoint(carla.Location(x=float(x), y=-float(y), z=0.0))
        expected = np.hypot(*(left[k] - lane.right_m[k]))
        assert point.lane_width == pytest.approx(expected, abs=0.02)


@pytest.fixture
def painted(lanes: LaneFile) -> LaneFile:
    """A solid yellow line on the left of every lane, dashes of 0.12 m on its right."""
    solid = LaneEdge("paint", 0.03, "solid", "yellow", 1.0, 0.25)
    dashed = LaneEdge("paint", 0.03, "dashed", "white", 1.0, 0.12)
    found = tuple(replace(x, left_edge=solid, right_edge=dashed) for x in lanes.lane_map.lanes)
    return replace(lanes, lane_map=replace(lanes.lane_map, lanes=found))


def test_carla_reads_the_painted_lines(painted: LaneFile) -> None:
    road_map = carla.Map("lanes", to_opendrive(painted))
    for point in road_map.generate_waypoints(5.0):
        left, right = point.left_lane_marking, point.right_lane_marking
        assert (left.type, left.color) == (
            carla.LaneMarkingType.Solid,
            carla.LaneMarkingColor.Yellow,
        )
        assert (right.type, right.color) == (
            carla.LaneMarkingType.Broken,
            carla.LaneMarkingColor.Standard,
        )
        assert (left.width, right.width) == (pytest.approx(0.25), pytest.approx(0.12))
        assert left.lane_change == carla.LaneChange.NONE


def test_lanelet2_reads_the_painted_lines(painted: LaneFile, tmp_path: Path) -> None:
    path = tmp_path / "lanes.osm"
    path.write_text(to_lanelet2(painted), encoding="utf-8")
    origin = lanelet2.io.Origin(DATUM.latitude_deg, DATUM.longitude_deg)
    loaded = lanelet2.io.load(str(path), lanelet2.projection.LocalCartesianProjector(origin))
    lanelets = list(loaded.laneletLayer)
    assert len(lanelets) == 3
    for lanelet in lanelets:
        left, right = lanelet.leftBound.attributes, lanelet.rightBound.attributes
        assert (left["type"], left["subtype"], left["color"]) == ("line_thick", "solid", "yellow")
        assert (right["type"], right["subtype"]) == ("line_thin", "dashed")


def test_double_lines_have_the_names_of_each_format(painted: LaneFile) -> None:
    double = LaneEdge("paint", 0.03, "double", "yellow", 1.0, 0.36)
    found = tuple(replace(x, left_edge=double) for x in painted.lane_map.lanes)
    file = replace(painted, lane_map=replace(painted.lane_map, lanes=found))
    point = carla.Map("lanes", to_opendrive(file)).generate_waypoints(5.0)[0]
    assert point.left_lane_marking.type == carla.LaneMarkingType.SolidSolid
    assert point.left_lane_marking.lane_change == carla.LaneChange.NONE
    assert 'v="solid_solid"' in to_lanelet2(file)
    assert "changeLeft" in to_sumo(file)


def test_sumo_lets_nobody_change_over_a_solid_line(painted: LaneFile, tmp_path: Path) -> None:
    path = tmp_path / "lanes.net.xml"
    for file, allowed in ((painted, {"emergency", "authority"}), (unpainted(painted), None)):
        path.write_text(to_sumo(file), encoding="utf-8")
        lanes = {
            (edge.attrib["id"], lane.attrib["index"]): lane.attrib
            for edge in Xml.parse(path).getroot().iter("edge")
            for lane in edge.iter("lane")
        }
        # The line left of lane 1 is solid, that right of lane 2 is dashed: each lane has its own.
        left = lanes["lanes_1_2", "0"].get("changeLeft")
        assert (set(left.split()) if left else None) == allowed
        assert "changeRight" not in lanes["lanes_1_2", "1"]
        assert "changeLeft" not in lanes["lanes_1_2", "1"], "there is no lane left of it"


def unpainted(file: LaneFile) -> LaneFile:
    lanes = tuple(replace(x, left_edge=None, right_edge=None) for x in file.lane_map.lanes)
    return replace(file, lane_map=replace(file.lane_map, lanes=lanes))
