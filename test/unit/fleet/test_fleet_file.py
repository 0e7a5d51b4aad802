"""Fleet files: what is right is read, what is wrong is said in one sentence with its place."""

import json
from pathlib import Path

import cv2
import numpy as np
import pytest
import yaml

from geoorbit_ros.core.errors import InputFileError
from geoorbit_ros.core.input_report import InputReport
from geoorbit_ros.core.resources import share_path, shipped_names
from geoorbit_ros.fleet.fleet_file import CAMERA_NODES, Fleet
from geoorbit_ros.fleet.fleet_io import FOLDER, load_fleet
from geoorbit_ros.fleet.plan import (
    FleetPlanError,
    ProcessPlan,
    expected_nodes,
    plan_fleet,
    plan_nodes,
    select,
)
from geoorbit_ros.fleet.prepare import ask_sources
from geoorbit_ros.storage.frames.source import FrameSourceError

GOOD = """\
name: crossing
domain_id: 7
cameras:
  - id: north
    source: bag:north_bag
    calibration: north.csv
    image_size: [1920, 1080]
    datum: {latitude_deg: 43.0, longitude_deg: -89.4}
    parameters:
      lane_geometry: {update_period_s: 2}
  - id: south
    source: rtsp://camera.example/south
    calibration: south.csv
    image_size: [1280, 720]
federated_server: {}
twin: {network: roads.net.xml}
recorder: {folder: databases}
viewer: {port: 8765}
"""


def write(folder: Path, text: str) -> Path:
    file = folder / "fleet.yaml"
    file.write_text(text, encoding="utf-8")
    return file


def test_a_fleet_is_read_with_its_defaults(tmp_path: Path) -> None:
    fleet, file = load_fleet(write(tmp_path, GOOD))
    assert [camera.id for camera in fleet.cameras] == ["north", "south"]
    assert [camera.kind for camera in fleet.cameras] == ["bag", "stream"]
    assert fleet.cameras[1].image_size == (1280, 720)
    assert fleet.twin
    assert fleet.twin.enabled
    assert file.parent == tmp_path


# What is replaced by what, the place that the sentence names, and a word of what it allows.
WRONG = [
    (
        "twin: {network: roads.net.xml}",
        "carla: {opendrive: roads.xodr}",
        "key 'carla'",
        "a twin, whose vehicles",
    ),
    (
        "viewer: {port: 8765}",
        "carla: {opendrive: roads.xodr, port: 0}",
        "key 'carla.port'",
        "1",
    ),
    ("name: crossing", "name: 4way", "line 1, key 'name'", "a letter first"),
    ("name: crossing\n", "", "line 1, key 'name'", "expected"),
    ("domain_id: 7", "domain_id: 233", "line 2, key 'domain_id'", "232"),
    ("domain_id: 7", "domain_id: seven", "line 2, key 'domain_id'", "a whole number"),
    ("domain_id: 7", "domian_id: 7", "line 2, key 'domian_id'", "'domain_id'?"),
    ("cameras:", "camera:", "line 3, key 'camera'", "'cameras'?"),
    ("id: north", "id: no-rth", "line 4, key 'cameras[0].id'", "letters, digits and _"),
    ("id: south", "id: north", "line 11, key 'cameras[1].id'", "another id"),
    ("source: bag:north_bag", "source: 'bag:'", "line 5, key 'cameras[0].source'", "bag:FOLDER"),
    ("source: bag:north_bag", "source: 'scene:'", "line 5, key 'cameras[0].source'", "scene:NAME"),
    ("source: bag:north_bag", "source: ''", "line 5, key 'cameras[0].source'", "at least 1"),
    ("    source: bag:north_bag\n", "", "key 'cameras[0].source'", "expected"),
    ("    calibration: south.csv\n", "", "key 'cameras[1].calibration'", "control points"),
    ("[1920, 1080]", "[1920]", "line 7, key 'cameras[0].image_size", "expected"),
    ("[1920, 1080]", "[1920, 0]", "line 7, key 'cameras[0].image_size[1]'", "16"),
    ("    image_size: [1280, 720]\n", "", "key 'cameras[1].image_size'", "[width, height]"),
    ("latitude_deg: 43.0", "latitude_deg: 143.0", "line 8", "90"),
    ("latitude_deg: 43.0", "latitude_deg: .nan", "line 8", "a finite number"),
    ("latitude_deg: 43.0", "latitude: 43.0", "line 8", "'latitude_deg'?"),
    ("lane_geometry: {", "lane_geomtry: {", "line 10", "lane_geometry"),
    ("update_period_s: 2", "update_period: 2", "line 10", "update_period_s"),
    ("update_period_s: 2", "update_period_s: fast", "line 10", "a number"),
    ("update_period_s: 2", "update_period_s: -1", "line 10", "from 0.1"),
    ("update_period_s: 2", "update_period_s: [1]", "line 10", "a number, a text, true or false"),
    ("calibration: south.csv", "calibration: 3", "line 13", "path"),
    ("network: roads.net.xml", "parameters: {}", "key 'twin.network'", "expected"),
    ("federated_server: {}", "federated_server: {rounds: 3}", "line 15", "a key that fleet"),
    ("federated_server: {}", "federated_server: 3", "line 15", "expected"),
    ("port: 8765", "port: 0", "line 18, key 'viewer.port'", "1"),
    ("port: 8765", "prt: 8765", "line 18, key 'viewer.prt'", "'port'?"),
    ("  - id: north", "  - [id: north", "line", "a fleet file"),
]


