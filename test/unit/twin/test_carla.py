"""What CARLA gets, against its real library: frames, poses, blueprints, errors. No server."""

from collections.abc import Mapping, Sequence
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from made_twin import DATUM, made_network, rows

from geoorbit_ros.calibration.camera_pose import recover_pose
from geoorbit_ros.calibration.datum import Datum
from geoorbit_ros.calibration.homography import fit_homography
from geoorbit_ros.core.errors import RoadNetworkError
from geoorbit_ros.roadnet.map_build import build_from_network
from geoorbit_ros.roadnet.network import RoadNetwork, load_network
from geoorbit_ros.scenes.roads import place_roads
from geoorbit_ros.scenes.scene import load_scene
from geoorbit_ros.scenes.simulate import scene_camera, survey_control_points
from geoorbit_ros.twin.carla.client import (
    CarlaClient,
    CarlaError,
    CarlaVehicles,
    pixels_of,
    transform,
)
from geoorbit_ros.twin.carla.frame import (
    CarlaPose,
    camera_pose,
    read_opendrive,
    vehicle_pose,
)

carla: Any = pytest.importorskip("carla", reason="CARLA's client needs Python 3.10 to 3.12")
ORIGIN = np.zeros(2)


@pytest.fixture(scope="module")
def road(tmp_path_factory: pytest.TempPathFactory) -> tuple[RoadNetwork, Path]:
    """A network and the same road as OpenDRIVE."""
    folder = tmp_path_factory.mktemp("road")
    (folder / "map").mkdir()
    build_from_network(made_network(folder), folder / "map", DATUM)
    return load_network(folder / "map" / "network.net.xml"), folder / "map" / "road.xodr"


def test_a_vehicle_in_a_lane_is_in_carlas_lane_the_same_way_round(
    road: tuple[RoadNetwork, Path],
) -> None:
    network, xodr = road
    text, origin = read_opendrive(xodr)
    assert origin == network.datum
    world = carla.Map("road", text)
    for lane in np.flatnonzero(~network.internal).tolist():
        line = network.line(lane)
        k = len(line) // 2
        middle, step = 0.5 * (line[k - 1] + line[k]), line[k] - line[k - 1]
        heading_rad = float(np.arctan2(step[1], step[0]))
        pose = vehicle_pose(float(middle[0]), float(middle[1]), heading_rad)
        put = transform(carla, pose)
        waypoint = world.get_waypoint(put.location)
        assert waypoint.transform.location.distance_2d(put.location) < 0.4
        ahead, along = put.get_forward_vector(), waypoint.transform.get_forward_vector()
        assert ahead.x * along.x + ahead.y * along.y > 0.999


def test_a_camera_looks_where_its_calibration_looks() -> None:
    """Points of the road, through CARLA's own camera transform, fall on their pixels."""
    scene = load_scene("on_ramp_merge")
    placed = place_roads(scene)
    camera = scene_camera(scene, placed)
    points = survey_control_points(placed, camera, Datum(43.0, -89.0), 1)
    homography = fit_homography(points)
    pose = recover_pose(homography, camera.image_size)
    made = camera_pose("pole", pose, camera.image_size, ORIGIN)
    into_camera = np.array(transform(carla, made.pose).get_inverse_matrix())
    width, height = made.image_size
    focal = 0.5 * width / np.tan(np.radians(0.5 * made.fov_deg))
    pixels = np.array([(u, v) for u in (300, 960, 1600) for v in (500, 700, 1000)], float)
    ground = homography.to_ground(pixels)
    world = np.column_stack((ground[:, 0], -ground[:, 1], np.zeros(len(ground)), np.ones(9)))
    x, y, z, _ = into_camera @ world.T  # CARLA: x forward, y right, z up
    assert (x > 0).all()
    seen = np.column_stack((0.5 * width + focal * y / x, 0.5 * height - focal * z / x))
    # A pinhole without skew; what the homography has more is the survey's noise.
    assert np.abs(seen - pixels).max() < 12.0
    assert np.abs(seen - pixels).mean() < 5.0


def test_a_road_without_its_place_is_one_sentence(tmp_path: Path) -> None:
    for text, said in (
        ("<nothing/>", "no OpenDRIVE"),
        ("<OpenDRIVE><header/></OpenDRIVE>", "no georeference"),
        (
            "<OpenDRIVE><header><geoReference><![CDATA[+proj=utm +zone=16]]></geoReference>"
            "</header></OpenDRIVE>",
            r"proj=utm.*tmerc",
        ),
    ):
        file = tmp_path / "road.xodr"
        file.write_text(text)
        with pytest.raises(RoadNetworkError, match=said) as error:
            read_opendrive(file)
        assert "\n" not in str(error.value)
    with pytest.raises(RoadNetworkError, match="no such file"):
        read_opendrive(tmp_path / "no.xodr")


def test_without_a_server_one_sentence_says_so() -> None:
    with pytest.raises(CarlaError, match=r"CARLA at 127.0.0.1:9.*no server") as error:
        CarlaClient("127.0.0.1", 9, 0.5, "<OpenDRIVE/>", 0.1)
    assert "\n" not in str(error.value)


