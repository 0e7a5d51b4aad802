"""Who may use a lane: vehicles stay where they are seen, and what the map says is kept."""

import json
from pathlib import Path
from xml.etree import ElementTree as Xml

import numpy as np
import pytest
import sumolib
from made_detections import lane
from made_maps import BAVARIA, MadeCamera, MadeExtract, road

from geoorbit_ros.cli.main import main
from geoorbit_ros.core.lanes import Lane
from geoorbit_ros.mapcheck.patch import patch_network
from geoorbit_ros.mapcheck.validation import validate
from geoorbit_ros.roadnet.map_build import build_from_osm
from geoorbit_ros.roadnet.network import RoadNetwork
from geoorbit_ros.roadnet.reference_lanes import reference_lanes

BUS_LANE = {
    "oneway": "yes",
    "lanes": "3",
    "bus:lanes": "yes|yes|designated",
    "vehicle:lanes": "yes|yes|no",
    "maxspeed": "50",
}
EVERYWHERE = np.array([(-900.0, -900.0), (900.0, -900.0), (900.0, 900.0), (-900.0, 900.0)])
CAR, BUS, BICYCLE = 2, 5, 1


def network_of(folder: Path, extract: MadeExtract) -> RoadNetwork:
    (folder / "map").mkdir()
    return build_from_osm(extract.write(folder / "a.osm"), folder / "map", extract.datum).network


def seen(network: RoadNetwork, names: list[str], vehicles: float = 30.0) -> list[Lane]:
    found = []
    for number, name in enumerate(names, 1):
        begin, end = network.line(network.number[name])[[0, -1]]
        line = begin + np.linspace(0.1, 0.9, 100)[:, None] * (end - begin)
        found.append(lane(number, line, vehicles))
    return found


def replay(folder: Path, network: RoadNetwork, camera: MadeCamera) -> dict[str, object]:
    tracks, calibration = camera.write(folder)
    points, bag, out = ["--calibration", str(calibration)], str(folder / "bag"), folder / "twin"
    boxes = ["--tracks", str(tracks), "--camera-id", "c"]
    assert main(["bag", "from-csv", *boxes, *points, "--out", bag]) == 0
    net = ["--net", str(network.path)]
    assert main(["twin", "replay", bag, *net, *points, "--out", str(out)]) == 0
    score: dict[str, object] = json.loads((out / "score.json").read_text())
    return score


def along(x: float) -> np.ndarray:
    return np.array([(x, -138.0), (x, 138.0)])


def test_cars_beside_a_bus_lane_say_nothing_about_it(tmp_path: Path) -> None:
    network = network_of(tmp_path, road(BAVARIA, BUS_LANE))
    assert [network.users(network.number[f"10_{k}"]) for k in range(3)] == ["buses", "", ""]
    (tmp_path / "out").mkdir()
    result = patch_network(seen(network, ["10_1", "10_2"]), network, tmp_path / "out")
    assert (result.before.findings, result.done, result.left) == ((), (), ())
    assert [u.lane_id for u in result.before.discrepancies.unseen] == ["10_0"]
    assert "for buses" in result.before.discrepancies.unseen[0].sentence
    assert result.network.allowed == network.allowed
    assert len(reference_lanes(network, EVERYWHERE)) == 3


def test_lanes_seen_on_a_bus_lane_are_told_and_are_no_finding(tmp_path: Path) -> None:
    network = network_of(tmp_path, road(BAVARIA, BUS_LANE))
    found = validate(seen(network, ["10_0", "10_1", "10_2"]), network)
    assert found.findings == ()
    (note,) = found.notes
    assert "lane 1 (30 vehicles) runs on 10_0, which is for buses" in note


