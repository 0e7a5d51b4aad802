"""From OpenStreetMap to SUMO and CARLA: the same lanes at the same place."""

import gzip
import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from made_maps import BAVARIA, road
from made_twin import DATUM, made_network

from geoorbit_ros.calibration.datum import Datum
from geoorbit_ros.cli.main import main
from geoorbit_ros.roadnet.map_build import build_from_osm
from geoorbit_ros.roadnet.network import RoadNetwork, load_network

PLACE = Datum(48.0, 11.0)


def osm(tag: str = "highway") -> str:
    """A road of two lanes each way, one of them with a stated width, and a bend."""
    points = PLACE.to_geodetic([(-200, 0), (0, 0), (100, 10), (200, 40)])
    nodes = "".join(
        f'<node id="{k + 1}" lat="{lat:.8f}" lon="{lon:.8f}" version="1"/>'
        for k, (lat, lon) in enumerate(points)
    )
    refs = "".join(f'<nd ref="{k + 1}"/>' for k in range(len(points)))
    tags = {tag: "primary", "lanes": "4", "maxspeed": "50"}
    text = "".join(f'<tag k="{key}" v="{value}"/>' for key, value in tags.items())
    way = f'<way id="9" version="1">{refs}{text}</way>'
    return f'<?xml version="1.0" encoding="UTF-8"?><osm version="0.6">{nodes}{way}</osm>'


@pytest.fixture(scope="module")
def built(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("map")
    (folder / "area.osm.gz").write_bytes(gzip.compress(osm().encode()))
    assert main(["map", "build", str(folder / "area.osm.gz"), "--out", str(folder / "out")]) == 0
    return folder / "out"


def lanes_outside_junctions(network: RoadNetwork) -> list[int]:
    return [lane for lane in range(len(network)) if not network.internal[lane]]


def test_the_network_is_the_map_s_road(built: Path) -> None:
    network = load_network(built / "network.net.xml")
    assert len(lanes_outside_junctions(network)) == 4
    assert set(network.width_m) == {3.5}
    assert np.allclose(network.speed_mps, 50 / 3.6, atol=0.01)
    middle = PLACE.to_local(network.datum.latitude_deg, network.datum.longitude_deg)[0]
    assert np.abs(middle - (0.0, 20.0)).max() < 0.05  # of the map's roads
    assert np.abs(network.point_m[:, 0]).max() == pytest.approx(200.0, abs=8.0)


def test_the_record_says_how_it_was_made(built: Path) -> None:
    record = json.loads((built / "map.json").read_text())
    assert record["source"] == "area.osm.gz"
    assert "netconvert" in record["netconvert"]["version"]
    assert any("default.lanewidth=3.5" in o for o in record["netconvert"]["network_options"])
    assert record["lanes"] == 4
    assert (built / "map.png").stat().st_size > 5000


def carla_lanes(carla: Any, folder: Path) -> None:
    """Every lane of the network is a lane of CARLA's map, as wide, within 0.4 m."""
    network = load_network(folder / "network.net.xml")
    road = carla.Map("road", (folder / "road.xodr").read_text())
    found = set()
    for lane in lanes_outside_junctions(network):
        line, arc = network.line(lane), network.arc(lane)
        for at in np.linspace(0.2, 0.8, 5) * arc[-1]:
            x, y = (float(np.interp(at, arc, line[:, k])) for k in range(2))
            waypoint = road.get_waypoint(carla.Location(x, -y, 0.0))  # CARLA's y points south
            place = waypoint.transform.location
            assert np.hypot(place.x - x, place.y + y) < 0.4
            assert waypoint.lane_width == pytest.approx(network.width_m[lane], abs=0.01)
            k = min(int(np.searchsorted(arc, at)), len(line) - 1)
            heading = np.degrees(np.arctan2(*(line[k] - line[k - 1])[::-1]))
            turn = (waypoint.transform.rotation.yaw + heading + 180.0) % 360.0 - 180.0
            assert abs(turn) < 12.0  # netconvert rounds the corners of a polyline
            found.add((waypoint.road_id, waypoint.lane_id))
    assert len(found) == len(lanes_outside_junctions(network))
    origin = road.transform_to_geolocation(carla.Location(0.0, 0.0, 0.0))
    assert origin.latitude == pytest.approx(network.datum.latitude_deg, abs=1e-7)
    assert origin.longitude == pytest.approx(network.datum.longitude_deg, abs=1e-7)


def test_carla_opens_the_road_with_the_same_lanes(built: Path) -> None:
    carla_lanes(pytest.importorskip("carla"), built)


def test_a_network_there_is_becomes_a_map_too(tmp_path: Path) -> None:
    net = made_network(tmp_path)
    datum = Datum(43.055, -89.345)
    command = ["map", "build", "--net", str(net), "--out", str(tmp_path / "out")]
    place = f"{datum.latitude_deg},{datum.longitude_deg}"
    assert main([*command, "--datum", place]) == 0
    moved, there = load_network(tmp_path / "out" / "network.net.xml"), load_network(net, datum)
    assert moved.datum == datum
    assert moved.lane_id == there.lane_id
    assert np.abs(moved.point_m - there.point_m).max() < 0.002
    assert datum != DATUM
    carla_lanes(pytest.importorskip("carla"), tmp_path / "out")


@pytest.mark.parametrize(
    ("text", "said"),
    [
        (osm()[:400], "broken XML"),
        (osm("waterway"), "no road"),
        ("<net/>", "a SUMO network"),
        (osm().replace("primary", "footway"), "no lane for road vehicles|netconvert says"),
    ],
)
def test_no_map_is_one_sentence_and_nothing_is_left(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], text: str, said: str
) -> None:
    area = tmp_path / "area.osm"
    area.write_text(text)
    assert main(["map", "build", str(area), "--out", str(tmp_path / "out")]) == 2
    sentence = capsys.readouterr().err.strip()
    assert "\n" not in sentence
    assert str(area) in sentence or "network.net.xml" in sentence
    assert any(part in sentence for part in said.split("|"))
    assert sorted(path.name for path in tmp_path.iterdir()) == ["area.osm"]


def test_a_network_without_projection_is_one_sentence(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    net = made_network(tmp_path)
    net.write_text(net.read_text().replace(DATUM.proj_string, "!"))
    assert main(["map", "build", "--net", str(net), "--out", str(tmp_path / "out")]) == 2
    assert "a network without projection" in capsys.readouterr().err
    assert not (tmp_path / "out").exists()
    assert main(["map", "build", "--out", str(tmp_path / "out")]) == 2
    assert "exactly one of them" in capsys.readouterr().err


@pytest.mark.parametrize("lanes", [1, 2, 3])
def test_a_one_way_road_drawn_against_its_traffic_lies_on_its_line(
    tmp_path: Path, lanes: int
) -> None:
    """oneway=-1: the same lanes as with the line turned round."""
    middle = {}
    for oneway, tags in (("-1", {"turn:lanes": "|".join(["through"] * lanes)}), ("yes", {})):
        extract = road(BAVARIA, {"lanes": str(lanes), "oneway": oneway, **tags})
        folder = tmp_path / oneway
        folder.mkdir()
        built = build_from_osm(extract.write(tmp_path / "a.osm"), folder, BAVARIA)
        network = built.network
        outside = np.flatnonzero(~network.internal)
        assert len(outside) == lanes
        middle[oneway] = np.mean([network.line(int(k)).mean(axis=0) for k in outside], axis=0)
    assert middle["-1"] == pytest.approx(middle["yes"], abs=0.01)