@pytest.mark.parametrize(("old", "new", "place", "allowed"), WRONG)
def test_a_wrong_fleet_file_gives_one_sentence_with_place_and_expectation(
    tmp_path: Path, old: str, new: str, place: str, allowed: str
) -> None:
    assert old in GOOD
    file = write(tmp_path, GOOD.replace(old, new, 1))
    with pytest.raises(InputFileError) as caught:
        load_fleet(file)
    message = str(caught.value)
    assert message.startswith(str(file))
    assert place in message
    assert allowed in message
    assert "\n" not in message


def test_a_camera_list_that_is_empty_is_refused(tmp_path: Path) -> None:
    with pytest.raises(InputFileError, match="at least 1"):
        load_fleet(write(tmp_path, "name: none\ncameras: []\n"))


def test_a_missing_file_and_an_unknown_shipped_fleet_are_named(tmp_path: Path) -> None:
    with pytest.raises(InputFileError, match=r"nowhere\.yaml: found no such file"):
        load_fleet(tmp_path / "nowhere.yaml")
    with pytest.raises(InputFileError, match="fleet 'nowhere': found no such fleet"):
        load_fleet("nowhere")


def test_files_that_are_not_there_are_named_all_at_once(tmp_path: Path) -> None:
    fleet, _ = load_fleet(write(tmp_path, GOOD))
    with pytest.raises(FleetPlanError) as caught:
        plan_fleet(fleet, tmp_path, tmp_path / "out")
    for name in ("north.csv", "north_bag", "south.csv", "roads.net.xml"):
        assert str(tmp_path / name) in str(caught.value)
    (tmp_path / "north_bag").mkdir()
    for name in ("north.csv", "south.csv", "roads.net.xml"):
        (tmp_path / name).touch()
    assert len(plan_fleet(fleet, tmp_path, tmp_path / "out")) == 5


def test_each_camera_is_one_process_and_services_start_first(tmp_path: Path) -> None:
    fleet, _ = load_fleet(write(tmp_path, GOOD))
    plans = plan_nodes(fleet, tmp_path, tmp_path / "out")
    assert [plan.name for plan in plans] == ["federated_server", "twin", "viewer", "north", "south"]
    north, south = ({n.executable: n for n in plan.nodes} for plan in plans[3:])
    assert "bag_player" in north
    assert "camera" not in north
    assert {"camera", "detector", "tracker"} <= set(south)
    assert all(node.namespace == "north" for node in north.values())
    assert north["lane_geometry"].parameters["update_period_s"] == 2
    assert north["homography"].parameters["datum_latitude_deg"] == 43.0
    assert south["camera"].parameters["source"] == "rtsp://camera.example/south"


def test_carla_shows_the_twin_to_the_same_cameras(tmp_path: Path) -> None:
    text = GOOD + "carla: {opendrive: roads.xodr, host: render.example}\n"
    fleet, _ = load_fleet(write(tmp_path, text))
    plans = {plan.name: plan for plan in plan_nodes(fleet, tmp_path, tmp_path)}
    twin, carla = (plans[name].nodes[0].parameters for name in ("twin", "carla"))
    for key in ("cameras", "calibrations", "image_sizes"):
        assert carla[key] == twin[key]
    assert carla["opendrive"] == str(tmp_path / "roads.xodr")
    assert (carla["host"], carla["port"]) == ("render.example", 2000)


def test_readers_start_before_writers(tmp_path: Path) -> None:
    fleet, _ = load_fleet(write(tmp_path, GOOD))
    for plan in plan_nodes(fleet, tmp_path, tmp_path)[3:]:
        order = [CAMERA_NODES.index(n.executable) for n in plan.nodes if n.executable in WAY]
        assert order == sorted(order, reverse=True)


WAY = ("bag_player", "camera", "detector", "tracker", "homography", "lane_geometry")