class FakeServer:
    """Actors in a dictionary; no room east of x = 100."""

    def __init__(self) -> None:
        self.actors: dict[int, CarlaPose] = {}
        self.ticks = self.spawned = 0

    def spawn(self, class_id: int, length_m: float, pose: CarlaPose) -> int | None:
        if pose.x > 100.0:
            return None
        self.spawned += 1
        self.actors[self.spawned] = pose
        return self.spawned

    def move(self, poses: Mapping[int, CarlaPose]) -> None:
        assert set(poses) <= set(self.actors)
        self.actors.update(poses)

    def destroy(self, actors: Sequence[int]) -> None:
        for actor in actors:
            del self.actors[actor]

    def tick(self) -> None:
        self.ticks += 1


def test_actors_come_move_and_go_with_the_twins_vehicles() -> None:
    server = FakeServer()
    vehicles = CarlaVehicles(server)
    vehicles.update(rows([(1, 10.0, 5.0), (2, 200.0, 5.0)]), ORIGIN)
    assert list(vehicles.actors) == [1]
    assert vehicles.refused == 1
    vehicles.update(rows([(1, 12.0, 5.0), (2, 90.0, 5.0)], heading_rad=0.5), np.array([1.0, 2.0]))
    first = server.actors[vehicles.actors[1]]
    assert (first.x, first.y) == (13.0, -7.0)
    assert first.yaw_deg == pytest.approx(-np.degrees(0.5))
    assert set(vehicles.actors) == {1, 2}
    vehicles.update(rows([(2, 92.0, 5.0)]), ORIGIN)
    assert set(server.actors) == {vehicles.actors[2]}
    assert server.ticks == 3
    vehicles.close()
    assert not server.actors


def test_an_image_is_blue_green_red() -> None:
    raw = np.arange(2 * 3 * 4, dtype=np.uint8)
    image = pixels_of(raw.tobytes(), 3, 2)
    assert image.shape == (2, 3, 3)
    assert image[1, 2].tolist() == [20, 21, 22]


class StandIn:
    """The parts of the library that need a server, replaced; values stay the real ones."""

    def __init__(self, version: str = "0.9.16") -> None:
        self.batches: list[list[Any]] = []
        self.loaded = ""
        self.settings = SimpleNamespace(synchronous_mode=False, fixed_delta_seconds=None)
        self.world = SimpleNamespace(
            get_settings=lambda: self.settings,
            apply_settings=lambda _: None,
            get_blueprint_library=lambda: self,
            try_spawn_actor=self._spawn,
            tick=lambda: None,
        )
        self.Client = lambda _host, _port: self
        self.set_timeout = lambda _: None
        self.get_server_version = lambda: version
        self.get_client_version = lambda: "0.9.16"
        self.apply_batch_sync = self.batches.append
        self.kinds: list[str] = []

    def __getattr__(self, name: str) -> Any:
        return getattr(carla, name)

    def generate_opendrive_world(self, text: str, parameters: Any) -> Any:
        assert isinstance(parameters, carla.OpendriveGenerationParameters)
        self.loaded = text
        return self.world

    def filter(self, pattern: str) -> list[Any]:
        assert pattern == "vehicle.*"
        return [
            SimpleNamespace(
                kind=kind,
                has_attribute=lambda name: name == "base_type",
                get_attribute=lambda _, kind=kind: SimpleNamespace(as_str=lambda: kind),
            )
            for kind in ("car", "truck", "van", "motorcycle", "bicycle")
        ]

    def _spawn(self, blueprint: Any, where: Any) -> Any:
        assert isinstance(where, carla.Transform)
        self.kinds.append(blueprint.kind)
        return SimpleNamespace(id=7, set_simulate_physics=lambda _: None)


def test_the_client_sends_the_librarys_own_commands() -> None:
    stand_in = StandIn()
    client = CarlaClient("host", 2000, 1.0, "<OpenDRIVE/>", 0.1, stand_in)
    assert stand_in.loaded == "<OpenDRIVE/>"
    assert stand_in.settings.fixed_delta_seconds == 0.1
    for class_id in (2, 7, 5, 3, 1, 99):
        assert client.spawn(class_id, 4.0, vehicle_pose(1.0, 2.0, 0.0)) == 7
    assert stand_in.kinds == ["car", "truck", "van", "motorcycle", "bicycle", "car"]
    client.move({7: vehicle_pose(1.0, 2.0, np.pi / 2)})
    command = stand_in.batches[-1][0]
    assert isinstance(command, carla.command.ApplyTransform)
    assert command.actor_id == 7
    assert command.transform.location.y == -2.0
    client.destroy([7])
    assert isinstance(stand_in.batches[-1][0], carla.command.DestroyActor)
    client.close()
    assert stand_in.settings.synchronous_mode is False


def test_a_server_of_another_version_is_refused() -> None:
    with pytest.raises(CarlaError, match=r"0\.9\.13.*0\.9\.16"):
        CarlaClient("host", 2000, 1.0, "<OpenDRIVE/>", 0.1, StandIn("0.9.13"))