def test_a_car_on_a_bus_lane_stays_there_and_is_told(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    network = network_of(tmp_path, road(BAVARIA, BUS_LANE))
    camera = MadeCamera(BAVARIA)
    camera.drive(along(3.5), 3, begin_s=0.0)
    camera.drive(along(0.0), 4, begin_s=1.0)
    camera.drive(along(3.5), 2, begin_s=14.0, coco_class=BUS)
    score = replay(tmp_path, network, camera)
    assert score["vehicles_total"] == camera.tracks
    assert score["in_reserved_lanes"] == {"10_0": {"car": 3}}
    assert score["lane_error_share"] == score["beside_share"] == 0.0
    said = " ".join(capsys.readouterr().out.split())
    assert "3 cars drove along 10_0, which the map keeps for buses" in said


def test_bicycles_are_on_the_cycle_lane_and_cars_beside_it_are_not(tmp_path: Path) -> None:
    network = network_of(tmp_path, road(BAVARIA, {"lanes": "2", "cycleway": "lane"}))
    x = {name: network.line(network.number[name])[0, 0] for name in ("10_0", "10_1")}
    assert (x["10_0"], x["10_1"]) == pytest.approx((4.25, 1.75), abs=0.02)
    assert network.users(network.number["10_0"]) == "bicycles"
    assert len(reference_lanes(network, EVERYWHERE)) == 2
    camera = MadeCamera(BAVARIA)
    camera.drive(along(4.25), 2, speed_mps=6.0, coco_class=BICYCLE)
    camera.drive(along(2.9), 3, begin_s=4.0)  # keeps to the side
    score = replay(tmp_path, network, camera)
    assert score["in_reserved_lanes"] == {}
    assert score["beside_share"] == 0.0
    states = (tmp_path / "twin" / "vehicles.csv").read_text().splitlines()[1:]
    lanes = {tuple(row.split(",")[2:9:6]) for row in states}
    assert lanes <= {("bicycle", "10_0"), ("car", "10_1"), ("bicycle", ""), ("car", "")}


def test_a_car_on_a_road_for_buses_does_not_end_the_twin(tmp_path: Path) -> None:
    tags = {"lanes": "2", "motor_vehicle": "no", "bus": "yes"}
    network = network_of(tmp_path, road(BAVARIA, tags))
    assert network.users(network.number["10_0"]) == "buses and bicycles"
    camera = MadeCamera(BAVARIA)
    camera.drive(along(1.75), 3)
    score = replay(tmp_path, network, camera)
    assert score["vehicles_total"] == 3
    assert score["in_reserved_lanes"] == {"10_0": {"car": 3}}
    assert score["lane_error_share"] == score["lost"] == 0


def test_demand_keeps_vehicles_that_were_seen_where_they_may_not_drive(tmp_path: Path) -> None:
    """SUMO's own simulation loads it and lets all of them depart."""
    network = network_of(tmp_path, road(BAVARIA, BUS_LANE))
    camera = MadeCamera(BAVARIA)
    camera.drive(along(3.5), 2)
    camera.drive(along(0.0), 2, begin_s=1.0)
    tracks, calibration = camera.write(tmp_path)
    points, bag, out = ["--calibration", str(calibration)], str(tmp_path / "bag"), tmp_path / "out"
    boxes = ["--tracks", str(tracks), "--camera-id", "c"]
    assert main(["bag", "from-csv", *boxes, *points, "--out", bag]) == 0
    net = ["--net", str(network.path)]
    assert main(["twin", "routes", bag, *net, *points, "--out", str(out)]) == 0
    types = [v.get("type") for v in Xml.parse(out / "traffic.rou.xml").getroot().iter("vehicle")]
    assert sorted(map(str, types)) == ["car", "car", "car_in_any_lane", "car_in_any_lane"]
    trips = tmp_path / "trips.xml"
    import subprocess

    sumo = sumolib.checkBinary("sumo")
    command = [sumo, "-c", str(out / "traffic.sumocfg"), "--tripinfo-output", str(trips)]
    assert subprocess.run(command, capture_output=True, check=False).returncode == 0
    assert len(list(Xml.parse(trips).getroot().iter("tripinfo"))) == 4


def test_a_forecast_keeps_cars_off_the_bus_lane(tmp_path: Path) -> None:
    network = network_of(tmp_path, road(BAVARIA, BUS_LANE))
    camera = MadeCamera(BAVARIA)
    for x in (0.0, -3.5):
        camera.drive(along(x), 10, begin_s=0.5 * abs(x), every_s=2.5)
    camera.drive(along(3.5), 1, begin_s=26.0)
    tracks, calibration = camera.write(tmp_path)
    points, bag, out = ["--calibration", str(calibration)], str(tmp_path / "bag"), tmp_path / "out"
    boxes = ["--tracks", str(tracks), "--camera-id", "c"]
    assert main(["bag", "from-csv", *boxes, *points, "--out", bag]) == 0
    net = ["--net", str(network.path), "--minutes", "2"]
    assert main(["twin", "forecast", bag, *net, *points, "--out", str(out)]) == 0
    (found,) = json.loads((out / "forecast.json").read_text())["forecasts"]
    flow = {one["lane"]: one["flow_per_h"] for one in found["lanes"]}
    assert flow["10_0"] < 0.1 * flow["10_1"]  # the car that was there at first
    assert flow["10_1"] > 100.0
    assert found["waiting"] <= 2


def test_a_new_lane_beside_a_bus_lane_is_for_cars(tmp_path: Path) -> None:
    network = network_of(tmp_path, road(BAVARIA, BUS_LANE))
    lanes = seen(network, ["10_1", "10_2"])
    outside = seen(network, ["10_0"])[0].centerline_m + np.array([3.6, 0.0])
    (tmp_path / "out").mkdir()
    result = patch_network([*lanes, lane(3, outside, 30.0)], network, tmp_path / "out")
    assert [f.kind for f in result.done] == ["missing"]
    patched = result.network
    users = [patched.users(patched.number[f"10_{k}"]) for k in range(4)]
    assert users == ["", "buses", "", ""]
    assert result.after.findings == ()