@pytest.mark.parametrize("repeat", [True, False])
def test_a_recording_plays_again_or_once(tmp_path: Path, repeat: bool) -> None:
    film = "  - {id: film, source: film.mp4, calibration: f.csv, image_size: [640, 480]}\n"
    text = GOOD.replace("  - id: south", f"{film}  - id: south")
    if not repeat:
        text = text.replace("id: film,", "id: film, repeat: false,")
        text = text.replace("source: bag:north_bag", "source: bag:north_bag\n    repeat: false")
    fleet, _ = load_fleet(write(tmp_path, text))
    nodes = {
        (n.executable, n.namespace): n.parameters
        for p in plan_nodes(fleet, tmp_path, tmp_path)
        for n in p.nodes
    }
    for node in (nodes["camera", "film"], nodes["bag_player", "north"]):
        assert (node["loop"], node["exit_when_done"]) == (repeat, False)
    assert "loop" not in nodes["camera", "south"]


@pytest.mark.parametrize(
    ("source", "kind"),
    [
        ("rtmp://camera/live", "stream"),
        ("udp://0.0.0.0:5000", "stream"),
        ("srt://camera:9000", "stream"),
        ("RTSP://camera/1", "stream"),
        ("http:film.mp4", "file"),
        ("2024-05-24T08:00:00.mp4", "file"),
        ("images", "file"),
    ],
)
def test_a_source_is_a_stream_by_its_scheme(tmp_path: Path, source: str, kind: str) -> None:
    text = GOOD.replace("rtsp://camera.example/south", f"'{source}'")
    fleet, _ = load_fleet(write(tmp_path, text))
    assert fleet.cameras[1].kind == kind
    (tmp_path / "south.csv").touch()
    node = next(
        n
        for p in plan_nodes(fleet, tmp_path, tmp_path)
        for n in p.nodes
        if (n.executable, n.namespace) == ("camera", "south")
    )
    expected = source if kind == "stream" else str(tmp_path / source)
    assert node.parameters["source"] == expected


def test_a_folder_of_images_has_the_rate_of_its_node(tmp_path: Path) -> None:
    for k in range(3):
        assert cv2.imwrite(str(tmp_path / f"{k}.png"), np.zeros((48, 64, 3), np.uint8))
    (tmp_path / "0.png").write_bytes(b"")
    text = GOOD.replace("rtsp://camera.example/south", ".").replace(
        "image_size: [1280, 720]", "parameters: {camera: {fps: 10.0}}"
    )
    fleet, _ = load_fleet(write(tmp_path, text))
    assert ask_sources(fleet, tmp_path, tmp_path, ["south"]).cameras[1].image_size == (64, 48)
    for file in tmp_path.glob("*.png"):
        file.write_bytes(b"")
    with pytest.raises(FrameSourceError, match="3 images that can't be used"):
        ask_sources(fleet, tmp_path, tmp_path, ["south"])


def test_disabled_parts_are_left_out(tmp_path: Path) -> None:
    text = GOOD.replace("federated_server: {}", "federated_server: {enabled: false}")
    text = text.replace("port: 8765", "enabled: false")
    text = text.replace("network: roads.net.xml", "network: roads.net.xml, enabled: false")
    text = text.replace("calibration: south.csv", "calibration: south.csv\n    enabled: false")
    fleet, _ = load_fleet(write(tmp_path, text))
    plans = plan_nodes(fleet, tmp_path, tmp_path)
    assert [plan.name for plan in plans] == ["north"]
    assert "meta_client" not in {node.executable for node in plans[0].nodes}
    assert set(expected_nodes(fleet)) == {"north"}


def test_only_selects_and_names_what_there_is(tmp_path: Path) -> None:
    fleet, _ = load_fleet(write(tmp_path, GOOD))
    plans = plan_nodes(fleet, tmp_path, tmp_path)
    assert [plan.name for plan in select(plans, ["north"])] == ["north"]
    assert select(plans, []) == plans
    with pytest.raises(FleetPlanError, match="one of federated_server, twin, viewer, north, south"):
        select(plans, ["west"])


def test_a_camera_can_not_be_called_like_a_service(tmp_path: Path) -> None:
    fleet, _ = load_fleet(write(tmp_path, GOOD.replace("id: north", "id: twin")))
    with pytest.raises(FleetPlanError, match="'twin'"):
        plan_fleet(fleet, tmp_path, tmp_path)


def test_a_plan_survives_the_way_to_its_process(tmp_path: Path) -> None:
    fleet, _ = load_fleet(write(tmp_path, GOOD))
    for plan in plan_nodes(fleet, tmp_path, tmp_path):
        assert ProcessPlan.from_json(plan.to_json(), "here") == plan
    with pytest.raises(InputFileError, match="a plan"):
        ProcessPlan.from_json("{}", "here")


