"""A fleet from one file: healthy, any of its processes killed and back, stopped in time."""

import os
import time
from collections.abc import Callable, Iterator
from functools import partial
from pathlib import Path

import numpy as np
import pytest
from foxglove_client import FoxgloveClient
from geometry_msgs.msg import PoseArray
from made_up_camera import MadeUpCamera
from rclpy.qos import QoSProfile, ReliabilityPolicy
from running_fleet import RunningFleet

from geoorbit_ros.calibration.datum import Datum
from geoorbit_ros.nodes.support.composition import Composition
from geoorbit_ros.scenes.network import write_network
from geoorbit_ros.scenes.road_plan import Road, Start, Straight
from geoorbit_ros.scenes.roads import place_roads
from geoorbit_ros.scenes.scene import load_scene
from geoorbit_ros.storage.database.writer import TrajectoryReader

FLUSH_S = 1.0
LATE_S = 5.0
"""Chosen: larger, and a recorder that flushes rarely passes; smaller, and one on a busy machine
fails."""
CAMERAS = ("north", "south")
PORTS = 18_700
"""The viewer of domain n listens on this plus n: no two runs meet."""


def made_up_network(folder: Path) -> Path:
    """The road of the made-up camera: three lanes northwards, 3.6 m wide, around x = 0."""
    road = Road(
        id="road",
        lanes=3,
        path=[Straight(straight_m=400.0)],
        start=Start(x_m=-5.4, y_m=-100.0, heading_deg=0.0),
    )
    scene = load_scene("straight_3x3")
    roads = place_roads(scene.model_copy(update={"roads": [road], "lane_width_m": 3.6}))
    folder.mkdir()
    return write_network(roads, folder, Datum(43.05, -89.35))


@pytest.fixture
def fleet(tmp_path: Path, camera: MadeUpCamera) -> Iterator[RunningFleet]:
    """Two cameras of one road, who learn together, a twin, a viewer, recordings."""
    with Composition(quiet=True) as nodes:
        cameras = "".join(
            f"  - id: {name}\n    source: bag:{camera.bag}\n    calibration: {camera.calibration}\n"
            "    parameters: {meta_client: {observation_s: 6.0}}\n"
            for name in CAMERAS
        )
        file = tmp_path / "fleet.yaml"
        file.write_text(
            f"name: pair\ndomain_id: {nodes.domain_id}\ncameras:\n{cameras}recorder: {{}}\n"
            "federated_server: {parameters: {rounds: 100000}}\n"
            f"twin: {{network: {made_up_network(tmp_path / 'net')}}}\n"
            f"viewer: {{port: {PORTS + nodes.domain_id}}}\n"
        )
        running = RunningFleet(nodes, file, CAMERAS)
        yield running
        if running.process.poll() is None:
            running.stop()


@pytest.mark.slow
def test_every_process_that_is_killed_comes_back_and_nothing_is_lost(fleet: RunningFleet) -> None:
    vehicles: list[int] = []
    port = PORTS + fleet.nodes.domain_id

    def count(message: PoseArray) -> None:
        vehicles.append(len(message.poses))

    stream = QoSProfile(depth=5, reliability=ReliabilityPolicy.BEST_EFFORT)
    fleet.node.create_subscription(PoseArray, "/twin/vehicles", count, stream)

    def federated_round() -> float:
        return fleet.value("/federated_server", "round")

    def later(number: float) -> bool:
        return federated_round() > number

    def three_lanes(name: str) -> bool:
        return fleet.value(f"/{name}/lane_geometry", "lanes_confirmed") == 3

    for name in CAMERAS:
        fleet.until(partial(three_lanes, name), "lanes")
    fleet.until(lambda: federated_round() >= 1, "a federated round")
    look_at_the_status(fleet)
    before = {name: fleet.lane_ids(name) for name in CAMERAS}

    def new_vehicles() -> Callable[[], object]:
        so_far = len(vehicles)
        return lambda: any(vehicles[so_far:])

    def new_map() -> Callable[[], object]:
        so_far = len(fleet.maps["north"])
        return lambda: len(fleet.maps["north"]) > so_far

    for process, node, prepared in (
        ("federated_server", "/federated_server", lambda: lambda: True),
        ("twin", "/sumo_bridge", new_vehicles),
        ("viewer", "/viewer", lambda: partial(viewer_answers, port)),
        ("north", "/north/lane_geometry", new_map),
    ):
        of_round, is_back = federated_round(), prepared()
        killed_ns, killed_s = time.time_ns(), fleet.kill(process)
        fleet.until(partial(fleet.heard_since, node, time.monotonic()), f"{process} again")
        fleet.until(is_back, f"{process} at work again")
        away_s = time.monotonic() - killed_s
        assert f"{process}  ended by SIGKILL; again in 0.5 s" in fleet.log.read_text()
        assert {name: fleet.lane_ids(name) for name in CAMERAS} == before, process
        assert federated_round() >= of_round, process
        if process == "federated_server":
            fleet.until(partial(later, of_round), "a round after it")

    fleet.until(partial(later, of_round), f"a round after {process}")
    fleet.until(new_map(), "a map of new traffic")
    assert fleet.lane_ids("north") == before["north"]
    pids = [fleet.pid(name) for name in (*CAMERAS, "federated_server", "twin", "viewer")]
    fleet.stop()
    for pid in pids:
        with pytest.raises(ProcessLookupError):
            os.kill(pid, 0)
    assert_recorded(fleet, killed_ns, away_s)


def look_at_the_status(fleet: RunningFleet) -> None:
    """Healthy, and every column of a camera that there is data for has a value."""
    answer = fleet.ask_status()
    assert answer["healthy"], answer
    assert [row["name"] for row in answer["cameras"]] == list(CAMERAS)
    for row in answer["cameras"]:
        values = row["values"]
        assert values["lanes_confirmed"] == 3
        assert 0.0 < values["latency_ms"] < 1e4
        assert values["parameters"] != "own"  # but what the federation says
        assert {"rate_hz", "vehicles", "round", "lost", "lanes_tentative"} <= set(values)
    services = {row["name"]: row["values"] for row in answer["services"]}
    assert services["federated_server"]["round"] >= 1
    assert services["sumo_bridge"]["error_m_p95"] < 0.05
    assert services["viewer"]["topics"] > 20


def viewer_answers(port: int) -> bool:
    with FoxgloveClient(port) as client:
        deadline = time.monotonic() + 1.0
        while "/twin/vehicles" not in client.channels and time.monotonic() < deadline:
            time.sleep(0.01)
        return "/twin/vehicles" in client.channels


def assert_recorded(fleet: RunningFleet, killed_ns: int, away_s: float) -> None:
    """South is whole; north lacks its last second, and the time until it was back."""
    gaps_s = {}
    for name in CAMERAS:
        with TrajectoryReader(fleet.output / "recordings" / f"{name}.db") as reader:
            stamps = np.unique(reader.read(name).stamp_ns)
        gaps_s[name] = np.diff(stamps).max() / 1e9
        kept = stamps[stamps < killed_ns]
        assert killed_ns - kept[-1] < (FLUSH_S + LATE_S) * 1e9
        assert stamps[-1] > killed_ns
    assert fleet.log.read_text().count("south  started") == 1
    assert gaps_s["south"] < gaps_s["north"] < away_s + FLUSH_S + LATE_S
