"""The bridge as a node: tracks in, the twin out, and it survives what dies beneath it."""

import os
import signal
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
from diagnostic_msgs.msg import DiagnosticArray
from geometry_msgs.msg import PoseArray
from made_twin import DATUM, START_NS, STEP_NS, made_network, rows
from nav_msgs.msg import Path as PathMessage
from probe import KEEP_ALL, LOSSLESS, Probe
from sensor_msgs.msg import CompressedImage, NavSatFix

from geoorbit_ros.calibration.datum import Datum
from geoorbit_ros.conversions import datum_to_fix
from geoorbit_ros.core.errors import GeoOrbitError
from geoorbit_ros.core.tables import TRACK_DTYPE
from geoorbit_ros.nodes.sumo_bridge.node import SumoBridgeNode
from geoorbit_ros.nodes.support.composition import Composition
from geoorbit_ros.nodes.support.qos import LATCHED, stream_qos
from geoorbit_ros.scenes.camera import look_at
from geoorbit_ros.twin.sumo_simulation import SumoSimulation

LANE_Y = -5.25
BEST_EFFORT = stream_qos("best_effort", 1)


@pytest.fixture(scope="module")
def net(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return made_network(tmp_path_factory.mktemp("net"))


def start(nodes: Composition, net: Path, **overrides: object) -> SumoBridgeNode:
    given = LOSSLESS | {"network": str(net), "cameras": "north south"} | overrides
    return nodes.make(SumoBridgeNode, "site", given)


def speak(nodes: Composition, camera: str) -> Any:
    """A probe that publishes a camera's datum, and its function to send tracks."""
    probe = Probe(nodes, f"site/{camera}", f"probe_{camera}")
    probe.publisher("datum", NavSatFix, LATCHED).publish(datum_to_fix(DATUM, "map"))
    return probe, probe.table_publisher("tracks")


def test_tracks_of_two_cameras_move_one_twin(nodes: Composition, net: Path) -> None:
    node = start(nodes, net, health_period_s=0.5)
    ear = Probe(nodes, "site", "ear")
    tracks = ear.listen_tables("twin/tracks", TRACK_DTYPE)
    poses = ear.listen("twin/vehicles", PoseArray, KEEP_ALL)
    health = ear.listen("twin/health", DiagnosticArray, KEEP_ALL)
    fixes = ear.listen("twin/datum", NavSatFix, LATCHED)
    (probe, north), (_, south) = speak(nodes, "north"), speak(nodes, "south")
    probe.until(lambda: len(node.known) == 2, "both datums")
    probe.until(lambda: node.twin.tracks.get_subscription_count() == 1, "a listener")
    probe.until(lambda: node.twin.vehicles.get_subscription_count() == 1, "a listener")
    for k in range(12):
        north(START_NS + k * STEP_NS, rows([(1, 50.0 + 2.0 * k, LANE_Y)]))
        south(START_NS + k * STEP_NS, rows([(5, 50.0 + 2.0 * k, LANE_Y)], class_id=7))
    probe.until(lambda: len(tracks) == len(poses) == 12 and len(health) >= 2, "the twin")
    for k, (stamp_ns, frame_id, table) in enumerate(tracks):
        assert (stamp_ns, frame_id, len(table)) == (START_NS + k * STEP_NS, "map", 1)
        assert (table["x"][0], table["y"][0]) == pytest.approx((50.0 + 2.0 * k, LANE_Y), abs=1e-3)
        assert table["track_id"][0] == 1
        assert poses[k].poses[0].position.x == pytest.approx(50.0 + 2.0 * k, abs=1e-3)
    values = {pair.key: pair.value for pair in health[-1].status[0].values}
    assert float(values["position_error_m_p95"]) < 0.01
    assert float(values["lane_error_share"]) == 0.0
    assert float(values["latency_ms_p99"]) > 0.0
    assert health[-1].status[0].message == "ok"
    probe.until(lambda: bool(fixes), "the twin's datum")
    assert (fixes[0].latitude, fixes[0].longitude) == (DATUM.latitude_deg, DATUM.longitude_deg)


def test_a_sumo_that_dies_is_replaced(nodes: Composition, net: Path) -> None:
    node = start(nodes, net, cameras="north", backend="traci")
    probe, send = speak(nodes, "north")
    probe.until(lambda: len(node.known) == 1, "the datum")
    for k in range(5):
        send(START_NS + k * STEP_NS, rows([(1, 50.0 + 2.0 * k, LANE_Y)]))
    probe.until(lambda: node.diagnostics.received == 5, "the frames")
    simulation = node.runner.simulation
    assert isinstance(simulation, SumoSimulation)
    assert simulation.pid is not None
    os.kill(simulation.pid, signal.SIGKILL)
    for k in range(5, 10):
        send(START_NS + k * STEP_NS, rows([(1, 50.0 + 2.0 * k, LANE_Y)]))
    probe.until(lambda: node.diagnostics.received == 10, "the frames after it")
    assert node.runner.restarts == 1
    assert node.diagnostics.refused == 1
    assert "signal 9" in str(node.diagnostics.last_refusal)
    replaced = node.runner.simulation
    assert isinstance(replaced, SumoSimulation)
    assert np.allclose(replaced.states(["v1"]).xy[0], (50.0 + 18.0 + 2.3, LANE_Y), atol=1e-3)


@pytest.mark.parametrize("own_datum", [True, False])
def test_references_are_latched_paths_in_the_frame_of_the_tracks(
    nodes: Composition, net: Path, tmp_path: Path, own_datum: bool
) -> None:
    """A camera over (150, -20) that looks east along the road, as a plane seen from above."""
    corners = DATUM.to_geodetic([(x, y) for x in (100, 150, 200) for y in (-40, 0, 40)])
    pixels = [(960 - 12 * y, 1000 - 9 * (x - 100)) for x in (100, 150, 200) for y in (-40, 0, 40)]
    lines = ["pixel_x,pixel_y,latitude,longitude"]
    for (px, py), (lat, lon) in zip(pixels, corners, strict=True):
        lines.append(f"{px},{py},{lat:.9f},{lon:.9f}")
    file = tmp_path / "north.csv"
    file.write_text("\n".join(lines) + "\n")
    start(nodes, net, cameras="north", calibrations=str(file))
    probe = Probe(nodes, "site/north")
    origin = Datum(*corners.mean(axis=0)) if own_datum else DATUM
    probe.publisher("datum", NavSatFix, LATCHED).publish(datum_to_fix(origin, "map"))
    found: dict[str, list[Any]] = {
        f"{k}/{role}": probe.listen(f"reference/lane_{k}/{role}", PathMessage)
        for k in range(1, 6)
        for role in ("centerline", "left", "right")
    }
    probe.until(lambda: all(found.values()), "the paths of five lanes")
    line = np.array(
        [(p.pose.position.x, p.pose.position.y) for p in found["1/centerline"][0].poses]
    )
    left = np.array([(p.pose.position.x, p.pose.position.y) for p in found["1/left"][0].poses])
    shift = DATUM.to_local(origin.latitude_deg, origin.longitude_deg)[0]
    assert np.abs(line[:, 1] + shift[1] + 8.75).max() < 0.05
    assert np.abs(left[:, 1] - line[:, 1] - 1.75).max() < 0.01
    assert 80.0 < line[-1, 0] - line[0, 0] < 125.0


def test_tracks_before_their_datum_are_refused(nodes: Composition, net: Path) -> None:
    node = start(nodes, net, cameras="north")
    probe = Probe(nodes, "site/north")
    probe.table_publisher("tracks")(START_NS, rows([(1, 50.0, LANE_Y)]))
    probe.until(lambda: node.diagnostics.refused == 1, "the refusal")
    assert "/site/north/datum" in str(node.diagnostics.last_refusal)


@pytest.mark.parametrize(
    ("overrides", "said"),
    [
        ({"network": "no.net.xml"}, "no.net.xml: found no such file"),
        ({"cameras": "north north"}, "different names"),
        ({"calibrations": "one.csv"}, "one file per camera"),
        ({"image_sizes": "640x360 wide"}, "WIDTHxHEIGHT"),
        ({"image_sizes": "640x360 640x360 640x360"}, "or one for each"),
        ({"gui": True}, "with a window"),
        ({"datum_latitude_deg": 43.0}, "both latitude and longitude"),
    ],
)
def test_a_bridge_that_can_not_work_says_why(
    nodes: Composition, net: Path, overrides: dict[str, object], said: str
) -> None:
    with pytest.raises(GeoOrbitError) as error:
        start(nodes, net, **overrides)
    assert said in str(error.value)
    assert "\n" not in str(error.value)


def test_camera_and_twin_side_by_side(nodes: Composition, net: Path, tmp_path: Path) -> None:
    """A camera on a pole of 8 m at x = 60 that looks east over the road."""
    camera = look_at(np.array([60.0, -20.0, 8.0]), np.array([120.0, -5.0, 0.0]), 60.0, (1280, 720))
    ground = np.array([(x, y) for x in (85, 110, 160) for y in (-12, -6, 0, 4)], dtype=float)
    pixel, _ = camera.project(np.column_stack((ground, np.zeros(len(ground)))))
    lines = ["pixel_x,pixel_y,latitude,longitude"]
    for (u, v), (lat, lon) in zip(pixel, DATUM.to_geodetic(ground), strict=True):
        lines.append(f"{u:.3f},{v:.3f},{lat:.9f},{lon:.9f}")
    file = tmp_path / "north.csv"
    file.write_text("\n".join(lines) + "\n")
    given = {"calibrations": str(file), "image_sizes": "1280x720", "side_by_side_period_s": 0.5}
    node = start(nodes, net, cameras="north", **given)
    probe, send = speak(nodes, "north")
    images = probe.listen("twin/side_by_side/compressed", CompressedImage, BEST_EFFORT)
    eye = probe.publisher("image/compressed", CompressedImage, BEST_EFFORT)
    grey = cv2.imencode(".jpg", np.full((720, 1280, 3), 200, np.uint8))[1].tobytes()
    probe.until(lambda: len(node.known) == 1, "the datum")
    eye.publish(CompressedImage(format="jpeg", data=grey))
    publisher = node.side_by_side._publishers["north"]
    probe.until(lambda: publisher.get_subscription_count() == 1, "a listener")
    probe.until(lambda: "north" in node.side_by_side._image, "the image")
    for k in range(10):
        send(START_NS + k * STEP_NS, rows([(1, 110.0 + 2.0 * k, LANE_Y)]))
    probe.until(lambda: len(images) >= 1, "an image")
    image = cv2.imdecode(np.frombuffer(bytes(images[0].data), np.uint8), cv2.IMREAD_COLOR)
    assert image is not None
    assert image.shape == (360, 3 * 640, 3)
    assert np.abs(image[300, 100].astype(int) - 200).max() < 6  # the camera's own, grey
    assert np.ptp(image[:, 640:1280].reshape(-1, 3), axis=0).min() > 100  # the twin's, a road
    assert images[0].header.frame_id == "north_optical"