def test_the_good_file_of_these_tests_is_yaml() -> None:
    assert yaml.safe_load(GOOD)["name"] == "crossing"


def test_a_parameter_by_its_old_name_is_taken(tmp_path: Path) -> None:
    old = "federated_server: {parameters: {judge_every: 3}}"
    file = tmp_path / "fleet.yaml"
    file.write_text(GOOD.replace("federated_server: {}", old))
    server = load_fleet(file)[0].federated_server
    assert server is not None
    assert server.parameters == {"judge_every": 3}  # the node says that it has a new name


def test_the_schema_for_editors_is_up_to_date() -> None:
    shipped = json.loads(share_path("params/fleets/fleet.schema.json").read_text())
    assert shipped == Fleet.model_json_schema(), "run docs/make_fleet_schema.py"


@pytest.mark.parametrize("name", shipped_names(FOLDER))
def test_shipped_fleets_are_right_and_their_files_are_there(name: str, tmp_path: Path) -> None:
    fleet, file = load_fleet(name)
    assert plan_fleet(fleet, file.parent, tmp_path)


@pytest.mark.parametrize(
    ("written", "said"),
    [
        ("{parameters: {validate_evry: 3}}", "expected 'validate_every'?"),
        ("{parameters: {zzzz: 3}}", "expected one of buffer_size, "),
    ],
)
def test_an_unknown_parameter_gets_the_nearest_name_and_no_old_one(
    tmp_path: Path, written: str, said: str
) -> None:
    file = tmp_path / "fleet.yaml"
    file.write_text(GOOD.replace("federated_server: {}", f"federated_server: {written}"))
    with pytest.raises(InputFileError) as error:
        load_fleet(file)
    assert said in str(error.value)
    assert "judge_every" not in str(error.value)


def test_traffic_is_counted_on_the_cameras_clock_into_its_database(tmp_path: Path) -> None:
    text = GOOD.replace("viewer: {port: 8765}", "traffic: {parameters: {interval_s: 300}}")
    text = text.replace(
        "calibration: south.csv", "calibration: south.csv\n    timezone: Asia/Tokyo"
    )
    fleet, _ = load_fleet(write(tmp_path, text))
    nodes = {
        (node.namespace, node.executable): node.parameters
        for plan in plan_nodes(fleet, tmp_path, tmp_path / "out")
        for node in plan.nodes
    }
    for camera, zone in (("north", "UTC"), ("south", "Asia/Tokyo")):
        given = nodes[camera, "traffic"]
        assert given["database"] == nodes[camera, "recorder"]["database"]
        assert (given["timezone"], given["interval_s"]) == (zone, 300)
    fleet, _ = load_fleet(write(tmp_path, GOOD))
    plans = plan_nodes(fleet, tmp_path, tmp_path / "out")
    assert not any(node.executable == "traffic" for plan in plans for node in plan.nodes)


def test_a_time_zone_that_there_is_not_is_one_sentence(tmp_path: Path) -> None:
    text = GOOD.replace("calibration: south.csv", "calibration: south.csv\n    timezone: Mars/Base")
    report = InputReport("fleet", "cameras")
    load_fleet(write(tmp_path, text), report)
    assert any("Mars/Base" in sentence for sentence in report.sentences())


def test_the_view_of_every_camera_with_images_is_watched_unless_the_file_says_otherwise(
    tmp_path: Path,
) -> None:
    presets = "\n    views: [{name: bridge, calibration: bridge.csv, image: bridge.png}]"
    film = "  - {id: film, source: film.mp4, calibration: f.csv, image_size: [640, 480]}\n"
    text = GOOD.replace("  - id: south", f"{film}  - id: south{presets}")
    fleet, _ = load_fleet(write(tmp_path, text))
    nodes = {
        (n.executable, n.namespace): n.parameters
        for p in plan_nodes(fleet, tmp_path, tmp_path / "out")
        for n in p.nodes
    }
    assert ("view_watch", "north") not in nodes, "recorded boxes"
    south, boxes = nodes["view_watch", "south"], nodes["homography", "south"]
    assert south["view_images"] == f"bridge={tmp_path / 'bridge.png'}"
    assert boxes["view_calibrations"] == f"bridge={tmp_path / 'bridge.csv'}"
    assert south["calibration_file"] == boxes["calibration_file"]
    assert not south["repeats_allowed"]
    assert nodes["view_watch", "film"]["repeats_allowed"]
    quiet = text.replace("id: film,", "id: film, watch_view: false,")
    plans = plan_nodes(load_fleet(write(tmp_path, quiet))[0], tmp_path, tmp_path / "out")
    assert ("view_watch", "film") not in {
        (n.executable, n.namespace) for p in plans for n in p.nodes
    }
