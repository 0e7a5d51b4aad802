"""The CARLA bridge as a node: without a server it says so; with one, vehicles and images go."""

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
from made_twin import DATUM, START_NS, STEP_NS, made_network, rows
from probe import KEEP_ALL, LOSSLESS, Probe
from sensor_msgs.msg import CompressedImage, NavSatFix

from geoorbit_ros.conversions import datum_to_fix
from geoorbit_ros.core.errors import GeoOrbitError
from geoorbit_ros.nodes import carla_bridge
from geoorbit_ros.nodes.support.composition import Composition
from geoorbit_ros.nodes.support.qos import LATCHED
from geoorbit_ros.roadnet.map_build import build_from_network
from geoorbit_ros.scenes.roads import place_roads
from geoorbit_ros.scenes.scene import load_scene
from geoorbit_ros.scenes.simulate import scene_camera, survey_control_points
from geoorbit_ros.twin.carla.client import OnImage
from geoorbit_ros.twin.carla.frame import CarlaCamera, CarlaPose


@pytest.fixture(scope="module")
def road(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("road")
    (folder / "map").mkdir()
    build_from_network(made_network(folder), folder / "map", DATUM)
    return folder / "map" / "road.xodr"


def test_without_a_server_it_says_so_in_one_sentence(nodes: Composition, road: Path) -> None:
    pytest.importorskip("carla", reason="CARLA's client needs Python 3.10 to 3.12")
    given = LOSSLESS | {"opendrive": str(road), "port": 9, "timeout_s": 0.5}
    with pytest.raises(GeoOrbitError, match="CARLA at localhost:9: found no server") as error:
        nodes.make(carla_bridge.CarlaBridgeNode, "site", given)
    assert "\n" not in str(error.value)


class Server:
    """In place of a server: remembers its actors, and sends a grey image with every tick."""

    def __init__(self, *_: object) -> None:
        self.actors: dict[int, CarlaPose] = {}
        self.cameras: list[tuple[CarlaCamera, OnImage]] = []
        self.closed = False

    def spawn(self, class_id: int, length_m: float, pose: CarlaPose) -> int | None:
        self.actors[len(self.actors) + 1] = pose
        return len(self.actors)

    def move(self, poses: Mapping[int, CarlaPose]) -> None:
        self.actors.update(poses)

    def destroy(self, actors: Sequence[int]) -> None:
        for actor in actors:
            del self.actors[actor]

    def tick(self) -> None:
        for camera, on_image in self.cameras:
            width, height = camera.image_size
            on_image(camera.name, 0.0, np.full((height, width, 3), 90, np.uint8))

    def add_camera(self, camera: CarlaCamera, on_image: OnImage) -> None:
        self.cameras.append((camera, on_image))

    def close(self) -> None:
        self.closed = True


def test_vehicles_and_images(
    nodes: Composition, road: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(carla_bridge, "CarlaClient", Server)
    scene = load_scene("straight_3x3")
    placed = place_roads(scene)
    camera = scene_camera(scene, placed)
    points = survey_control_points(placed, camera, DATUM, 1)
    lines = ["pixel_x,pixel_y,latitude,longitude"]
    for (u, v), (lat, lon) in zip(points.pixel, DATUM.to_geodetic(points.local_m), strict=True):
        lines.append(f"{u},{v},{lat:.9f},{lon:.9f}")
    file = tmp_path / "north.csv"
    file.write_text("\n".join(lines) + "\n")
    width, height = camera.image_size
    given: dict[str, Any] = {
        "opendrive": str(road),
        "cameras": "north",
        "calibrations": str(file),
        "image_sizes": f"{width}x{height}",
    }
    node = nodes.make(carla_bridge.CarlaBridgeNode, "site", LOSSLESS | given)
    server = node.server
    assert isinstance(server, Server)
    placed_camera = server.cameras[0][0]
    assert placed_camera.pose.x == pytest.approx(camera.centre_m[0], abs=1.5)
    assert placed_camera.pose.y == pytest.approx(-camera.centre_m[1], abs=1.5)
    assert placed_camera.pose.z == pytest.approx(camera.centre_m[2], abs=1.5)
    probe = Probe(nodes, "site", "twin")
    images = probe.listen("north/carla/image/compressed", CompressedImage, KEEP_ALL)
    send = probe.table_publisher("twin/tracks")
    send(START_NS, rows([(1, 10.0, 5.0)]))
    probe.until(lambda: node.diagnostics.refused == 1, "the refusal")
    assert "/site/twin/datum" in str(node.diagnostics.last_refusal)
    probe.publisher("twin/datum", NavSatFix, LATCHED).publish(datum_to_fix(DATUM, "map"))
    probe.until(lambda: node.diagnostic_values()["located"] == "yes", "the datum")
    for k in range(1, 4):
        send(START_NS + k * STEP_NS, rows([(1, 10.0 + 2.0 * k, 5.0), (2, 50.0, 5.0)]))
    probe.until(lambda: len(images) == 3, "the images")
    assert server.actors[1].x == pytest.approx(16.0, abs=1e-3)
    assert server.actors[1].y == pytest.approx(-5.0, abs=1e-3)
    image = cv2.imdecode(np.frombuffer(bytes(images[-1].data), np.uint8), cv2.IMREAD_COLOR)
    assert image is not None
    assert image.shape == (height, width, 3)
    assert images[-1].header.frame_id == "north_optical"
    node.close()
    assert server.closed
    assert not server.actors
